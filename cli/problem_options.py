"""Options for problem, robot, budget, scan and margin; `problem_arguments` reads them.

It imports no robot, so that help texts appear at once: names and defaults of the library stand here
again, and tests/cli/test_startup.py compares them.
"""

import contextlib
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.base.files import Modules
from cvqmpt_lab.cli.options import (
    FLAG,
    REPEATED,
    Options,
    not_negative,
    not_negative_int,
    numbers,
    one_or_two,
    option,
    positive,
    positive_int,
)
from cvqmpt_lab.search.work import PRICES

if TYPE_CHECKING:
    from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion

PRICES_USED = "published"
DEFAULT_MARGIN = 0.002, 0.005  # [m], [rad]


def _placement(option: str, text: str) -> dict[str, Any]:
    """Return the pose of --base or --tool."""
    x = numbers(option, text)
    if len(x) not in (3, 6):
        raise InvalidInputError(f"{option} {text!r}: write X,Y,Z or X,Y,Z,ROLL,PITCH,YAW [m, rad]")
    return {"xyz": x[:3], "rpy": x[3:] or None}


def _limits(option: str, text: str) -> float | list[float]:
    """Return the numbers of an option of limits, or a single one."""
    limits = numbers(option, text)
    return limits[0] if len(limits) == 1 else limits


def _margin(text: str) -> tuple[float, float]:
    """Return the margins of --margin [m], [rad]."""
    given = list[float]()
    with contextlib.suppress(ValueError):
        given = [float(word) for word in text.split(",")]
    if len(given) not in (1, 2):
        raise InvalidInputError(f"--margin {text!r}: write M or M,RAD [m, rad]")
    return given[0], given[1] if len(given) > 1 else DEFAULT_MARGIN[1]


def _cost(text: str) -> tuple[float, str]:
    """Return the limit and the name of its prices, of --cost."""
    limit, colon, prices = text.partition(":")
    name = prices if colon else PRICES_USED
    name = prices if colon else PRICES_USED
    return positive(limit), require_choice("prices of --cost", name, PRICES)


def _locked_joint(text: str) -> tuple[str, float]:
    """Return joint and value of one --lock."""
    joint, _, value = text.rpartition("=")
    with contextlib.suppress(ValueError):
        if joint and math.isfinite(float(value)):
            return joint, float(value)
    raise InvalidInputError(f"--lock {text!r}: write JOINT=VALUE with a finite number [rad or m]")


