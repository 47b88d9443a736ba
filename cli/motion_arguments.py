"""The problem of `plan --start --goal`: one motion in free space or among scanned obstacles."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.codec import field_kinds, from_plain
from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.base.files import json_object
from cvqmpt_lab.base.reports import Report
from cvqmpt_lab.cli.options import log, numbers
from cvqmpt_lab.cli.problem_arguments import chosen_robot, configuration, is_function
from cvqmpt_lab.cli.scan_command import scan_entries
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.goals import SAMPLE_MARGIN_M, sample_region
from cvqmpt_lab.constraints.named import (
    NAMED_REGIONS,
    Region,
    RegionForm,
    rpy_of,
    upper_axis,
)
from cvqmpt_lab.constraints.region_constraint import Member
from cvqmpt_lab.features.scan.scan import Arm, Scan, refuse_touching
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene, check_extent
from cvqmpt_lab.scene.scene_files import read_scene


def motion_problem(args: argparse.Namespace) -> PlanningProblem:
    """Return the problem from --start to --goal with the obstacles of --cloud or --scene."""
    if (args.start is None) == (args.start_pose is None) or not (args.goal or args.goal_pose):
        raise InvalidInputError(
            "a motion needs --start Q or --start-pose X,Y,Z,R,P,Y, one of the two, and --goal Q or "
            "--goal-pose X,Y,Z,R,P,Y"
        )
    if args.cloud and args.scene:
        raise InvalidInputError("--cloud and --scene: give one of the two")
    robot = chosen_robot(args)
    start = _start(args, robot)
    goals = [configuration(robot, "--goal", text) for text in args.goal]
    constraint = tuple(constraint_of(text, robot, start) for text in args.constraint)
    if args.scene is not None:
        scene = read_scene(args.scene)
    elif not args.cloud:
        scene = Scene("free space", ())
    else:
        from cvqmpt_lab.features.scan.captures import scene_of_clouds

        arm = Arm(robot, start)
        scene = scene_of_clouds(scanned(args.cloud, arm), args.cloud, arm)
        refuse_touching(scene, arm)
    check_extent(scene, robot.reach, f"scene {args.scene}" if args.scene else "scan")
    return PlanningProblem(
        next((path.stem for path in (args.scene, *args.cloud) if path), "motion"),
        robot,
        scene,
        start=start,
        goals=np.array(goals).reshape(-1, robot.dof),
        constraint=constraint,
        goal_region=args.goal_pose,
    )


def scanned(files: Sequence[Path], arm: Arm) -> Scan:
    """Make a scan of the files of --cloud, and write its report to standard error."""
    from cvqmpt_lab.features.scan.captures import scan_of_clouds  # few plans need it

    made = scan_of_clouds(files, arm)
    log(str(Report.of(tuple(scan_entries(made, files)))))
    return made


def _start(args: argparse.Namespace, robot: Robot) -> np.ndarray:
    """Return the configuration (n,) of --start, or one at --start-pose that is free in --scene."""
    if args.start is not None:
        return configuration(robot, "--start", args.start)
    scene = Scene("none", ()) if args.scene is None else read_scene(args.scene)
    checker = CollisionChecker(robot, scene, margin=SAMPLE_MARGIN_M)
    rng = np.random.default_rng(args.seed)
    found = sample_region(robot, args.start_pose, checker, rng, count=1)
    if len(found.configurations) == 0:
        raise InvalidInputError(f"--start-pose: {found.outcome}; give another pose, or --start Q")
    return found.configurations[0]


def constraint_of(text: str, robot: Robot, start: np.ndarray) -> Member:
    """Return a region of NAME, NAME=VALUE (VALUE: its first field) or json, or a function.

    Args:
        text: the option's value.
        robot: the robot.
        start: (n,) where the hand has the orientation that some regions keep [rad or m].
    """
    if is_function(text):
        from cvqmpt_lab.constraints.function_files import function_given  # few commands have one

        return function_given(text)
    if text.lstrip().startswith("{"):
        return RegionForm(with_functions=True).read(
            json_object(text, "--constraint"), "--constraint"
        )
    name, _, value = text.partition("=")
    require_choice("--constraint", name, NAMED_REGIONS)
    fields: dict[str, Any] = {}
    if name in ("upright", "upright-box"):
        fields["axis"] = upper_axis(robot.pose(start))
    if name == "fixed-orientation":
        fields["rpy"] = rpy_of(robot.pose(start)[:3, :3]).tolist()
    if name == "relative-pose":
        hand = next((hand for hand in robot.end_effectors if hand != value), None)
        if hand is None:
            raise InvalidInputError(
                f"--constraint {text}: robot {robot.name} has one end effector; name two "
                "in a robot file: cvqmpt robot NAME --end-effectors LEFT RIGHT --out robot.json"
            )
        require_choice("--constraint relative-pose=HAND", value, robot.end_effectors)
        at = np.linalg.inv(robot.pose(start, value)) @ robot.pose(start, hand)
        held = {name: {"base": value, "at": at.tolist()}, "end_effector": hand}
        return from_plain(Region, held, "--constraint")
    if value:
        given = numbers("--constraint", value, () if "," in value else ("VALUE",))
        fields[next(iter(field_kinds(NAMED_REGIONS[name])))] = given if len(given) > 1 else given[0]
    return RegionForm(with_functions=True).read({name: fields}, "--constraint")
