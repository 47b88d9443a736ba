"""`cvqmpt robot`: print the model that was read from a robot's description, write a robot file."""

import argparse
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import few
from cvqmpt_lab.base.files import json_text, write_text
from cvqmpt_lab.base.reports import Entry, Report
from cvqmpt_lab.cli.options import FLAG, Options, file_of_kind, log, option, picture_file
from cvqmpt_lab.cli.problem_arguments import robot_options, source_named
from cvqmpt_lab.cli.problem_options import CODE, ROBOT_DETAILS
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.robot.dynamics import too_weak, without_effort_limit
from cvqmpt_lab.robot.left_out import OVERLAP
from cvqmpt_lab.robot.link_pieces import hull_gaps
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.pairs import cure_of_overlap, srdf_text
from cvqmpt_lab.robot.robot import FrameLimit, Robot
from cvqmpt_lab.robot.source import ARMS, with_relative_paths
from cvqmpt_lab.scene.scene import Scene


def run(args: argparse.Namespace) -> None:
    """Print a report on a robot, or the names of known robots."""
    if args.robot is None:
        for name, arm in ARMS.items():
            hands = arm.end_effector or " and ".join(arm.end_effectors)
            print(f"{name:16} {arm.urdf}, end effector {hands}")
        return
    source, guesses = source_named(args.robot, robot_options(args))
    robot = with_tool_speed(robot_from_source(source), args.tool_speed)
    model = describe(robot)
    report = Report.of(entries(robot, model, guesses), lambda: model, width=13)
    print(json.dumps(report.data, indent=1) if args.json else report)
    if args.picture:
        from cvqmpt_lab.features.pictures.picture import draw

        draw(robot, args.picture)
    if args.out and args.out.suffix == ".srdf":
        write_text(args.out, srdf_text(robot))
        log(
            f"SRDF written to {args.out}: it leaves out the pairs above, and links that overlap "
            f"often or where all joints are 0; read its reasons, then give --srdf {args.out}"
        )
    elif args.out:
        source = with_relative_paths(args.out.absolute().parent, robot.source)
        write_text(args.out, json_text(source) + "\n")
        log(f"robot file written to {args.out}; give it as --robot {args.out}")


def with_tool_speed(robot: Robot, limit: Sequence[float] | None) -> Robot:
    """Return the robot with a limit of its end effectors; without a turning speed their own stays.

    Args:
        robot: the robot.
        limit: largest speed [m/s], and perhaps turning speed [rad/s]; None: nothing changes.
    """
    if limit is None:
        return robot
    from cvqmpt_lab.features.motion.frame_speeds import with_frame_limits  # seldom needed

    speed, *turning = limit
    limits = dict(robot.frame_limits)
    for name in robot.end_effectors:
        own = limits[name].turning_speed if name in limits else None
        limits[name] = FrameLimit(speed, turning[0] if turning else own)
    return with_frame_limits(robot, limits)


def describe(robot: Robot, tried: int = 200) -> dict[str, Any]:
    """Return the robot model as plain json.

    Args:
        robot: the model.
        tried: number of random configurations from which the fraction without self-collision is
            estimated.
    """
    velocity, kinematics = robot.velocity_limits, robot.kinematics
    states = robot.random_configurations(np.random.default_rng(0), tried)
    nothing = Scene("nothing", ())
    collide = CollisionChecker(robot, nothing).in_collision_batch(states)
    return {
        "name": robot.name,
        "source": robot.source,
        "kinematics_digest": robot.kinematics_digest,
        "end_effectors": list(robot.end_effectors),
        "reach_m": robot.reach,
        "joints": [
            {
                "name": name,
                "kind": "prismatic" if kinematics.prismatic[kinematics.order[j]] else "revolute",
                "lower": float(robot.lower[j]),
                "upper": float(robot.upper[j]),
                "velocity": float(velocity[j]) if np.isfinite(velocity[j]) else None,
                **{kind: float(x[j]) for kind, x in robot.limits.items() if np.isfinite(x[j])},
            }
            for j, name in enumerate(robot.joint_names)
        ],
        "held_joints": [
            {"name": j.name, "value": j.value, "reason": j.reason} for j in robot.held_joints
        ],
        "followers": [joint._asdict() for joint in robot.followers],
        "frames": list(robot.frame_names),
        "collision_pieces": [{"name": p.name, "corners": len(p.vertices)} for p in robot.links],
        "self_collision_pairs": [
            [robot.links[i].name, robot.links[k].name] for i, k in robot.self_collision_pairs
        ],
        "left_out_pairs": [[p.first, p.second, p.reason] for p in robot.left_out_pairs],
        "hulls_beyond_meshes_m": hull_gaps(robot),
        "links_without_body": list(robot.bodiless),
        "notes": [*robot.notes, *filter(None, [too_weak(robot)])],
        "share_free_of_self_collision": float(1.0 - collide.mean()),
    }