ROBOT_DETAILS: Options = {  # of `cvqmpt robot`, which writes them into a robot file
    "--end-effector": option("frame that constraint and goals refer to", metavar="FRAME"),
    "--end-effectors": option(
        "several such frames, planned together; every region names its frame",
        nargs="+",
        default=[],
        metavar="FRAME",
    ),
    "--srdf": option(
        "file with pairs of links that are not checked for collision", type=Path, metavar="ARM.srdf"
    ),
    "--package-dir": option(
        "folder of package:// meshes, before those of ROS_PACKAGE_PATH and AMENT_PREFIX_PATH; "
        "repeatable",
        type=Path,
        metavar="DIR",
        **REPEATED,
    ),
    "--lock": option(
        "fix a joint [rad or m]; repeatable", type=_locked_joint, metavar="JOINT=VALUE", **REPEATED
    ),
    "--base": option(
        "pose of the base: position [m], roll, pitch and yaw [rad]",
        type=partial(_placement, "--base"),
        metavar="X,Y,Z[,ROLL,PITCH,YAW]",
    ),
    "--tool": option(
        "pose of a tool in the end-effector frame E: position [m], roll, pitch and yaw [rad]; the "
        "hand, to which constraint, goals and loads refer, is then the frame E/tool, and the name "
        "E means the link",
        type=partial(_placement, "--tool"),
        metavar="X,Y,Z[,ROLL,PITCH,YAW]",
    ),
    "--joint-limits": option(
        "limits from MoveIt's joint_limits.yaml, which replace others",
        type=Path,
        metavar="F.yaml",
    ),
    "--velocity": option(
        "velocity limits, one per joint or one for all [rad/s or m/s] (those of the URDF, where 0 "
        "stands for none)",
        type=partial(_limits, "--velocity"),
        metavar="V[,V...]",
    ),
    "--hard-limits": option(
        "plan to the joint limits, beyond the soft ones of the URDF's safety_controller", **FLAG
    ),
    "--visual-as-collision": option(
        "links without a collision body get their visual bodies", **FLAG
    ),
    "--skip-missing-meshes": option(
        "plan without the collision bodies whose mesh is not found; reports and certificates name "
        "them",
        **FLAG,
    ),
    "--acceleration": option(
        "acceleration limits, one per joint or one for all [rad/s^2 or m/s^2]; required for a "
        "timed motion if neither robot nor file has acceleration limits",
        type=partial(_limits, "--acceleration"),
        metavar="A[,A...]",
    ),
    "--jerk": option(
        "jerk limits, one per joint or one for all [rad/s^3 or m/s^3] (default: known for the "
        "panda, else none)",
        type=partial(_limits, "--jerk"),
        metavar="J[,J...]",
    ),
    "--effort": option(
        "effort limits, one per joint or one for all [Nm or N] (default: those of the URDF if they "
        "are plausible)",
        type=partial(_limits, "--effort"),
        metavar="E[,E...]",
    ),
    "--tool-speed": option(
        "largest speed of the end effectors, and perhaps their largest turning speed (unlimited): "
        "motions keep it, certificates check it; a fraction of the joint limits does not scale it "
        "[m/s, rad/s]",
        type=partial(one_or_two, "--tool-speed", "V or V,W, above 0 [m/s, rad/s]"),
        metavar="V[,W]",
    ),
    "--bodies": option(
        "what is drawn of the robot: its visual meshes, or the convex hulls that can collide "
        "(visual)",
        choices=("visual", "hulls"),
    ),
}
CODE: Options = {
    "--allow-code": option(
        "let files start code: constraint functions that a problem file names, xacro in a URDF, "
        "and the package of a robot rd:NAME",
        **FLAG,
    )
}
ROBOT: Options = {
    "--robot": option(
        "an arm by name (panda, ur5, xarm7, ...; cvqmpt robot lists them), a URDF file, or a robot "
        "file that cvqmpt robot wrote",
        metavar="NAME|URDF|robot.json",
    ),
    **CODE,
}
FUNCTIONS: Options = {
    "--constraint": option(
        "add a constraint function of your own to the problem, or json with its address and "
        "fields, such as bounds lower and upper; repeatable",
        metavar="MODULE:F|JSON",
        **REPEATED,
    ),
}
PROBLEM: Options = {
    "suite": option(
        "a suite (cvqmpt problems list), or a problem or task file", nargs="?", metavar="SUITE|FILE"
    ),
    "--problem": option("index of a problem of the suite (0)", type=int, default=0, metavar="I"),
    **FUNCTIONS,
    **CODE,
    "--clearance": option(
        "least distance of the robot and its load to obstacles, for planning and certificate (0, "
        "or that of the file); for a task, a margin",
        type=not_negative,
        metavar="M",
    ),
}

REGIONS: Options = {  # replaces PROBLEM's option in commands with --start and --goal
    "--constraint": option(
        f"for --start and --goal: {', '.join(Modules('constraints/by_name'))} "
        "(upright, upright-box and fixed-orientation keep the end effector's orientation at the "
        "start, relative-pose=HAND keeps the other hand's pose relative to HAND, look-at=X,Y,Z "
        "keeps a point ahead of it), or a region as json; for any problem: module:F, a constraint "
        "function of your own; repeatable",
        metavar="NAME[=VALUE]|JSON|MODULE:F",
        **REPEATED,
    ),
}


BUDGET: Options = {
    "--cutoff": option("give up after S seconds (10)", type=positive, metavar="S"),
    "--iterations": option(
        "give up after N iterations; results repeat bit for bit", type=positive_int, metavar="N"
    ),
    "--cost": option(
        "give up when state checks, projections and Newton steps cost S seconds of the paper's "
        f"(results repeat bit for bit); prices: {', '.join(PRICES)} (published)",
        type=_cost,
        metavar="S[:PRICES]",
    ),
    "--backend": option("collision backend: compiled, exact (compiled)", default="compiled"),
}


def optimize_option(default: str = "") -> Options:
    """Return the option --optimize; `default` is appended to its help text."""
    text = (
        "spend S seconds more on a shorter path (iterations if only --iterations limits the run, "
        "the paper's seconds if --cost does)"
    )
    return {"--optimize": option(text + default, type=not_negative, metavar="S")}


