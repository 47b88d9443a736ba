"""Options that describe one motion as a problem file does: start, goals and constraint."""

import argparse
from functools import partial
from typing import Any

import numpy as np

from cli.options import REPEATED, Options, log, numbers, option
from cli.problem_options import chosen_robot, configuration, pose_region
from cli.scan_command import scan_of, scan_report, scene_of
from cvqmpt_lab.codec import field_kinds, from_plain
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, sample_region
from cvqmpt_lab.constraints.named import NAMED, Region, upper_axis
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.errors import InvalidInputError, require_choice
from cvqmpt_lab.files import json_object
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene, refuse_far, report_out_of_reach
from cvqmpt_lab.scene.scene_files import read_scene
from cvqmpt_lab.sensing.scan import Arm, Scan, refuse_touching

MOTION: Options = {
    "one motion among the obstacles of --cloud or --scene, instead of a suite or a problem file": {
        "--start": option("configuration, numbers separated by commas [rad or m]", metavar="Q"),
        "--goal": option(
            "goal configuration; repeatable: the path ends at any of them", metavar="Q", **REPEATED
        ),
        "--start-pose": option(
            "end-effector pose at the start instead of --start, as --goal-pose",
            type=partial(pose_region, "--start-pose"),
            metavar="X,Y,Z,R,P,Y",
        ),
        "--goal-pose": option(
            "end-effector pose to reach instead: x, y, z [m], roll, pitch, yaw [rad]",
            type=partial(pose_region, "--goal-pose"),
            metavar="X,Y,Z,R,P,Y",
        ),
        "--constraint": option(
            f"{', '.join(NAMED)} (the first three keep how the end effector is oriented at the "
            "start, relative-pose=HAND how the other one is held to that one), or a region as "
            "json; repeatable",
            metavar="NAME[=VALUE]|JSON",
            **REPEATED,
        ),
    }
}


def motion_given(args: argparse.Namespace) -> bool:
    """Whether start, goal or constraint are given."""
    return any((args.start, args.start_pose, args.goal, args.goal_pose, args.constraint))


def motion_problem(args: argparse.Namespace) -> PlanningProblem:
    """The problem of the options: from --start to --goal, obstacles from --cloud or --scene."""
    if (args.start is None) == (args.start_pose is None) or not (args.goal or args.goal_pose):
        raise InvalidInputError(
            "a motion needs --start Q or --start-pose X,Y,Z,R,P,Y, one of the two, and --goal Q or "
            "--goal-pose X,Y,Z,R,P,Y"
        )
    if bool(args.cloud) == bool(args.scene):
        raise InvalidInputError(
            "--start and --goal need obstacles: give --cloud or --scene, one of the two"
        )
    robot = chosen_robot(args)
    start = _start(args, robot)
    goals = [configuration(robot, "--goal", text) for text in args.goal]
    constraint = tuple(_constraint(text, robot, start) for text in args.constraint)
    if args.scene is not None:
        scene = read_scene(args.scene)
        refuse_far(scene, f"scene {args.scene}")
        report_out_of_reach(scene, robot.reach)
    else:
        arm = arm_of(args, robot, start)
        scene = scene_of(args, scanned(args, arm), arm)
        refuse_touching(scene, Arm(robot, start))
    return PlanningProblem(
        (args.scene or args.cloud[0]).stem,
        robot,
        scene,
        start=start,
        goals=np.array(goals).reshape(-1, robot.dof),
        constraint=constraint,
        goal_region=args.goal_pose,
    )


def _start(args: argparse.Namespace, robot: Robot) -> np.ndarray:
    """The configuration (n,) of --start, or one at --start-pose that touches nothing of --scene."""
    if args.start is not None:
        return configuration(robot, "--start", args.start)
    scene = Scene("none", ()) if args.scene is None else read_scene(args.scene)
    checker = CollisionChecker(robot, scene, margin=SAMPLE_MARGIN)
    rng = np.random.default_rng(args.seed)
    found = sample_region(robot, args.start_pose, checker, rng, count=1)
    if len(found.configurations) == 0:
        raise InvalidInputError(f"--start-pose: {found.outcome}; give another pose, or --start Q")
    return found.configurations[0]


def scanned(args: argparse.Namespace, arm: Arm) -> Scan:
    """Make a scan of the files of --cloud, and write its report to standard error."""
    made = scan_of(args, args.cloud, arm.robot, arm)
    log("\n".join(scan_report(made, args.cloud)))
    return made


def arm_of(args: argparse.Namespace, robot: Robot, q: np.ndarray) -> Arm:
    """The robot during the scan: at --arm-at, else at q (n,)."""
    return Arm(robot, q if args.arm_at is None else configuration(robot, "--arm-at", args.arm_at))


def _constraint(text: str, robot: Robot, start: np.ndarray) -> TaskSpaceRegion:
    """A region from NAME, NAME=VALUE with a value for the region's first field, or json."""
    if text.lstrip().startswith("{"):
        return from_plain(Region, json_object(text, "--constraint"), "--constraint")
    name, _, value = text.partition("=")
    require_choice("--constraint", name, NAMED)
    fields: dict[str, Any] = {}
    if name in ("upright", "upright-box"):
        fields["axis"] = upper_axis(robot.pose(start))
    if name == "fixed-orientation":
        from scipy.spatial.transform import Rotation  # takes 0.3 s to import

        fields["rpy"] = Rotation.from_matrix(robot.pose(start)[:3, :3]).as_euler("xyz").tolist()
    if name == "relative-pose":
        hand = next((hand for hand in robot.end_effectors if hand != value), None)
        if hand is None:
            raise InvalidInputError(
                f"--constraint {text}: robot {robot.name} has one end effector; name two, "
                "--end-effectors LEFT RIGHT"
            )
        require_choice("--constraint relative-pose=HAND", value, robot.end_effectors)
        at = np.linalg.inv(robot.pose(start, value)) @ robot.pose(start, hand)
        held = {name: {"base": value, "at": at.tolist()}, "end_effector": hand}
        return from_plain(Region, held, "--constraint")
    if value:
        fields[next(iter(field_kinds(NAMED[name])))] = numbers("--constraint", value, ("VALUE",))[0]
    return from_plain(Region, {name: fields}, "--constraint")
