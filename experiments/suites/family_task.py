"""Held-out scenes of the training families: move between two random upright hand poses, upright all the way.

Scene numbers below FIRST_SCENE of `training_data` occur in no dataset.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from cvqmpt_lab.constraints.task_space_region import upright
from cvqmpt_lab.kernels.search.motion import motion_free
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.scene.families import family_scene
from experiments.suites.place_task import UnsolvableProblem

PANDA = {"name": "panda"}
PROBLEMS = range(50)
DRAWS = 4000  # configurations drawn for start and goal
APART = 2.0  # [rad] start and goal at least
CLEAR = 0.001  # [m] that start and goal keep from obstacles
TRIES = 200  # pairs looked at for one whose straight motion is blocked


def family_problem(
    family: str, number: int, robot_source: Mapping[str, Any] = PANDA
) -> PlanningProblem | UnsolvableProblem:
    """The problem of one scene: a start and a goal on the manifold, the straight motion between them blocked."""
    scene = family_scene(family, number)
    robot = robot_from_source(robot_source)
    middle = 0.5 * (robot.lower + robot.upper)
    problem = PlanningProblem(str(number), robot, scene, middle, middle[None], (upright(),))
    pair = blocked_pair(problem, np.random.default_rng([number, 7]), CLEAR)
    if pair is None:
        return UnsolvableProblem(
            str(number), f"no two upright free states of {scene.name} with a blocked straight motion"
        )
    return replace(problem, start=pair[0], goals=pair[1][None])


def blocked_pair(
    problem: PlanningProblem, rng: np.random.Generator, clear: float, moved: float = 0.0, draws: int = DRAWS
) -> tuple[np.ndarray, np.ndarray] | None:
    """Two states (n,) on the manifold, `clear` [m] from all obstacles, the straight motion between them blocked.

    moved: how far apart their hands are at least [m]. draws: configurations that are projected.
    """
    space = ConstrainedSpace(problem)
    states = problem.robot.random_configurations(rng, draws)
    states = states[[space.project(q) for q in states]]
    states = states[space.valid_batch(states)]
    checker = problem.collision_checker(clear)
    for _ in range(TRIES if len(states) > 1 else 0):
        start, goal = states[rng.choice(len(states), 2, replace=False)]
        if np.linalg.norm(goal - start) < APART or motion_free(space.arrays, start, goal):
            continue
        if np.linalg.norm(problem.robot.pose(goal)[:3, 3] - problem.robot.pose(start)[:3, 3]) < moved:
            continue
        if not (checker.in_collision(start) or checker.in_collision(goal)):
            return start, goal
    return None
