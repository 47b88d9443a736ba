"""How well a sequence model sees: cross entropies, areas under curves, and how many of its
sequences are free.

In scenes that no training has seen: of all families, and the kitchen of the tasks. Their labels are
made as those of training (`labels.roadmap_labels`): nodes and edges by the exact checker, paths by
Dijkstra's algorithm.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from cvqmpt_lab.errors import require_torch
from cvqmpt_lab.labels.generation import MOST_SEED, generate
from cvqmpt_lab.labels.path_labels import unconstrained_space
from cvqmpt_lab.labels.roadmap_labels import RoadmapRecipe
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import another_scene, family_scene
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.training.roadmap_dataset import RoadmapDataset, open_roadmap_dataset
from cvqmpt_lab.vqmpt.beam_search import CodeSequence
from cvqmpt_lab.vqmpt.predictor import Predictor
from cvqmpt_lab.vqmpt.scene_predictor import SceneTransformerPredictor
from cvqmpt_lab.vqmpt.stages import dictionary_roadmap, observer
from cvqmpt_lab.vqmpt.weights import VQ_MPT, StoredModel, load_vq_mpt, resolve_model
from experiments.bench.measurement import Measurement
from experiments.suites.place_task import DOOR, DOOR_ANGLE, TUNING_ENVIRONMENTS, place_problem

PAIRS = 96  # of start and goal, whose paths are labels, in a scene
GOALS, BEAMS = 3, 3  # to which sequences are predicted, and hypotheses kept for each
QUERIES = 8  # of a family's scene
UNSEEN = MOST_SEED  # of scenes; datasets are made with small ones
MEASURES = {
    f"{prefix}cross_entropy_{which}": f"cross entropy over {words}, {cloud}"
    for which, words in (("ways", "the ways on"), ("all", "all codes"))
    for prefix, cloud in (
        ("", "own cloud"),
        ("wrong_cloud_", "another scene's cloud"),
        ("no_cloud_", "no cloud"),
    )
} | {f"{kind}_area_under_curve": f"AUC of {kind}s" for kind in ("node", "edge", "link")}
SHARES = (
    "likeliest sequence",
    "its motion from the start",
    "its motions between codes",
    "its motion to the goal",
    f"one of {BEAMS} sequences in the beams",
)
Query = tuple[Scene, np.ndarray, np.ndarray]  # scene, start (n,), goals (k, n) [rad]
# goals (n,), and sequences to each, likeliest first
Hypotheses = list[tuple[np.ndarray, list[CodeSequence]]]
# from a cloud, a start and goals
Predicts = Callable[[np.ndarray, np.ndarray, np.ndarray], Hypotheses]


@dataclass(frozen=True)
class KitchenRecipe(RoadmapRecipe):
    """Paths in the kitchen of the tasks, each time between others."""

    def scenes_of(self, shard: int) -> Iterator[tuple[int, int, int, Scene]]:
        """The same scene under each number; families do not count."""
        for index, _, number, _ in super().scenes_of(shard):
            yield index, 0, number, kitchen(door_angles={DOOR: DOOR_ANGLE})


def bench_sequences(scenes: int, model: str | None) -> Iterator[Measurement]:
    """Of a model (name or folder), in so many scenes of families, and as many problems in the
    kitchen.
    """
    robot, folder = panda(), resolve_model(model, VQ_MPT)
    stored = load_vq_mpt(robot, folder)
    require_torch("bench sequences")
    from cvqmpt_lab.training.held_out import held_out_values

    other = observer()(another_scene()).astype(np.float32)
    predicts, nodes = _predicts(stored, robot), dictionary_roadmap(str(folder), robot).nodes
    for name, kind in {"kitchen": KitchenRecipe, "families": RoadmapRecipe}.items():
        with TemporaryDirectory() as data:
            generate(kind(scenes, PAIRS, seed=UNSEEN, model=str(folder)), Path(data), [])
            labels = open_roadmap_dataset(Path(data))
        found = held_out_values(stored, labels, other, PAIRS)
        for key, what in MEASURES.items():
            value = found.get(key)
            if value is not None:
                yield Measurement(f"{name}: {what}", "" if "AUC" in what else "nats", [value])
        queries = _kitchen_queries(scenes) if name == "kitchen" else _family_queries(labels)
        free = _free(predicts, robot, nodes, queries)
        for which, column in zip(SHARES, free.T, strict=True):
            share = [100.0 * column.mean()] if len(column) else []
            yield Measurement(f"{name}: {which} free, of {len(column)}", "%", share)


def _kitchen_queries(count: int) -> list[Query]:
    """Starts and goals of tuning problems."""
    posed = (place_problem(environment) for environment in TUNING_ENVIRONMENTS[:count])
    problems = [with_sampled_goals(one)[0] for one in posed if isinstance(one, PlanningProblem)]
    return [(one.scene, one.start, one.goals) for one in problems if len(one.goals)]


def _family_queries(labels: RoadmapDataset) -> list[Query]:
    """Some of the labels' starts and goals, which a path on the roadmap joins."""
    queries, rng, scenes = list[Query](), np.random.default_rng(0), labels.scenes
    for row in np.unique(labels.path_scene).tolist():
        scene = family_scene(labels.families[scenes.family[row]], int(scenes.seed[row]))
        paths = np.flatnonzero(labels.path_scene == row)
        chosen = rng.choice(paths, min(QUERIES, len(paths)), replace=False)
        queries += [
            (scene, start, goal[None])
            for start, goal in labels.configurations(chosen).astype(float)
        ]
    return queries


