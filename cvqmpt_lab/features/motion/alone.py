"""A motion and a robot alone: the problem by which they are judged, without start and goals.

The problem begins and ends where the motion does. Limits that nobody states are taken as
`UNKNOWN_LIMIT`, so that they refuse nothing; a note says which ones these are.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.constraints.region_constraint import Member
from cvqmpt_lab.features.motion.limit_use import UNKNOWN_LIMIT
from cvqmpt_lab.features.motion.motion_check import with_limits_of
from cvqmpt_lab.features.motion.trajectory import Motion
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.robot.source import read_source
from cvqmpt_lab.robot.urdf import read_urdf
from cvqmpt_lab.scene.scene import Attachment, Scene


def problem_of_motion(
    motion: Motion,
    robot: Robot,
    scene: Scene | None = None,
    constraint: Sequence[Member] = (),
    attachments: Sequence[Attachment] = (),
    clearance: float = 0.0,
) -> PlanningProblem:
    """Return the problem that a motion solves which begins and ends anywhere.

    Args:
        motion: the path or trajectory; limits in its file are used where the robot has none.
        robot: the robot.
        scene: obstacles; None: there are none.
        constraint: what every state must keep.
        attachments: what the hand carries.
        clearance: required distance from obstacles [m].
    """
    robot = robot_moving(robot, motion.joint_names or ())
    states = motion.of_joints(robot.joint_names).positions
    first = last = 0.5 * (robot.lower + robot.upper)
    if states.ndim == 2 and states.shape[1] == robot.dof and len(states):
        # states outside the limits, or not finite, are faults of the motion
        ends = np.where(np.isfinite(states[[0, -1]]), states[[0, -1]], first)
        first, last = np.clip(ends, robot.lower, robot.upper)
    problem = PlanningProblem(
        scene.name if scene is not None and scene.objects else f"{robot.name} alone",
        robot,
        Scene("no obstacles", ()) if scene is None else scene,
        first,
        last[None],
        tuple(constraint),
        tuple(attachments),
        clearance=clearance,
    )
    problem = with_limits_of(problem, motion)
    return replace(problem, robot=with_unknown_limits(problem.robot))


def with_unknown_limits(robot: Robot) -> Robot:
    """Return the robot with `UNKNOWN_LIMIT` where it has no limit of velocity or acceleration."""
    velocity = robot.velocity_limits
    unknown = ~((velocity > 0.0) & np.isfinite(velocity))
    given, said = {}, []
    if unknown.any():
        given["velocity_limits"] = np.where(unknown, UNKNOWN_LIMIT, velocity).tolist()
        names = ", ".join(np.array(robot.joint_names)[unknown])
        said.append(f"velocities of {names} are not judged: the URDF has no limits of them")
    if "acceleration" not in robot.limits:
        given["acceleration_limits"] = [UNKNOWN_LIMIT] * robot.dof
        said.append(
            "accelerations are not judged: the robot has no limits of them; cvqmpt robot NAME "
            "--acceleration A --out robot.json writes a robot that has"
        )
    if not given:
        return robot
    limited = robot_from_source({**robot.source, **given})
    return replace(limited, remarks=(*robot.remarks, *said))


def robot_moving(robot: Robot, names: Sequence[str]) -> Robot:
    """Return the robot with those of its held joints that are in `names`, such as a gripper's.

    A joint moves if the link behind it is one more end effector. The robot is unchanged where that
    is not possible: it holds the joint by its name, or has a tool.
    """
    held = [joint.name for joint in robot.held_joints if joint.name in names]
    if not held:
        return robot
    given = read_source(robot.source)
    if given.tool is not None or {*held} & {*given.locked}:
        return robot
    joints = read_urdf(Path(given.urdf), given.package_dirs).joints
    hands = [*given.end_effectors, *(joints[name].child for name in held)]
    source = {key: value for key, value in robot.source.items() if key != "end_effector"}
    try:
        return robot_from_source({**source, "end_effectors": list(dict.fromkeys(hands))})
    except InvalidInputError:  # limits of the source are those of its own joints
        return robot
