"""Upright paths between random upright hand poses, in held-out scenes of the training families."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, upright_box
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import phase_problem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import family_scene
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.space import ConstrainedSpace

PANDA = {"name": "panda"}
SCENES_DRAWN = 20  # for a problem, until one holds two states with a blocked straight motion


def held_out_problem(family: str, index: int) -> PlanningProblem | UnsolvableProblem:
    """Problem `index`: the first that scenes index, 8000 + index, 8050 + index, ... allow."""
    # numbers that no other suite and no tuning has used
    spare = range(8000 + index, 8000 + 50 * (SCENES_DRAWN - 1), 50)
    return _first_problem(str(index), family, (index, *spare), PANDA)


def _first_problem(
    name: str, family: str, numbers: Sequence[int], robot_source: Mapping[str, Any]
) -> PlanningProblem | UnsolvableProblem:
    """The problem of the first of these scenes that allows one."""
    for number in numbers:
        found = family_problem(family, number, robot_source)
        if isinstance(found, PlanningProblem):
            return replace(found, name=name)
        reason = found.reason
    return UnsolvableProblem(name, f"{reason}, the last of {len(numbers)} scenes")


def family_problem(
    family: str, number: int, robot_source: Mapping[str, Any] = PANDA, clear: float = 0.001
) -> PlanningProblem | UnsolvableProblem:
    """The problem of a scene: start and goal on the manifold, straight motion between blocked."""
    scene, robot = family_scene(family, number), robot_from_source(robot_source)
    return upright_problem(str(number), robot, scene, np.random.default_rng([number, 7]), clear)


def upright_problem(
    name: str, robot: Robot, scene: Scene, rng: np.random.Generator, clear: float
) -> PlanningProblem | UnsolvableProblem:
    """Problem between a `blocked_pair` of upright states, `clear` [m] from all obstacles."""
    middle = 0.5 * (robot.lower + robot.upper)
    problem = PlanningProblem(name, robot, scene, middle, middle[None], (upright_box(),))
    pair = blocked_pair(problem, rng, clear)
    if pair is None:
        reason = (
            f"no two upright states {clear} m from everything in {scene.name} with a blocked "
            "straight motion"
        )
        return UnsolvableProblem(name, reason)
    return replace(problem, start=pair[0], goals=pair[1][None])


def blocked_pair(
    problem: PlanningProblem,
    rng: np.random.Generator,
    clear: float,
    moved: float = 0.0,
    draws: int = 4000,
    apart: float = 2.0,
    tries: int = 200,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Two states (n,) on the manifold, the straight motion between them blocked.

    Args:
        problem: with the manifold.
        rng: for all draws.
        clear: distance from obstacles [m].
        moved: how far apart their hands are at least [m].
        draws: configurations that are projected.
        apart: how far apart start and goal are at least [rad].
        tries: pairs drawn for one whose straight motion is blocked.
    """
    space = ConstrainedSpace(problem)
    states = problem.robot.random_configurations(rng, draws)
    states = states[[space.project(q) for q in states]]
    states = states[space.valid_batch(states)]
    checker = problem.collision_checker(clear)
    for _ in range(tries if len(states) > 1 else 0):
        start, goal = states[rng.choice(len(states), 2, replace=False)]
        if np.linalg.norm(goal - start) < apart or motion_free(space.arrays, start, goal):
            continue
        if (
            np.linalg.norm(problem.robot.pose(goal)[:3, 3] - problem.robot.pose(start)[:3, 3])
            < moved
        ):
            continue
        if not (checker.in_collision(start) or checker.in_collision(goal)):
            return start, goal
    return None


# Nine arms: between two random upright hand poses, upright all the way, in scenes of every family.
ROBOT_FAMILIES = ("cubes-spheres", "table", "shelves", "kitchen-like")
ROBOTS: Mapping[str, Mapping[str, Any]] = {
    "panda": PANDA,
    "ur5": {"name": "ur5"},
    "ur10": {"name": "ur10"},
    "kinova": {"name": "kinova"},
    "z1": {"name": "z1"},
    "xarm7": {"name": "xarm7"},
    "baxter": {"name": "baxter-left"},
    "talos": {"name": "talos-left-arm"},
    "tiago": {"name": "tiago-no-hand", "base": {"xyz": [0.0, 0.0, -0.6]}},
}
"""Of seven makers: 6 joints (ur5, ur10, kinova, z1), 7, and 7 on a lifting torso (tiago)."""


def robots_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Problem index % 20 of robot index // 20; its rows are named by index and robot."""
    number, k = divmod(index, 20)
    robot = tuple(ROBOTS)[number]
    return replace(other_robot_problem(robot, k), name=phase_problem(str(index), number + 1, robot))


def other_robot_problem(robot: str, index: int) -> PlanningProblem | UnsolvableProblem:
    """Problem `index` of a robot of `ROBOTS`; `pipeline.solve` samples goals from the goal's pose.

    Its scene is the first of 2000 + index, 2020 + index, ... of its family that allows a problem.
    """
    # 2000 to 2399 are numbers that no other suite uses
    first = 2000 + index
    numbers = range(first, first + SCENES_DRAWN * 20, 20)
    found = _first_problem(
        str(index), ROBOT_FAMILIES[index % len(ROBOT_FAMILIES)], numbers, ROBOTS[robot]
    )
    if isinstance(found, UnsolvableProblem):
        return found
    there = TaskSpaceRegion(found.robot.pose(found.goals[0]), np.eye(4), np.zeros((6, 2)))
    return replace(found, goals=np.empty((0, found.robot.dof)), goal_region=there)
