"""The edge validity model: fitted to exactly checked edges of several arms' roadmaps, judged on
arms it has not seen.

Compared are a logistic curve of the smallest clearance, one of clearance and length, and a small
network of the smallest clearances of base, middle and tool, and length. The first is what planners
use (`vqmpt.edge_curve`).
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError, whole_number
from cvqmpt_lab.files import make_folder, read_json_object, write_text
from cvqmpt_lab.labels.path_labels import unconstrained_space
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import family_scene
from cvqmpt_lab.sensing.virtual import CameraSettings, camera_cloud
from cvqmpt_lab.training.shards import DESCRIPTION_FILE, RoadmapShard, read_roadmap_shards
from cvqmpt_lab.vqmpt.clearances import scene_clearances
from cvqmpt_lab.vqmpt.edge_curve import CLOUD, CURVES_FILE, SCENE, SOURCES
from cvqmpt_lab.vqmpt.edge_model import EdgeModel

EDGES = 512  # drawn in each scene
POINTS = 4096  # of a cloud
CAMERAS = CameraSettings.like_training(POINTS)  # clouds as planners get them
BINS = 10  # of predicted probability


class Examples(NamedTuple):
    """Edges of roadmaps in scenes."""

    clearance: np.ndarray  # (b, 3) smallest of base, middle and tool [m]
    length: np.ndarray  # (b,) [rad]
    free: np.ndarray  # (b,) bool
    scene: np.ndarray  # (b,) int, number of the scene

    @staticmethod
    def joined(parts: Sequence["Examples"]) -> "Examples":
        """All together, scenes numbered anew."""
        scenes = [np.full(len(part.free), k) for k, part in enumerate(parts)]
        clearance, length, free, _ = (np.concatenate(column) for column in zip(*parts, strict=True))
        return Examples(clearance, length, free, np.concatenate(scenes))


def by_class(clearance: np.ndarray) -> np.ndarray:
    """Smallest clearances (b, 3) of the first, the middle and the last third of n joints, from
    every joint's (b, n).
    """
    n = clearance.shape[1]
    cuts = (0, max(n // 3, 1), max(2 * n // 3, 1), n)
    thirds = [clearance[:, a:b] if b > a else clearance for a, b in pairwise(cuts)]
    return np.stack([third.min(axis=1) for third in thirds], axis=1)


def data_robot(data: Path) -> tuple[Robot, str]:
    """Whose labels a folder holds, and its name among the arms."""
    source = read_json_object(data / DESCRIPTION_FILE).get("recipe", {}).get("robot")
    robot = robot_from_source(source)
    return robot, source.get("name", robot.name)


def scene_examples(
    robot: Robot, shard: RoadmapShard, scene: int, families: Sequence[str], rng: np.random.Generator
) -> dict[str, Examples]:
    """Some edges of a scene that the robot itself allows, by the source that their clearances are
    read in.
    """
    arrays, graph = shard.arrays, shard.graph
    possible = np.flatnonzero(graph.edge_possible)
    edges = rng.choice(possible, min(EDGES, len(possible)), replace=False)
    motions = np.ascontiguousarray(graph.nodes[graph.edges[edges]])
    length = np.linalg.norm(motions[:, 1] - motions[:, 0], axis=1)
    free = shard.edge_free(scene)[edges]
    name, number = families[arrays["family"][scene]], int(arrays["scene_seed"][scene])
    shapes = family_scene(name, number)
    model, space = EdgeModel(robot), unconstrained_space(robot, shapes).arrays
    seen = model.log_odds(camera_cloud(shapes, CAMERAS, rng), motions)[0]
    clearance = {CLOUD: seen, SCENE: np.empty(motions[:, 0].shape)}
    in_grid = (space.robot, space.scene.grid, motions, clearance[SCENE])
    scene_clearances(robot.kinematics, model.empty, *in_grid)
    nothing = np.zeros(len(free), dtype=int)
    return {
        source: Examples(by_class(clearance[source]), length, free, nothing) for source in SOURCES
    }


def examples_of(
    data: Path, scenes: int, rng: np.random.Generator, on_progress: Callable[[int, int], None]
) -> dict[str, Examples]:
    """Edges of at most so many scenes of a folder of roadmap labels, by source;
    InvalidInputError where it has none.
    """
    (robot, _), found = data_robot(data), []
    families = read_json_object(data / DESCRIPTION_FILE)["families"]
    every = [(s, k) for s in read_roadmap_shards(data) for k in range(len(s.arrays["family"]))][
        :scenes
    ]
    for done, (shard, scene) in enumerate(every, start=1):
        found.append(scene_examples(robot, shard, scene, families, rng))
        on_progress(done, len(every))
    if not any(part[SCENE].free.any() for part in found):
        raise InvalidInputError(f"{data} holds no scene with a free edge; generate more of them")
    return {source: Examples.joined([part[source] for part in found]) for source in SOURCES}


def _smallest(examples: Examples) -> np.ndarray:
    return examples.clearance.min(axis=1)[:, None]


def _with_length(examples: Examples) -> np.ndarray:
    return np.column_stack([_smallest(examples), examples.length])


def _classes(examples: Examples) -> np.ndarray:
    return np.column_stack([examples.clearance, examples.length])


FEATURES: Mapping[str, Callable[[Examples], np.ndarray]] = {
    "clearance": _smallest,
    "clearance, length": _with_length,
    "network": _classes,
}


class Judged(NamedTuple):
    """How well a model separates free from blocked edges."""

    area: float  # under the curve, median over scenes
    area_of_all: float  # edges of all scenes together
    error: float  # of calibration, edges of all scenes together


def judge(log_odds: np.ndarray, examples: Examples) -> Judged:
    """Against exact verdicts."""
    areas = []
    for scene in range(examples.scene.max() + 1):
        own = examples.scene == scene
        if 0 < examples.free[own].sum() < own.sum():
            areas.append(area(log_odds[own], examples.free[own]))
    return Judged(
        float(np.median(areas)),
        area(log_odds, examples.free),
        calibration_error(log_odds, examples.free),
    )


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


def fitted(
    examples: Examples, seed: int
) -> Iterator[tuple[str, Callable[[np.ndarray], np.ndarray], np.ndarray]]:
    """Every kind of model by name:
    its log odds of its features, and its weights where it is a curve.
    """
    from cvqmpt_lab.training.edge_training import fit_logistic, fit_network  # torch: only to train

    for name in ("clearance", "clearance, length"):
        weights = fit_logistic(FEATURES[name](examples), examples.free)
        yield name, lambda x, w=weights: x @ w[:-1] + w[-1], weights  # type: ignore[misc]
    yield "network", fit_network(FEATURES["network"](examples), examples.free, seed), np.empty(0)


def train_edge_model(
    data: Sequence[Path],
    judged: Sequence[Path],
    out: Path,
    *,
    seed: int = 0,
    scenes: int,
    metadata: dict[str, Any],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[dict[str, Any]]:
    """Fit to folders of roadmap labels, at most `scenes` scenes of each; write
    out/edge_curves.json.

    judged: folders of labels to judge on. Returns a row for each of them, source and model, as in
        the file.
    InvalidInputError: a folder has no scene with a free edge.
    """
    rng = np.random.default_rng(whole_number("seed", seed))
    whole_number("scenes", scenes, 1)
    learned = [examples_of(folder, scenes, rng, on_progress) for folder in data]
    tests = {
        data_robot(folder)[1]: examples_of(folder, scenes, rng, on_progress) for folder in judged
    }
    curves: dict[str, dict[str, float]] = {}
    rows: list[dict[str, Any]] = []
    for source in SOURCES:
        for name, log_odds, weights in fitted(
            Examples.joined([part[source] for part in learned]), seed
        ):
            if name == "clearance":
                curves[source] = {"slope": float(weights[0]), "bias": float(weights[1])}
            for robot, found in tests.items():
                row = judge(log_odds(FEATURES[name](found[source])), found[source])
                rounded = {key: round(value, 4) for key, value in row._asdict().items()}
                rows.append({"robot": robot, "source": source, "model": name, **rounded})
    record = {
        "curves": curves,
        "robots": [data_robot(folder)[1] for folder in data],
        "edges": sum(len(part[SCENE].free) for part in learned),
        "seed": seed,
        "judged": rows,
        **metadata,
    }
    make_folder(out)
    write_text(out / CURVES_FILE, json.dumps(record, indent=1) + "\n")
    return rows
