"""Steps of sequences on dictionaries that were moved onto random constraints: what a zero-shot model never sees.

A constraint bounds some of the six rows of a region in a randomly turned frame, through a pose that the hand takes.
Those that bound as many positions and turns as a kind that is evaluated (`HELD_OUT`) are never drawn, whatever their
frame and width.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegion
from cvqmpt_lab.methods.sequences import CHEAPEST
from cvqmpt_lab.planning.allowance import Allowance
from cvqmpt_lab.planning.code_graph import SeenGraph
from cvqmpt_lab.planning.code_proposals import PredictedSequences, Walker
from cvqmpt_lab.planning.code_sequences import CodePath, SequenceSearch
from cvqmpt_lab.planning.direct_motion import direct_motion
from cvqmpt_lab.planning.proposal import Observation
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import family_scene
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.training.roadmap_shards import RoadmapShard
from experiments.labels.labelled_scenes import CANDIDATES, unconstrained_space
from experiments.labels.roadmap_labels import GOALS, STARTS, links_to_nearest, shortest_paths
from experiments.labels.sequence_examples import LabelledPath, Steps, steps_along
from experiments.labels.sight_examples import training_scenes

HELD_OUT = {
    (0, 2): "upright, tray, pouring",
    (0, 3): "fixed orientation",
    (1, 0): "plane",
    (2, 0): "line",
    (3, 2): "arc and door, were their turn not bounded",
    (3, 3): "arc, door",
}
"""Kinds of `experiments.suites.constraint_kinds` by how many positions and turns they bound."""
POSITION, TURN = (0.004, 0.4), (0.04, 1.0)  # [m], [rad] between the bounds of a row
LEVER = 0.2  # [m] from the hand to the frame that is kept, at most, along each axis


class ConstrainedLabels(NamedTuple):
    """Shortest paths on one manifold through a dictionary whose codes all lie on it."""

    space: ConstrainedSpace
    """The scene under the constraint."""
    nodes: np.ndarray
    """(N, n) codes where they were moved [rad]; anywhere if they were not."""
    paths: list[LabelledPath]
    """Between free states on the manifold, not joined by the direct motion."""


def random_region(T: np.ndarray, rng: np.random.Generator) -> TaskSpaceRegion:
    """A region that a hand at T (4, 4) is in, of no kind that is held out."""
    bounded = np.zeros(6, dtype=bool)
    while not bounded.any() or (bounded[:3].sum(), bounded[3:].sum()) in HELD_OUT:
        bounded = rng.random(6) < 0.5
    frame = T.copy()
    frame[:3, :3] = Rotation.random(rng=rng).as_matrix()
    frame[:3, 3] += rng.uniform(-LEVER, LEVER, 3)
    narrow, wide = np.repeat([POSITION, TURN], 3, axis=0).T
    width = np.where(bounded, np.exp(rng.uniform(np.log(narrow), np.log(wide))), FREE)
    below = rng.uniform(0.1, 0.9, 6)
    bounds = np.stack([-below * width, (1.0 - below) * width], axis=1)
    return TaskSpaceRegion(frame, np.linalg.inv(frame) @ T, bounds)


def constrained_labels(
    seen: SeenGraph, scene: Scene, cloud: np.ndarray, most: int, rng: np.random.Generator
) -> ConstrainedLabels | None:
    """Move a dictionary onto a random constraint, check it in a scene and find at most `most` shortest paths.

    Codes are moved as planners with `early` move them; None where the robot is nowhere free.
    """
    space = _constrained_space(seen.eyes.robot, scene, rng)
    if space is None:
        return None
    ends = _free_states(space, seen.eyes.robot.random_configurations(rng, CANDIDATES))[: STARTS + GOALS]
    walker = _asked(seen, space, cloud, ends[:1], ends[:1]) if len(ends) else None
    if walker is None:
        return ConstrainedLabels(space, seen.roadmap.nodes, [])
    count = len(seen.roadmap.nodes)
    walker.move([CodePath(np.arange(count, dtype=np.int32), 0, 0.0)])
    moved, factor = walker.search.graph.nodes, walker.search.question.factor
    nodes = np.concatenate([moved, ends])
    usable = np.concatenate([np.isfinite(factor) & space.valid_batch(moved), np.ones(len(ends), bool)])
    edges = _joined(space, nodes, usable, seen.links.edges)
    links = _joined(space, nodes, usable, links_to_nearest(seen.roadmap.nodes, ends))
    found = shortest_paths(nodes, edges, links, count)
    pairs = rng.permutation(np.argwhere(np.isfinite(found.cost))).tolist()
    asked = (
        LabelledPath(ends[s], ends[STARTS + g], found.codes(s, g))
        for s, g in pairs
        if direct_motion(space, ends[s], ends[STARTS + g]) is None
    )
    return ConstrainedLabels(space, moved, list(islice(asked, most)))


def constrained_steps(
    seen: SeenGraph,
    shards: Iterable[RoadmapShard],
    families: Sequence[str],
    scenes: int,
    paths: int,
    rng: np.random.Generator,
) -> Iterator[Steps]:
    """Steps under a random constraint in each of the first `scenes` scenes that train, of at most `paths` paths.

    families: names, by the numbers that shards hold.
    """
    for shard, row, cloud in training_scenes(shards, scenes, rng):
        scene = family_scene(families[shard.arrays["family"][row]], int(shard.arrays["scene_seed"][row]))
        labels = constrained_labels(seen, scene, cloud, paths, rng)
        yield steps_along(() if labels is None else searches_of(seen, cloud, labels))


def searches_of(
    seen: SeenGraph, cloud: np.ndarray, labels: ConstrainedLabels
) -> Iterator[tuple[SequenceSearch, np.ndarray]]:
    """Every labelled path as a planner with `early` meets it, codes moved as far as it looks, and its codes."""
    for path in labels.paths:
        yield _asked(seen, labels.space, cloud, path.start, path.goal[None]).search, path.codes


def _constrained_space(robot: Robot, scene: Scene, rng: np.random.Generator) -> ConstrainedSpace | None:
    """A scene under a random constraint through the pose of the hand in some free configuration."""
    candidates = robot.random_configurations(rng, CANDIDATES)
    free = candidates[unconstrained_space(robot, scene).valid_batch(candidates)][:1]
    if not len(free):
        return None
    region = random_region(robot.pose(free[0]), rng)
    return ConstrainedSpace(PlanningProblem(scene.name, robot, scene, free[0], free, (region,)))


def _free_states(space: ConstrainedSpace, states: np.ndarray) -> np.ndarray:
    """Those of states (b, n) that can be put on the manifold and are free there."""
    states = states[[space.project(q) for q in states]]
    return states[space.valid_batch(states)]


def _asked(
    seen: SeenGraph, space: ConstrainedSpace, cloud: np.ndarray, start: np.ndarray, goals: np.ndarray
) -> Walker:
    """A planner with `early` after it has predicted sequences from start (n,) to goals (k, n)."""
    early = PredictedSequences("labels", lambda query: seen, CHEAPEST, seen.roadmap.covariances, early=True)
    budget = Allowance(Budget(iterations=1), space)
    query = Query(space, start.reshape(-1), goals, budget, np.random.default_rng(0))
    return early.predicted(query, Observation(cloud))[0]


def _joined(space: ConstrainedSpace, nodes: np.ndarray, usable: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Those of pairs (e, 2) of usable nodes (N, n) between which the direct motion on the manifold is free."""
    pairs = pairs[usable[pairs].all(axis=1)]
    free = [direct_motion(space, nodes[a], nodes[b]) is not None for a, b in pairs.tolist()]
    return pairs[np.array(free, dtype=bool)]