def velocity_options(of_motion: str, of_end: str = "", effect: str = "") -> Options:
    """Return the options of velocities at the ends of a motion.

    Args:
        of_motion: which motion, in words.
        of_end: what else is a default of the velocity at the end, after "; ".
        effect: what the velocities change, as sentences after ". ".
    """
    start = partial(numbers, "--start-velocity")
    text = f"joint velocity at the start of {of_motion}, in quotes (0) [rad/s or m/s]"
    end = f"joint velocity at the end of {of_motion}, in quotes (0{of_end}) [rad/s or m/s]{effect}"
    return {
        "--start-velocity": option(text, type=start, metavar="V"),
        "--end-velocity": option(end, type=partial(numbers, "--end-velocity"), metavar="V"),
    }


def pose_region(option: str, text: str) -> "TaskSpaceRegion":
    """Return the region of one end-effector pose."""
    from cvqmpt_lab.base.codec import from_plain
    from cvqmpt_lab.constraints.named import Region  # imports numba

    x = numbers(option, text, ("x", "y", "z", "roll", "pitch", "yaw"))
    return from_plain(Region, {"pose": {"at": {"xyz": x[:3], "rpy": x[3:]}}}, option)


CORNERS = ("X0", "Y0", "Z0", "X1", "Y1", "Z1")
SCAN: Options = {
    "cameras of the scan; repeat the options in the order of the files": {
        "--intrinsics": option(
            "intrinsics of a depth image: width, height, fx, fy, cx, cy, or a ROS camera_info",
            type=Path,
            metavar="F.json|yaml",
            **REPEATED,
        ),
        "--extrinsics": option(
            "camera pose in the robot's base frame, x right, y down, z forward: 4x4, xyz + "
            "quaternion or rpy, or ROS's translation + rotation (default: the base frame itself)",
            type=Path,
            metavar="F.json|yaml",
            **REPEATED,
        ),
        "--scale": option(
            "metres per unit (default: 1, or 0.001 for a 16-bit image), also of extrinsics more "
            "than 100 m away",
            type=positive,
            metavar="M",
        ),
        "--level": option(
            "find the table and level it, instead of --extrinsics", choices=("table",)
        ),
        "--down": option(
            "downward pitch of the camera of --level, accurate to 30 deg: 0 is horizontal, 90 "
            "straight down (default: 40)",
            type=not_negative,
            metavar="DEG",
        ),
        "--front": option(
            "position of the table's near edge with --level (0.3,0,0) [m]",
            type=partial(numbers, "--front", names=("X", "Y", "Z")),
            metavar="X,Y,Z",
        ),
    },
    "filters of the scan": {
        "--crop": option(
            "keep the points between two corners [m] (all)",
            type=partial(numbers, "--crop", names=CORNERS),
            metavar=",".join(CORNERS),
        ),
        "--voxel": option(
            "edge length of voxels (0.01)",
            type=positive,
            default=0.01,
            metavar="M",
        ),
        "--robot-margin": option(
            "remove points closer to the arm than this (0.05)",
            type=not_negative,
            default=0.05,
            metavar="M",
        ),
        "--arm-at": option(
            "configuration of the arm when the scan was taken, or start or goal of the problem "
            "file",
            metavar="Q",
        ),
        "--neighbours": option(
            "remove points with fewer neighbours within three voxels (2)",
            type=not_negative_int,
            default=2,
            metavar="N",
        ),
        "--plane": option(
            "treatment of the points of the supporting plane (keep)",
            choices=("keep", "box", "remove"),
            default="keep",
        ),
    },
    "obstacles made from the scan": {
        "--map": option(
            "edge length of the cells of a map (0.02)",
            type=positive,
            metavar="M",
        ),
        "--padding": option(
            "inflation radius of the cells (0)", type=float, default=0.0, metavar="M"
        ),
        "--unknown": option(
            "cells that no camera ray crossed: free, all occupied, or occupied only in the shadow "
            "of a measured point, inside --crop (free)",
            choices=("free", "shadow", "occupied"),
            default="free",
        ),
        "--radius": option(
            "radius of balls around the points, instead of a map; 0.87 voxels leave no gap",
            type=positive,
            metavar="M",
        ),
    },
}


MOTION: Options = {
    "one motion, in free space or among the obstacles of --cloud or --scene, instead of a suite or "
    "file": {
        "--start": option(
            "configuration, numbers separated by commas [rad or m], or a file with a JointState",
            metavar="Q",
        ),
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
    }
}


MARGIN: Options = {
    "--margin": option(
        "margin for position errors of the arm: the path keeps it to obstacles and to bounds of "
        "position, where start, goals and budget allow it; behind a comma, the margin to bounds of "
        "rotation and tilt (0.002,0.005; 0: none) [m, rad]",
        type=_margin,
        metavar="M[,RAD]",
        default=DEFAULT_MARGIN,
    ),
}
