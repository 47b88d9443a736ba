"""Random arms and problems for them, made once a process each."""

import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import load_robot
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import random_scene
from experiments.trust.random_robots import TOOL, random_urdf

ARMS = 12
"""How many arms are drawn from: loading one takes longer than a trial with it."""
WIDTHS = (0.0, 2e-4, 0.1, 1.0, np.inf)
"""Half widths of regions [m, rad]."""


@lru_cache(maxsize=ARMS)
def arm(number: int) -> Robot:
    """Arm `number` modulo ARMS: two to nine joints, hinges and sliders."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        path.write_text(random_urdf(np.random.default_rng(number % ARMS)))
        return load_robot(path, TOOL)


def problem_around(seed: int) -> PlanningProblem | None:
    """A random arm in a random scene, in a region around its start, with a goal in that region; None if blocked."""
    rng = np.random.default_rng(seed)
    robot, scene = arm(seed % ARMS), random_scene(seed % 1000, n_cubes=int(rng.integers(4)), n_spheres=2)
    start = robot.random_configurations(rng, 1)[0]
    halves = rng.choice(WIDTHS[2:], 6)
    region = TaskSpaceRegion(robot.pose(start), np.eye(4), np.stack([-halves, halves], axis=1))
    problem = PlanningProblem("random", robot, scene, start, start[None], constraint=(region,))
    checker = problem.collision_checker()
    for q in robot.random_configurations(rng, 20):
        goal = problem.manifold.project(q)
        if goal is not None and not checker.in_collision(goal) and not checker.in_collision(start):
            return problem.with_goals(goal[None])
    return None
