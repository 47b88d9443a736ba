"""`cvqmpt follow`: a motion of the hand along straight lines through poses."""

import argparse
import csv
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, few, located
from cvqmpt_lab.base.files import csv_table, read_json_object, read_text, write_text
from cvqmpt_lab.base.poses import Placement
from cvqmpt_lab.base.values import bound_text
from cvqmpt_lab.cli.options import FLAG, SEED, Options, file_of_kind, log, one_or_two, option
from cvqmpt_lab.cli.problem_arguments import chosen_robot, configuration, named_file
from cvqmpt_lab.cli.problem_options import ROBOT
from cvqmpt_lab.features.lines.follow_lines import Leg, follow_lines, rests, timed
from cvqmpt_lab.features.motion.timing import TimingSettings
from cvqmpt_lab.features.motion.trajectory import save_trajectory
from cvqmpt_lab.robot.robot import SLOW_SPEED
from cvqmpt_lab.scene.scene import NamedScene, Scene, refuse_far_poses
from cvqmpt_lab.scene.scene_files import read_scene, with_files_read


def run(args: argparse.Namespace) -> int:
    """Plan, certify, write and print; return 0, or 2 where a line cannot be followed."""
    if args.speed is not None and args.trajectory is None:
        raise InvalidInputError(f"--speed {args.speed:g} goes with --trajectory OUT.csv; give it")
    args.speed = SLOW_SPEED if args.speed is None else args.speed
    file = None if args.file is None else named_file(str(args.file))
    robot = chosen_robot(args, file)
    scene = _scene(args.scene, file)
    start = None if args.start is None else configuration(robot, "--start", args.start, file)
    poses = poses_of(args.poses)
    metres, radians = [*args.tolerance, 0.01][:2]
    legs = follow_lines(robot, scene, poses, metres, radians, start, args.seed)
    states = np.concatenate([legs[0].path.states, *(leg.path.states[1:] for leg in legs[1:])])
    lines = [
        f"line {k} to {k + 1}  {leg.path.length:.2f} rad, {len(leg.path.states)} states; certified "
        f"{leg.line.describe()}"
        for k, leg in enumerate(legs)
    ]
    if args.out is not None:
        write_text(args.out, csv_table([robot.joint_names, *states.tolist()]))
        lines.append(f"path         {len(states)} states written to {args.out}")
    untimed: CvqmptError | OSError | None = None
    if args.trajectory is not None:
        try:
            lines.append(_write_motion(args.trajectory, legs, args.speed))
        except (CvqmptError, OSError) as error:
            untimed = error  # the certified lines are told first
    told = {"joint_names": robot.joint_names, "states": states.tolist(), "certified": True}
    print(json.dumps(told) if args.json else "\n".join(lines))
    if untimed is not None:
        raise untimed
    return 0


def _write_motion(path: Path, legs: Sequence[Leg], speed: float) -> str:
    """Time the legs, write the motion and return the line to print."""
    motion = timed(legs, TimingSettings(speed=speed))
    save_trajectory(motion, path)
    poses = [str(k) for k in rests(legs, motion)]
    rest = f"at rest at {'pose' if len(poses) == 1 else 'poses'} {few(poses, 8)}"
    through = f"{rest}, where no motion through was certified" if poses else "without a rest"
    return (
        f"trajectory   {motion.duration:.2f} s at {speed:g} of the joint limits, "
        f"{through if len(legs) > 1 else 'one line'}, at most "
        f"{bound_text(motion.deviation, up=True)} rad off the path, certified; written to {path}"
    )


def _scene(path: Path | None, file: Path | None) -> Scene:
    """Return the obstacles of --scene, or else of a problem or task file, or none."""
    if path is not None:
        return read_scene(path)
    if file is None:
        return Scene("free space", ())
    with located(f"{file}"):
        data = with_files_read(read_json_object(file, "problem file"), file.parent)
        unused = [name for name in ("constraint", "attachments") if data.get(name)]
        if unused:
            log(f"{file}: {' and '.join(unused)} are not used; only robot and scene are")
        return from_plain(NamedScene, data.get("scene"), "scene")


def poses_of(path: Path) -> list[np.ndarray]:
    """Return the poses (4, 4) of a csv file: x, y, z and roll, pitch, yaw, or a quaternion."""
    rows = [row for row in csv.reader(read_text(path).splitlines()) if row]
    found = []
    for k, row in enumerate(rows):
        try:
            values = [float(cell) for cell in row]
        except ValueError as error:
            if k == 0 and not any(cell.strip()[:1] in {*"+-.0123456789"} for cell in row):
                continue  # a header; a number may be misspelt
            raise InvalidInputError(f"{path}: line {k + 1} is {row}; give numbers") from error
        if len(values) not in (6, 7):
            raise InvalidInputError(
                f"{path}: line {k + 1} has {len(values)} numbers; give x, y, z, roll, pitch, yaw "
                "[m, rad], or x, y, z and a quaternion x, y, z, w"
            )
        x, y, z, a, b, c, *w = values
        with located(f"{path}: line {k + 1}"):
            placed = Placement((x, y, z), quaternion=(a, b, c, w[0])) if w else None
            found.append((placed or Placement((x, y, z), rpy=(a, b, c))).matrix)
        refuse_far_poses({f"{path}: line {k + 1}": found[-1]})
    return found


OPTIONS: Options = {
    "poses": option(
        "poses of the end effector in order, one a line: x, y, z and roll, pitch, yaw, or a "
        "quaternion x, y, z, w [m, rad]",
        type=Path,
        metavar="POSES.csv",
    ),
    "file": option(
        "problem or task file with the robot and the obstacles",
        type=Path,
        nargs="?",
        metavar="FILE",
    ),
    **ROBOT,
    "--scene": option("obstacles (those of the file, or none)", type=Path, metavar="S.json"),
    "--start": option(
        "configuration at the first pose, numbers separated by commas, or start or goal of the "
        "file (any that is free)",
        metavar="Q",
    ),
    "--tolerance": option(
        "largest distance from the lines, and largest angle from the orientation interpolated "
        "along them, each above 0.0005 (0.002,0.01)",
        type=partial(one_or_two, "--tolerance", "M or M,RAD, above 0.0005"),
        default=[0.002],
        metavar="M[,RAD]",
    ),
    "--out": option(
        "write the states", type=partial(file_of_kind, "--out", (".csv",)), metavar="PATH.csv"
    ),
    "--trajectory": option(
        "write a fast motion within --speed, which rests at a pose only where it must",
        type=partial(file_of_kind, "--trajectory", (".csv", ".json")),
        metavar="OUT.csv|OUT.json",
    ),
    "--speed": option(
        "fraction of the joint limits that --trajectory uses (0.1)",
        type=float,
        metavar="FACTOR",
    ),
    **SEED,
    "--json": option("print one json object instead of the report", **FLAG),
}
COMMANDS = {"follow": (run, OPTIONS)}
