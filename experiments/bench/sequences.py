"""How well predicted code sequences fit a scene: cross entropy, and how often the likeliest one is really free."""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.kernels.search.motion import motion_free
from cvqmpt_lab.methods.loaded import (
    SEQUENCES,
    WRONG_SCENE,
    dictionary_roadmap,
    eyes_of,
    seen_dictionary,
    small_network,
)
from cvqmpt_lab.methods.method import Weights
from cvqmpt_lab.methods.sequences import CHEAPEST
from cvqmpt_lab.planning.code_graph import SeenGraph
from cvqmpt_lab.planning.code_sequences import SequenceSearch, SequenceSettings
from cvqmpt_lab.planning.small_network import SmallNetwork
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.scene.families import FAMILIES, family_scene
from cvqmpt_lab.sensing.virtual import camera_cloud
from cvqmpt_lab.training.roadmap_shards import RoadmapGraph
from experiments.bench.seeing import AROUND, FIRST_SCENE
from experiments.bench.timing import Figure, single, timed
from experiments.labels.labelled_scenes import unconstrained_space
from experiments.labels.roadmap_labels import RoadmapLabels, roadmap_graph, roadmap_labels
from experiments.labels.sequence_examples import LabelledPath, Steps, steps_of

PATHS = 40  # of each scene


class _Held(NamedTuple):
    """A held-out scene with labels."""

    labels: RoadmapLabels
    cloud: np.ndarray
    paths: list[LabelledPath]


def bench_sequences(scenes: int) -> list[Figure]:
    """Of the shipped model, by family, over scenes that no dataset holds."""
    robot, weights = panda(), Weights("vq_mpt")
    seen, network = seen_dictionary(weights, robot), small_network(weights, SEQUENCES)
    graph = roadmap_graph(robot, dictionary_roadmap(weights, robot))
    wrong = camera_cloud(family_scene(*WRONG_SCENE), AROUND, np.random.default_rng(0))
    figures: list[Figure] = []
    everything: dict[str, list[np.ndarray]] = {}
    for family in FAMILIES:
        held = list(_held(family, scenes, graph))
        clouds = {
            "own cloud": [one.cloud for one in held],
            "another scene's cloud": [wrong] * len(held),
            "no cloud": [np.empty((0, 3))] * len(held),
        }
        for name, shown in clouds.items():
            steps = Steps.together(
                steps_of(seen, cloud, one.paths) for cloud, one in zip(shown, held, strict=True)
            )
            found = entropies(network, steps)
            everything.setdefault(name, []).append(found)
            figures.append(single(f"{family}, {name}: cross entropy, mean", found.mean(), "nats"))
        for name, chooser in {"likeliest sequence": network, "cheapest sequence": CHEAPEST}.items():
            free = np.concatenate([_free(seen, chooser, one) for one in held])
            figures.append(single(f"{family}, {name}: share really free", free.mean(), ""))
    for name, parts in everything.items():
        figures.append(
            single(f"all families, {name}: cross entropy, mean", np.concatenate(parts).mean(), "nats")
        )
    cloud, start, goals = (
        held[0].cloud,
        held[0].paths[0].start,
        np.stack([path.goal for path in held[0].paths[:3]]),
    )
    eyes = eyes_of(weights, robot)

    def new_scene() -> None:
        eyes.look(cloud, anew=True)
        seen.prices(cloud, anew=True)

    def known_scene() -> None:
        SequenceSearch(seen, network, cloud, start, goals, SequenceSettings()).likeliest()

    figures.append(timed("a new scene seen", new_scene, 1, "ms"))
    figures.append(timed("sequences to three goals in a known scene", known_scene, 1, "ms"))
    return figures


def _held(family: str, scenes: int, graph: RoadmapGraph) -> Iterator[_Held]:
    """Scenes of a family with their labels."""
    robot = panda()
    for number in range(FIRST_SCENE, FIRST_SCENE + scenes):
        scene = family_scene(family, number)
        labels = roadmap_labels(robot, scene, graph, PATHS, (0, number))
        if labels is not None:
            ends = zip(labels.ends, labels.codes, labels.cost, strict=True)
            paths = [LabelledPath(a, b, codes) for (a, b), codes, cost in ends if np.isfinite(cost)]
            yield _Held(labels, camera_cloud(scene, AROUND, np.random.default_rng(0)), paths)


def entropies(network: SmallNetwork, steps: Steps) -> np.ndarray:
    """-log P (s,) of the right way on at each step [nats]."""
    score = network(steps.features.astype(float))
    score[np.arange(score.shape[1]) >= steps.count[:, None]] = -np.inf
    right = score[np.arange(len(score)), steps.right]
    return np.logaddexp.reduce(score, axis=1) - right


def _free(seen: SeenGraph, network: SmallNetwork, held: _Held) -> np.ndarray:
    """Whether the likeliest sequence of each path (p,) is free of collision in truth."""
    space = unconstrained_space(held.labels.robot, held.labels.scene)
    answers = []
    for path in held.paths:
        search = SequenceSearch(seen, network, held.cloud, path.start, path.goal[None], SequenceSettings())
        found = search.likeliest()
        way = [path.start, *seen.roadmap.nodes[found[0].codes], path.goal] if found else []
        answers.append(bool(found) and all(motion_free(space.arrays, a, b) for a, b in pairwise(way)))
    return np.array(answers, dtype=bool)
