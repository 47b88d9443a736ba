"""What a state check costs and how often it errs, in the kitchen and against many obstacles."""

import time

import numpy as np

from cvqmpt_lab.kernels.compiling import kernel
from cvqmpt_lab.kernels.search.space_arrays import Space, state_valid, states_valid
from cvqmpt_lab.planning.collision_arrays import scene_arrays
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, PointCloud
from experiments.bench.timing import Figure, single, timed

STATES = 20_000  # per timed batch
HALVINGS = 16
NEAR = 0.05  # [rad] states near a contact lie within this of it


@kernel
def _towards_contact(space, free, colliding, middle, halvings):
    """Move free (b, n) in place to the last free state before the first contact found towards colliding (b, n).

    middle: (n,) work array.
    """
    b, n = free.shape
    for i in range(b):
        for _ in range(halvings):
            for j in range(n):
                middle[j] = 0.5 * (free[i, j] + colliding[i, j])
            into = free[i] if state_valid(space, middle) else colliding[i]
            for j in range(n):
                into[j] = middle[j]


def bench_collision(problem: PlanningProblem, states: int) -> list[Figure]:
    """State checks of either backend in the kitchen, and of the compiled one against obstacle count.

    states: random states, and states near contact, in which the two backends are compared.
    """
    rng = np.random.default_rng(0)
    space = ConstrainedSpace(problem)
    some = problem.robot.random_configurations(rng, STATES)
    free = space.valid_batch(some)
    exact = problem.collision_checker()
    few = some[free][:1000]
    figures = [
        _check_time("kitchen, all states", space.arrays, some),
        _check_time("kitchen, free states", space.arrays, some[free]),
        timed("kitchen, free states, coal from Python", lambda: exact.in_collision_batch(few), 1000),
        *_agreement(problem, space, "random", problem.robot.random_configurations(rng, states)),
        *_agreement(problem, space, "near-contact", near_contact(problem, space, rng, states)),
    ]
    for count in (10, 100, 1000, 10_000):
        figures += _crowded(problem, f"{count} boxes", space, _random_boxes(count, rng))
    for count in (10**3, 10**4, 10**5, 10**6):
        cloud = SceneObject("cloud", PointCloud(_shell_points(count, rng), 0.005), np.eye(4))
        figures += _crowded(problem, f"cloud of {count} points", space, Scene("cloud", (cloud,)))
    return figures


def near_contact(
    problem: PlanningProblem, space: ConstrainedSpace, rng: np.random.Generator, count: int
) -> np.ndarray:
    """Configurations (count, n) around first contacts, which bisection between random states finds."""
    limits = problem.robot.lower, problem.robot.upper
    found, missing = [np.empty((0, problem.robot.dof))], count
    while missing > 0:
        states = problem.robot.random_configurations(rng, max(2 * missing, 64))
        free = space.valid_batch(states)
        pairs = min(int(free.sum()), int((~free).sum()), missing)
        contact = states[free][:pairs].copy()
        _towards_contact(
            space.arrays, contact, states[~free][:pairs].copy(), np.empty(states.shape[1]), HALVINGS
        )
        direction = rng.normal(size=contact.shape)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        found.append(np.clip(contact + direction * rng.uniform(0.0, NEAR, (pairs, 1)), *limits))
        missing -= pairs
    return np.concatenate(found)


def _check_time(name: str, arrays: Space, states: np.ndarray) -> Figure:
    out = np.zeros(len(states), dtype=bool)
    return timed(f"state check: {name}", lambda: states_valid(arrays, states, out), len(states))


def _agreement(
    problem: PlanningProblem, space: ConstrainedSpace, name: str, states: np.ndarray
) -> list[Figure]:
    """States in which the compiled checker and coal differ."""
    free = space.valid_batch(states)
    exact_free = ~problem.collision_checker().in_collision_batch(states)
    false_alarms = 100.0 * (~free & exact_free).sum() / max(int(exact_free.sum()), 1)
    return [
        single(f"{name} states: collisions called free, of {len(states)}", (free & ~exact_free).sum(), ""),
        single(f"{name} states: free ones called colliding", false_alarms, "%"),
    ]


def _crowded(problem: PlanningProblem, name: str, space: ConstrainedSpace, scene: Scene) -> list[Figure]:
    """Building and checking against many obstacles."""
    began = time.perf_counter()
    geometry = scene_arrays(scene, problem.robot.reach)
    seconds = time.perf_counter() - began
    states = problem.robot.random_configurations(np.random.default_rng(1), STATES // 4)
    return [
        single(f"arrays: {name}", 1e3 * seconds, "ms"),
        _check_time(name, space.arrays._replace(scene=geometry), states),
    ]


def _random_boxes(count: int, rng: np.random.Generator) -> Scene:
    """Boxes on a shell around the robot, total volume kept: many small or few large."""
    edge = 0.4 * (10.0 / count) ** (1.0 / 3.0)
    positions = _shell_points(count, rng)
    return Scene(
        "boxes", tuple(SceneObject(f"box{i}", Box((edge,) * 3), pose(p)) for i, p in enumerate(positions))
    )


def _shell_points(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points 0.7 to 1.1 m from the shoulder."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * rng.uniform(0.7, 1.1, (count, 1)) + (0.0, 0.0, 0.33)
