"""What kinematics, projection and state checks cost, and how often a state check errs."""

import time
from collections.abc import Iterator

import numpy as np

from cvqmpt_lab.collision.arrays import scene_arrays
from cvqmpt_lab.constraints.project import project_batch, projection_scratch
from cvqmpt_lab.constraints.task_space_region import (
    MAX_ITERATIONS,
    TOLERANCE,
    RegionConstraint,
    upright,
)
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, PointCloud
from cvqmpt_lab.search.motion import Space, states_valid
from cvqmpt_lab.search.space import ConstrainedSpace
from experiments.bench.measurement import Measurement

STATES = 20_000  # per timed batch
HALVINGS = 16
NEAR = 0.05  # [rad] states near a contact lie within this of it


def bench_kernels(problem: PlanningProblem) -> Iterator[Measurement]:
    """Forward kinematics and projection, one configuration at a time, and batches of constraint
    gradients.
    """
    robot, constraint = problem.robot, RegionConstraint(problem.robot, (upright(),))
    rng = np.random.default_rng(0)
    uniform = robot.random_configurations(rng, STATES)
    scratch, iterations = (
        projection_scratch(robot.dof, constraint.regions),
        np.empty(STATES, dtype=np.int64),
    )

    def projected(configurations: np.ndarray) -> np.ndarray:
        q = configurations.copy()
        project_batch(
            robot.kinematics, constraint.regions, q, TOLERANCE, MAX_ITERATIONS, scratch, iterations
        )
        return q

    def gradient() -> None:
        F, J = constraint.residual_and_jacobian(uniform[:10_000])
        np.einsum("bm,bmn->bn", F, J)

    near = projected(uniform) + rng.normal(0.0, 0.05 / np.sqrt(robot.dof), uniform.shape)
    yield Measurement(
        "forward kinematics", "us", lambda: link_poses(robot.kinematics, uniform), STATES
    )
    yield Measurement(
        "projection, 0.05 rad off the manifold", "us", lambda: projected(near), STATES
    )
    yield Measurement("projection, uniform sample", "us", lambda: projected(uniform), STATES)
    yield Measurement("kinematics + residual + gradient, batch of 10 000", "us", gradient, 10_000)


def bench_collision(problem: PlanningProblem, states: int) -> Iterator[Measurement]:
    """State checks of either backend in the kitchen, and of the compiled one against the number of
    obstacles.

    states: random states, and states near contact, in which the two backends are compared.
    """
    rng, robot = np.random.default_rng(0), problem.robot
    space, exact = ConstrainedSpace(problem), problem.collision_checker()
    some = robot.random_configurations(rng, STATES)
    free = some[space.valid_batch(some)]
    yield _state_checks("kitchen, all states", space.arrays, some)
    yield _state_checks("kitchen, free states", space.arrays, free)
    few = free[:1000]
    yield Measurement(
        "kitchen, free states, coal from Python",
        "us",
        lambda: exact.in_collision_batch(few),
        len(few),
    )
    for name, compared in (
        ("random", robot.random_configurations(rng, states)),
        ("near-contact", near_contact(problem, space, rng, states)),
    ):
        ours, theirs = space.valid_batch(compared), ~exact.in_collision_batch(compared)
        missed, alarms = (
            (ours & ~theirs).sum(),
            100.0 * (~ours & theirs).sum() / max(theirs.sum(), 1),
        )
        yield Measurement(f"{name} states: collisions called free, of {states}", "", [missed])
        yield Measurement(f"{name} states: free ones called colliding", "%", [alarms])
    for count in (10, 100, 1000, 10_000):
        # total volume kept: many small or few large
        size = (0.4 * (10.0 / count) ** (1.0 / 3.0),) * 3
        boxes = [
            SceneObject(f"box{i}", Box(size), pose(p)) for i, p in enumerate(_on_shell(count, rng))
        ]
        yield from _crowded(problem, f"{count} boxes", space, Scene("boxes", tuple(boxes)))
    for count in (10**3, 10**4, 10**5, 10**6):
        cloud = SceneObject("cloud", PointCloud(_on_shell(count, rng), 0.005), np.eye(4))
        yield from _crowded(problem, f"cloud of {count} points", space, Scene("cloud", (cloud,)))


def _state_checks(name: str, arrays: Space, states: np.ndarray) -> Measurement:
    out = np.zeros(len(states), dtype=bool)
    return Measurement(
        f"state check: {name}", "us", lambda: states_valid(arrays, states, out), len(states)
    )


def _crowded(
    problem: PlanningProblem, name: str, space: ConstrainedSpace, scene: Scene
) -> Iterator[Measurement]:
    """Building the arrays of many obstacles, once since they are remembered, and checking against
    them.
    """
    began = time.perf_counter()
    geometry = scene_arrays(scene, problem.robot.reach)
    yield Measurement(f"arrays: {name}", "ms", [1e3 * (time.perf_counter() - began)])
    states = problem.robot.random_configurations(np.random.default_rng(1), STATES // 4)
    yield _state_checks(name, space.arrays._replace(scene=geometry), states)


def _on_shell(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points (count, 3) 0.7 to 1.1 m from the shoulder [m]."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * rng.uniform(0.7, 1.1, (count, 1)) + (0.0, 0.0, 0.33)


def near_contact(
    problem: PlanningProblem, space: ConstrainedSpace, rng: np.random.Generator, count: int
) -> np.ndarray:
    """Configurations (count, n) around first contacts, which bisection between random states finds
    [rad].
    """
    found, missing = [np.empty((0, problem.robot.dof))], count
    while missing > 0:
        states = problem.robot.random_configurations(rng, max(2 * missing, 64))
        valid = space.valid_batch(states)
        pairs = min(int(valid.sum()), int((~valid).sum()), missing)
        free, colliding = states[valid][:pairs], states[~valid][:pairs]
        for _ in range(HALVINGS):
            middle = 0.5 * (free + colliding)
            valid = space.valid_batch(middle)[:, None]
            free, colliding = np.where(valid, middle, free), np.where(valid, colliding, middle)
        direction = rng.normal(size=free.shape)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        beside = free + direction * rng.uniform(0.0, NEAR, (pairs, 1))
        found.append(np.clip(beside, problem.robot.lower, problem.robot.upper))
        missing -= pairs
    return np.concatenate(found)
