"""How well a model's eyes tell free motions from blocked ones: families of scenes, the kitchen, several cameras."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.methods.loaded import POINTS_SEEN, WRONG_SCENE, dictionary_roadmap
from cvqmpt_lab.methods.method import Weights
from cvqmpt_lab.planning.sight import Eyes
from cvqmpt_lab.planning.small_network import SmallNetwork
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.scene.families import FAMILIES, family_scene
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.sensing.camera import cameras_on_sphere
from cvqmpt_lab.sensing.filters import BallCrop
from cvqmpt_lab.sensing.noise import DepthNoise
from cvqmpt_lab.sensing.virtual import CameraSettings, camera_cloud
from cvqmpt_lab.vqmpt.codebook import load_vq_mpt
from experiments.bench.timing import Figure, spread, timed
from experiments.labels.labelled_scenes import unconstrained_space
from experiments.labels.roadmap_labels import roadmap_graph, verdicts
from experiments.labels.sight_examples import Examples, examples_of

FIRST_SCENE = 3000  # numbers that no dataset and no suite uses
KITCHEN = "kitchen of the tasks"
BINS = 10  # of predicted probability
AROUND = CameraSettings.like_training(POINTS_SEEN)
CAMERAS: Mapping[str, CameraSettings] = {
    "8 cameras": AROUND,
    "2 noisy cameras": replace(
        AROUND,
        cameras=cameras_on_sphere((45.0, -135.0), (40.0,), centre=BallCrop().centre),
        noise=0.0,
        errors=DepthNoise(),
    ),
}


def bench_sight(scenes: int) -> list[Figure]:
    """Of the shipped eyes: area under the curve and calibration by family and camera, medians over scenes."""
    robot = panda()
    model = load_vq_mpt(robot)
    if "sight" not in model.parts:
        raise InvalidInputError("the model has no eyes; train some with cvqmpt train sight")
    eyes = Eyes(SmallNetwork.of(model.parts["sight"]), robot)
    graph = roadmap_graph(robot, dictionary_roadmap(Weights("vq_mpt"), robot))
    wrong = camera_cloud(family_scene(*WRONG_SCENE), AROUND, np.random.default_rng(0))
    figures: list[Figure] = []
    for family in (*FAMILIES, KITCHEN):
        seen: dict[str, list[Examples]] = {name: [] for name in (*CAMERAS, "another scene's cloud")}
        for scene in _scenes(family, scenes):
            checked = verdicts(
                unconstrained_space(robot, scene), graph.nodes, graph.edges, graph.edge_possible
            )
            if checked is None or not checked[1].any():
                continue
            for name, settings in CAMERAS.items():
                cloud = camera_cloud(scene, settings, np.random.default_rng(0))
                seen[name].append(examples_of(eyes, cloud, graph, *checked))
            seen["another scene's cloud"].append(examples_of(eyes, wrong, graph, *checked))
        for name, examples in seen.items():
            figures += _figures(f"{family}, {name}", examples)
    one = np.ascontiguousarray(np.stack([graph.nodes[graph.edges[:, 0]], graph.nodes[graph.edges[:, 1]]], 1))
    figures.append(timed("a motion judged", lambda: eyes.judge(wrong, one), len(one)))
    figures.append(timed("a cloud looked at", lambda: eyes.look(wrong, anew=True), 1, "ms"))
    return figures


def _scenes(family: str, count: int) -> Iterator[Scene]:
    """Held-out scenes of a family; of the kitchen there is one."""
    if family == KITCHEN:
        yield kitchen()
        return
    for number in range(FIRST_SCENE, FIRST_SCENE + count):
        yield family_scene(family, number)


def _figures(name: str, scenes: list[Examples]) -> list[Figure]:
    """Areas under the curve of the network and of the smallest clearance alone, and the error of calibration."""
    rows = []
    for one in scenes:
        for kind, chosen in (("configurations", ~one.edge), ("motions", one.edge)):
            free, odds = one.free[chosen], one.odds[chosen]
            if free.all() or not free.any():
                continue
            nearest = one.features[chosen, :-1].min(axis=1)
            rows.append((kind, area(odds, free), area(nearest, free), calibration_error(odds, free)))
    figures = []
    for kind in ("configurations", "motions"):
        found = np.array([row[1:] for row in rows if row[0] == kind]).reshape(-1, 3)
        for column, what in enumerate(("AUC", "AUC of the clearance alone", "calibration error")):
            figures.append(spread(f"{name}, {kind}: {what}", found[:, column], ""))
    return figures


def area(score: np.ndarray, free: np.ndarray) -> float:
    """Area under the curve: how often a free one scores higher than a blocked one, ties half."""
    _, inverse, counts = np.unique(score, return_inverse=True, return_counts=True)
    rank = (np.cumsum(counts) - 0.5 * (counts - 1))[inverse]
    own = int(free.sum())
    return float((rank[free].sum() - own * (own + 1) / 2) / (own * (len(free) - own)))


def calibration_error(odds: np.ndarray, free: np.ndarray) -> float:
    """How far shares of free ones lie from their predicted probability, mean over BINS of it."""
    probability = 1.0 / (1.0 + np.exp(-odds))
    bins = np.minimum((BINS * probability).astype(int), BINS - 1)
    gap = np.bincount(bins, probability - free, BINS)
    return float(np.abs(gap).sum() / len(free))