def entries(robot: Robot, model: dict[str, Any], guesses: list[str]) -> Iterator[Entry]:
    """Yield the labelled lines of the report on a robot.

    Args:
        robot: the robot.
        model: `describe(robot)`.
        guesses: links that are probably end effectors, the chosen one first; empty if the user
            chose the end effector.
    """
    yield (
        (
            "robot",
            f"{robot.name}: {robot.dof} joints, reach {robot.reach:.2f} m, digest "
            f"{robot.kinematics_digest}",
        )
    )
    guessed = (
        f" (guessed from {', '.join(guesses)}: --end-effector chooses another)" if guesses else ""
    )
    yield ("end effector", f"{' and '.join(robot.end_effectors)}{guessed}")
    for joint in model["joints"]:
        unit = "m" if joint["kind"] == "prismatic" else "rad"
        speed_limit = (
            f", at most {joint['velocity']:.2f} {unit}/s"
            if joint["velocity"]
            else ", no velocity limit"
        )
        limits = f"{joint['lower']:.3f} to {joint['upper']:.3f} {unit}"
        yield ("joint", f"{joint['name']}: {joint['kind']}, {limits}{speed_limit}")
    for reason, count in Counter(joint.reason for joint in robot.held_joints).items():
        names = [f"{j.name}={j.value:g}" for j in robot.held_joints if j.reason == reason]
        yield ("held", f"{count} {reason}: {_listed(names)}")
    for follower in robot.followers:
        yield (
            (
                "follows",
                f"{follower.name} = {follower.multiplier:g} * {follower.leader} "
                f"{follower.offset:+g}",
            )
        )
    yield ("frames", f"{len(model['frames'])}: {_listed(model['frames'])}")
    yield ("pieces", f"{len(robot.links)}: {_listed([piece.name for piece in robot.links])}")
    if gaps := model["hulls_beyond_meshes_m"]:
        largest = [f"{name} {1e3 * gap:.0f} mm" for name, gap in gaps.items()]
        yield ("hulls", f"extend beyond their meshes by about: {_listed(largest)}")
    reasons = Counter(pair.reason for pair in robot.left_out_pairs)
    left_out = ", ".join(f"{count} {reason}" for reason, count in reasons.items()) or "none"
    yield (
        (
            "pairs",
            f"{len(robot.self_collision_pairs)} pairs of pieces are checked; pairs of "
            f"links left out: {left_out}",
        )
    )
    for pair in robot.left_out_pairs:
        if pair.reason.startswith(OVERLAP):
            yield ("", f"{pair.first} and {pair.second} {pair.reason}: not checked")
    if overlap := cure_of_overlap(robot):
        yield ("overlap", overlap)
    free = 100.0 * model["share_free_of_self_collision"]
    yield ("free", f"{free:.0f} % of random configurations are free of self-collision")
    for note in robot.notes:
        yield ("note", note)
    if "acceleration" not in robot.limits:
        yield ("timing", "no acceleration limits: timed motions need --acceleration")
    if unlimited := without_effort_limit(robot):
        yield ("timing", unlimited)
    if weak := too_weak(robot):
        yield ("timing", weak)


def _listed(names: Iterable[str]) -> str:
    return few(names, counted="--json lists {}")


OPTIONS: Options = {
    "robot": option(
        "name of a robot, URDF file, robot file or problem file (default: list the known names)",
        nargs="?",
        metavar="NAME|URDF|FILE",
    ),
    **ROBOT_DETAILS,
    **CODE,
    "--json": option("print everything as one json object", **FLAG),
    "--picture": option(
        "draw the robot; with --bodies hulls its collision pieces",
        type=picture_file,
        metavar="FILE.png|jpg|pdf",
    ),
    "--out": option(
        "write the robot with these options to a file, for other commands or for the field robot "
        "of a problem file; .srdf: the pairs of links that are not compared, and those that often "
        "overlap",
        type=partial(file_of_kind, "--out", (".json", ".srdf")),
        metavar="robot.json|srdf",
    ),
}
COMMANDS = {"robot": (run, OPTIONS)}
