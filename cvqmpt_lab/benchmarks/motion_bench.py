"""MotionBenchMaker: 700 problems each of a Panda, a UR5 and a Fetch, in scenes that others made.

Robots are those of the set: the UR5 stands 0.91 m up with a gripper, and the Fetch, whose torso
lifts, is in no package of ours. See `motion_bench_archive`.
"""

from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np

from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.motion_bench_archive import problem_texts, robot_file
from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, sample_region
from cvqmpt_lab.constraints.named import upper_axis
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    RegionConstraint,
    symmetric_region,
    upright,
)
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import yaml_value
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import FailReason, phase_problem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.moveit_scenes import scene_of_yaml

HANDS = {"panda": "panda_hand", "ur5": "tool0", "fetch": "gripper_link"}  # end effectors
SETS = (
    *("bookshelf_small", "bookshelf_tall", "bookshelf_thin", "box", "cage"),
    *("table_pick", "table_under_pick"),
)


def motion_bench_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Problem index % 100 of set index // 100 % 7 of robot index // 700, one start to one goal.

    Its rows are named by index and robot. Unsolvable where start or goal collide in our model.
    """
    number, place = divmod(index, 100 * len(SETS))
    robot, scenes = tuple(HANDS)[number], SETS[place // 100]
    name, number_in_set = phase_problem(str(index), number + 1, robot), f"{place % 100 + 1:04d}"
    texts = problem_texts(robot)
    scene, request = (texts[f"{scenes}/{kind}{number_in_set}"] for kind in ("scene", "request"))
    problem = problem_of_texts(
        name, bench_robot(robot), f"{scenes}/{number_in_set}", scene, request
    )
    checker = problem.collision_checker(0.0)
    ends = (
        ("start", FailReason.INVALID_START, problem.start),
        ("goal", FailReason.INVALID_GOAL, problem.goals[0]),
    )
    for end, kind, q in ends:
        if checker.in_collision(q):
            said = f"{problem.scene.name}: the {end} collides, {checker.contact(q)}"
            return UnsolvableProblem(name, said, kind)
    return problem


@lru_cache(maxsize=8)
def bench_robot(robot: str) -> Robot:
    """A robot of the set, as its archive describes it."""
    urdf, srdf = (str(robot_file(robot, f"{robot}.{end}")) for end in ("urdf", "srdf"))
    return robot_from_source({"urdf": urdf, "srdf": srdf, "end_effector": HANDS[robot]})


def problem_of_texts(
    name: str, robot: Robot, scene_name: str, scene: str, request: str
) -> PlanningProblem:
    """The problem of a scene and a motion request of MoveIt, both yaml.

    Joints are looked up by name; values up to 1e-5 beyond a limit are moved to it: requests state
    joints that turn without end, which the robot's file bounds by 3.14159 rad.
    """
    asked = yaml_value(request)
    try:
        begin = asked["start_state"]["joint_state"]
        start = dict(zip(begin["name"], begin["position"], strict=True))
        bounds = asked["goal_constraints"][0]["joint_constraints"]
        goal = {bound["joint_name"]: bound["position"] for bound in bounds}
        ends = np.array([[float(end[j]) for j in robot.joint_names] for end in (start, goal)])
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InvalidInputError(f"request of {scene_name} is not readable: {error}") from error
    inside = np.clip(ends, robot.lower, robot.upper)
    ends = np.where(np.abs(ends - inside) <= 1e-5, inside, ends)
    found = scene_of_yaml(scene, Path(f"{scene_name}.yaml"))
    return PlanningProblem(name, robot, replace(found, name=scene_name), ends[0], ends[1:])


def level_problem(index: int, tilt: float = 0.1) -> PlanningProblem | UnsolvableProblem:
    """The same with a level hand: its axis that points up at the goal points up all the way.

    The start is the given one where the hand is level there; else one with the hand at the same
    place, or within 0.1 or 0.3 m of it, found around the given start or anywhere.

    Args:
        index: as in `motion_bench_problem`.
        tilt: largest angle between axis and vertical [rad].
    """
    found = motion_bench_problem(index)
    if isinstance(found, UnsolvableProblem):
        return found
    robot, checker = found.robot, found.collision_checker(SAMPLE_MARGIN)
    level = upright(tilt, upper_axis(robot.pose(found.goals[0])))
    apart = RegionConstraint(robot, (level,))
    if np.linalg.norm(apart.residual(found.goals[0])) > 0.0:
        reason = f"{found.scene.name}: no axis of the hand points up at the goal"
        return UnsolvableProblem(found.name, reason, FailReason.NO_GOAL)
    if np.linalg.norm(apart.residual(found.start)) == 0.0:
        return found.changed(constraint=(level,))
    here = pose(robot.pose(found.start)[:3, 3])
    for reach, near in product((0.0, 0.1, 0.3), (found.start, None)):
        there = symmetric_region(here, np.eye(4), [reach] * 3 + [FREE] * 3)
        rng = np.random.default_rng([index, 45])
        drawn = sample_region(robot, there, checker, rng, 1, 50, (level,), near, project=True)
        if len(drawn.configurations):
            return found.changed(constraint=(level,), start=drawn.configurations[0])
    reason = f"{found.scene.name}: no level hand near the start's place, {drawn.outcome}"
    return UnsolvableProblem(found.name, reason, FailReason.NO_START)
