"""`cvqmpt scan`: depth images or clouds in; a clean cloud or scene, and a picture out."""

import argparse
from pathlib import Path

from cli.motion_options import configuration
from cli.options import REPEATED, Options, option, writable_file
from cli.problem_options import ROBOT, chosen_robot
from cli.scan_options import SCAN, scan_of, scan_report, scene_of
from cvqmpt_lab.codec import to_plain
from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.files import json_text, write_text
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.cloud_files import HEADERS, write_cloud
from cvqmpt_lab.sensing.scan import Arm, refuse_touching
from cvqmpt_lab.show.picture import draw_world

SCENE = ".json"


def run(args: argparse.Namespace) -> int:
    """Read, clean, report, write."""
    for path in filter(None, (*args.out, args.picture)):
        writable_file(path)
    for path in args.out:
        if path.suffix not in (SCENE, *HEADERS):
            raise UnknownChoiceError(f"--out {path}: suffix", path.suffix, (SCENE, *HEADERS))
    robot = chosen_robot(args)
    arm = None if args.arm_at is None else Arm(robot, configuration(robot, "--arm-at", args.arm_at))
    made = scan_of(args, args.files, arm)
    scene = scene_of(args, made, arm)
    if arm is not None:
        refuse_touching(scene, arm)
    print("\n".join(scan_report(made, args.files)))
    for path in args.out:
        if path.suffix == SCENE:
            write_text(path, json_text(to_plain(scene)) + "\n")
        else:
            write_cloud(path, made.points)
        print(f"written to {path}")
    if args.picture:
        q = 0.5 * (robot.lower + robot.upper) if arm is None else arm.q
        draw_world(PlanningProblem("scan", robot, scene, start=q, goals=q[None]), args.picture)
        print(f"picture written to {args.picture}")
    return 0


OPTIONS: Options = {
    "files": option(
        "clouds (pcd, ply, npy, xyz) or depth images (png, npy)",
        nargs="+",
        type=Path,
        metavar="FILE",
    ),
    "--out": option(
        "the cleaned cloud, or as json a scene for plan --scene; repeatable",
        type=Path,
        metavar="OUT.pcd|ply|npy|json",
        **REPEATED,
    ),
    "--picture": option("what is left, and the robot", type=Path, metavar="P.png"),
    **SCAN,
    "the robot whose points go (panda)": ROBOT,
}
COMMANDS = {"scan": (run, OPTIONS)}