def _free(
    predicts: Predicts, robot: Robot, nodes: np.ndarray, queries: Sequence[Query]
) -> np.ndarray:
    """Of each predicted goal what of SHARES is free (g, 5) bool:
    straight motions, by the exact checker.
    """
    found, spaces, clouds = (
        list[tuple[bool, ...]](),
        dict[str, ConstrainedSpace](),
        dict[str, np.ndarray](),
    )
    for scene, start, goals in queries:
        if scene.name not in spaces:
            spaces[scene.name], clouds[scene.name] = (
                unconstrained_space(robot, scene),
                observer()(scene),
            )
        arrays = spaces[scene.name].arrays
        for goal, sequences in predicts(clouds[scene.name], start, goals):
            each = []
            for sequence in sequences:
                states = np.concatenate([start[None], nodes[list(sequence.codes)], goal[None]])
                free = [bool(motion_free(arrays, a, b)) for a, b in pairwise(states)]
                each.append((sequence.finished and all(free), free[0], all(free[1:-1]), free[-1]))
            found.append((*each[0], any(whole for whole, *_ in each)))
    return np.array(found, dtype=bool).reshape(-1, len(SHARES))


def _predicts(stored: StoredModel, robot: Robot) -> Predicts:
    """The model as planners ask it; InvalidInputError for one without a sequence model."""
    if "transformer" in stored.parts:
        transformer = SceneTransformerPredictor(stored, robot)

        def ranked(cloud: np.ndarray, start: np.ndarray, goals: np.ndarray) -> Hypotheses:
            scene = transformer.encode(cloud)
            chosen = goals[transformer.rank(scene, start, goals)[:GOALS]]
            return list(
                zip(chosen, transformer.hypotheses(scene, start, chosen, BEAMS), strict=True)
            )

        return ranked
    published = Predictor(stored, robot)

    def nearest(cloud: np.ndarray, start: np.ndarray, goals: np.ndarray) -> Hypotheses:
        chosen = goals[np.argsort(np.linalg.norm(goals - start, axis=1))[:GOALS]]
        return [
            (goal, [s])
            for goal, s in zip(
                chosen, published.predict(cloud, start, chosen).sequences, strict=True
            )
        ]

    return nearest
