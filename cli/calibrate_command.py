"""`cvqmpt calibrate`: where a depth camera stands, from the arm that it sees and a rough guess."""

import argparse
from pathlib import Path

import numpy as np

from cli.motion_options import configuration
from cli.options import writable_file
from cli.robot_options import add_robot, chosen_robot
from cvqmpt_lab.errors import whole_number
from cvqmpt_lab.files import json_text, write_text
from cvqmpt_lab.sensing.calibration import calibrate
from cvqmpt_lab.sensing.camera_files import read_extrinsics
from cvqmpt_lab.sensing.depth import read_capture
from cvqmpt_lab.sensing.scan import Arm

EXAMPLES = (
    "cvqmpt calibrate scan.pcd --guess rough.json --arm-at 0,-0.8,0,-2.4,0,1.6,0.8 --out cam.json",
    "cvqmpt calibrate depth.png --intrinsics lens.yaml --guess rough.json --arm-at "
    "0,-0.8,0,-2.4,0,1.6,0.8",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What the camera saw, where it may stand, the arm, where to."""
    add = parser.add_argument
    add("file", type=Path, help="a cloud in the camera's frame, or a depth image")
    add("--intrinsics", type=Path, metavar="LENS.json|yaml", help="of a depth image")
    guess = "T_world_camera, at most about 10 cm and 10 deg wrong: x right, y down, z ahead"
    add("--guess", type=Path, required=True, metavar="CAM.json|yaml", help=guess)
    add(
        "--arm-at",
        required=True,
        metavar="Q1,...,QN",
        help="the arm's configuration meanwhile [rad or m]",
    )
    add("--out", type=Path, metavar="CAM.json", help="write T_world_camera, if it is trusted")
    add("--seed", type=int, default=0, help="seed of all randomness (0)")
    add_robot(parser, "the robot in the picture (panda)")


def run(args: argparse.Namespace) -> int:
    """Align, report, write; exit code 1 when the result is not trusted."""
    whole_number("--seed", args.seed)
    if args.out:
        writable_file(args.out)
    robot = chosen_robot(args)
    arm = Arm(robot, configuration(robot, "--arm-at", args.arm_at))
    points = read_capture(args.file, args.intrinsics).points
    found = calibrate(points, read_extrinsics(args.guess), arm, np.random.default_rng(args.seed))
    print(
        f"{found.moved_metres * 1e3:.0f} mm and {found.moved_degrees:.1f} deg from the guess; "
        f"points on the arm lie "
        f"{1e3 * found.residual:.1f} mm from its surface, {100 * found.confirmed:.0f} % of what "
        f"is in view of it is "
        f"where it should be, its position is known to {1e3 * found.deviation:.1f} mm"
    )
    for doubt in found.doubts:
        print(f"not trusted: {doubt}")
    text = json_text({"T_world_camera": found.T_world_camera.tolist()}) + "\n"
    if found.doubts or args.out is None:
        print(text, end="")
    else:
        write_text(args.out, text)
        print(f"written to {args.out}")
    return 1 if found.doubts else 0
