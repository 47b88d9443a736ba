"""Arms beside the Panda: between two random upright hand poses, upright all the way, in scenes of every family.

Problem k stands in a held-out scene of family k modulo their number. The goal is a pose of the hand in any posture
of the arm: from a given posture, those of an elbow manipulator with joints of more than a turn are often cut off.
An arm whose shoulder is higher than the Panda's stands lower, for the scenes are made around the Panda's.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.problem import PlanningProblem
from experiments.suites.family_task import family_problem
from experiments.suites.place_task import UnsolvableProblem

PROBLEMS = range(20)
FIRST_SCENE = 2000  # numbers that no other suite uses
FAMILIES = ("cubes-spheres", "table", "shelves", "kitchen-like")
ROBOTS: Mapping[str, Mapping[str, Any]] = {
    "ur5": {"name": "ur5"},
    "xarm7": {"name": "xarm7"},
    "tiago": {"name": "tiago-no-hand", "base": {"xyz": [0.0, 0.0, -0.6]}},
}
"""6 joints, 7, and 7 on a torso that slides up and down."""


def other_robot_problem(robot: str, index: int) -> PlanningProblem | UnsolvableProblem:
    """Problem `index` of a robot of `ROBOTS`; its goals are sampled by `pipeline.solve`, from the goal's pose."""
    problem = family_problem(FAMILIES[index % len(FAMILIES)], FIRST_SCENE + index, ROBOTS[robot])
    if isinstance(problem, UnsolvableProblem):
        return replace(problem, name=str(index))
    there = TaskSpaceRegion(problem.robot.pose(problem.goals[0]), np.eye(4), np.zeros((6, 2)))
    return replace(problem, name=str(index), goals=np.empty((0, problem.robot.dof)), goal_region=there)
