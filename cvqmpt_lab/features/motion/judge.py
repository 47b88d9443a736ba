"""Judgement of a motion that somebody else made: whole, or in parts as a policy sends them."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, require_kind
from cvqmpt_lab.base.polyline import distances_along, states_at
from cvqmpt_lab.base.values import Array
from cvqmpt_lab.certificate.certificate import Fault
from cvqmpt_lab.collision.exact import checker_of
from cvqmpt_lab.constraints.region_constraint import Member
from cvqmpt_lab.features.motion.alone import problem_of_motion
from cvqmpt_lab.features.motion.checked_curves import DryRun
from cvqmpt_lab.features.motion.limit_use import Ends
from cvqmpt_lab.features.motion.motion_check import (
    StateFaults,
    dry_run,
    speed_within_limits,
)
from cvqmpt_lab.features.motion.trajectory import JointState, Motion
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.joint_states import is_joint_state
from cvqmpt_lab.robot.load import numbers_of
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene


class Judgement(NamedTuple):
    """The check of a motion, and the speed that would keep every limit."""

    check: DryRun  # certificate, and the share of every limit that is used
    # factor on the motion's speed at which it is certified, with the same velocities at its ends:
    # 1.0 of a certified motion; None where slowing alone is no cure
    speed: float | None

    @property
    def certified(self) -> bool:
        """Whether the motion is certified."""
        return self.check.certificate.valid

    @property
    def first_fault(self) -> Fault | None:
        """The fault that comes first on the motion; None of a certified one."""
        faults = self.check.certificate.faults
        return min(faults, key=lambda fault: fault.at or 0.0, default=None)

    @property
    def clearance_m(self) -> float:
        """Least proven distance from obstacles [m]; -inf without a proof, inf without obstacles."""
        clearance = self.check.certificate.obstacle_clearance
        return float("inf") if clearance is None else clearance.at_least_m


class ClearanceAt(NamedTuple):
    """Distances at one state of a motion."""

    at: float  # time of the motion [s], or length along a path [rad or m]
    obstacles_m: float  # least distance from obstacles [m]; inf without any
    obstacles: str  # the nearest pair
    itself_m: float  # least distance of the robot's own pieces [m]
    itself: str  # the nearest pair


def clearance_along(
    problem: PlanningProblem, check: DryRun, count: int = 200
) -> Iterator[ClearanceAt]:
    """Yield the distances at `count` states, evenly in time, or along a path without times.

    Of a motion that stands for several curves, these are the least distances of all of them.
    """
    checker, (moments, states) = checker_of(problem), evenly(check, count)
    every = [states, *(evenly(other, count)[1] for other in check.others)]
    for k, moment in enumerate(moments.tolist()):
        obstacle, own = (
            min((nearest(rows[k]) for rows in every), key=lambda found: found.distance)
            for nearest in (checker.nearest_obstacle, checker.nearest_of_itself)
        )
        pairs = (str(found.pair or "") for found in (obstacle, own))
        yield ClearanceAt(moment, obstacle.distance, next(pairs), own.distance, next(pairs))


def evenly(check: DryRun, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return `count` times of a checked motion, or lengths along a path, and the states there."""
    marks = distances_along(check.states) if check.times is None else check.times
    at = np.linspace(marks[0], marks[-1], count)
    return at, states_at(check.states, marks, at)


def judge(
    motion: Motion,
    problem: PlanningProblem | Robot,
    last: JointState | Any = None,
    ends: Ends | None = None,
    exact_clearance: bool = False,
    more_faults: StateFaults | None = None,
    *,
    scene: Scene | None = None,
    constraint: Sequence[Member] = (),
    attachments: Sequence[Attachment] = (),
) -> Judgement:
    """Judge a path or trajectory: free, on the manifold, within limits, start and goal right.

    Args:
        motion: the motion, see `read_motion`.
        problem: start, goals, constraint, robot and scene; or a robot alone: the motion may then
            begin and end anywhere.
        last: positions and velocities (n,) of the arm where a part of a longer motion begins, such
            as a chunk of a policy; it need not end at a goal. JointState(q, v), or ROS's message
            of this name. None: the motion is whole.
        ends: begin and end of the motion, instead of `last`; None: at rest, at the start and at a
            goal.
        exact_clearance: whether least distances are measured; this takes two to three times as
            long. Else they are lower bounds.
        more_faults: as in `dry_run`.
        scene: obstacles, for a robot alone; None: there are none.
        constraint: regions and functions that every state must keep, for a robot alone.
        attachments: what the hand carries, for a robot alone.

    Raises InvalidInputError as `dry_run`.
    """
    require_kind("motion", motion, Motion, "give Motion(joint_names, positions, times)")
    if isinstance(problem, Robot):
        problem = problem_of_motion(motion, problem, scene, constraint, attachments)
        ends = (ends or Ends())._replace(anywhere=True)
    elif scene is not None or constraint or attachments:
        raise InvalidInputError(
            "scene, constraint and attachments go with a robot alone; a problem has its own"
        )
    require_kind("problem", problem, PlanningProblem, "give a PlanningProblem or a Robot")
    if last is not None:
        state = joint_state(last, problem.robot)
        ends = Ends(state.positions, start_velocity=state.velocities, part=True)
    found = dry_run(problem, motion, ends, exact_clearance, more_faults)
    speed = 1.0 if found.certificate.valid else None
    if speed is None and found.limits_alone:
        speed = speed_within_limits(problem, motion, ends)
    return Judgement(found, speed)


def joint_state(given: Any, robot: Robot) -> JointState:
    """Return positions and velocities (n,) of a JointState, or of ROS's message with this name.

    Args:
        given: JointState(q, v), a pair (q, v), or a mapping or message with name, position and
            velocity; velocities that are not given are 0.
        robot: the robot with n joints.
    """
    fields = ("name", "position", "velocity")
    if not isinstance(given, Mapping | tuple | list) and hasattr(given, "position"):
        given = {field: list(getattr(given, field, ())) for field in fields}
    if isinstance(given, Mapping):
        if not is_joint_state(given):
            raise InvalidInputError("last is no JointState: give name and position, or (q, v)")
        state = given.get("joint_state", given)
        speeds = state.get("velocity") or [0.0] * len(state["position"])
        rates = {"name": state["name"], "position": speeds}
        given = numbers_of(robot, given, "last"), numbers_of(robot, rates, "last: velocity")
    if not isinstance(given, tuple | list) or not 1 <= len(given) <= 3:
        raise InvalidInputError("last is no state: give JointState(q, v)")
    form = Array((robot.dof,), f"numbers, one each for {', '.join(robot.joint_names)}")
    positions, velocities = (*given, None)[:2]
    still = np.zeros(robot.dof) if velocities is None else velocities
    return JointState(form.read(positions, "last: q"), form.read(still, "last: v"))
