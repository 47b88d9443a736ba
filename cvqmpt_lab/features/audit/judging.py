"""Judgement of one episode: its joints, units, samples, and the motion between the samples."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, few, shown
from cvqmpt_lab.base.values import FULL_TURN_RAD
from cvqmpt_lab.certificate.certificate import Clearance, FaultKind, Verdict
from cvqmpt_lab.features.audit.episodes import Episode
from cvqmpt_lab.features.audit.rows import CERTIFIED, NOT_PROVEN, REFUSED, SHARES, Row
from cvqmpt_lab.features.audit.samples import (
    SampleFault,
    jump_faults,
    least_jerk,
    pair_faults,
    resolution,
    stamp_faults,
    unit_faults,
)
from cvqmpt_lab.features.audit.units import Calibrated, is_gripper, plain_name, scales
from cvqmpt_lab.features.motion.alone import problem_of_motion, robot_moving
from cvqmpt_lab.features.motion.checked_curves import DryRun
from cvqmpt_lab.features.motion.limit_use import LIMIT_OVERSHOOT, Ends
from cvqmpt_lab.features.motion.motion_check import dry_run
from cvqmpt_lab.features.motion.trajectory import Motion
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import JointLimits, Robot
from cvqmpt_lab.scene.scene_files import read_scene

# a recording begins and ends anywhere, on the move, and its motion is smooth
RECORDING = Ends(part=True, anywhere=True, moving=True, lines=False)


@dataclass(frozen=True)
class Settings:
    """What all episodes of an audit are judged by."""

    robot: Mapping[str, Any]  # source of the robot
    units: str = "radians"
    calibration: Mapping[str, Calibrated] | None = None
    scene: Path | None = None
    rate: float | None = None  # samples a second where files do not say
    column: str = "action"  # of data sets of LeRobot


@dataclass(frozen=True, eq=False)
class Prepared:
    """An episode in radians, with its robot."""

    robot: Robot
    motion: Motion  # states of the robot's joints; times increase
    raw: np.ndarray  # (m, n) values of the file
    shares: list[bool]  # (n,) which joints go from 0 to 100
    other: np.ndarray | None  # (m, n) [rad or m]
    period: float  # [s]
    faults: list[SampleFault] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    repeated: int = 0
    gaps: int = 0
    largest_gap_s: float = 0.0


class Auditor:
    """Judges episodes by settings.

    Args:
        settings: robot, units and so on.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.robot = robot_from_source(settings.robot)
        self._scene = None if settings.scene is None else read_scene(settings.scene)
        self._problems: dict[tuple[str, ...], PlanningProblem] = {}

    def row(self, file: str, episode: Episode) -> Row:
        """Return the row of an episode; InvalidInputError: it cannot be judged.

        Args:
            file: name of its file.
            episode: the episode.
        """
        made = self.prepared(episode)
        checks = unit_faults(made.raw, self.settings.units, made.robot.joint_names, made.shares)
        faults = [*made.faults, *checks]
        states, times, names = made.motion.positions, made.motion.times, made.robot.joint_names
        assert times is not None
        known: dict[str, Any] = {
            "states": len(states),
            "duration_s": round(float(np.ptp(times)), 6),
            "repeated": made.repeated,
            "gaps": made.gaps,
            "largest_gap_s": round(made.largest_gap_s, 6),
        }
        if not np.isfinite(states).all():
            k, j = np.argwhere(~np.isfinite(states))[0].tolist()
            text = f"{names[j]} of sample {k} is {states[k, j]}"
            faults.append(SampleFault("nan", text, float(times[k]), names[j]))
            return _row(file, episode, made, faults, known, None)
        jumps = list(jump_faults(states, times, made.period, names))
        faults += jumps
        if made.other is not None and np.isfinite(made.other).all():
            faults += pair_faults(states, made.other, times, names)
        known["jumps"] = len(jumps)
        known["middle"] = json.dumps(
            {name: round(float(x), 4) for name, x in zip(names, np.median(states, 0), strict=True)}
        )
        return self._judged(file, episode, made, faults, known)

    def _judged(
        self,
        file: str,
        episode: Episode,
        made: Prepared,
        faults: list[SampleFault],
        known: dict[str, Any],
    ) -> Row:
        """Return the row of an episode with the certificate of its motion.

        Args:
            file: name of its file.
            episode: the episode.
            made: the episode in radians.
            faults: those of its samples.
            known: columns of the row.
        """
        try:
            problem = self.problem_of(made.motion, made.robot)
            found = dry_run(problem, made.motion, RECORDING, exact_clearance=True)
        except InvalidInputError as error:
            beyond = np.maximum(
                made.robot.lower - made.motion.positions, made.motion.positions - made.robot.upper
            )
            kind = "units" if beyond.max() > FULL_TURN_RAD else "input"
            faults.append(SampleFault(kind, str(error), None, _named(str(error), made.robot)))
            return _row(file, episode, made, faults, known, None)
        steps = resolution(made.motion.positions)
        explained = _explained(found, made, problem.robot.joint_limits, steps)
        of_motion = _faults_of(found, made.robot)
        faults += [fault for fault in of_motion if fault.kind not in explained]
        faults += _jerk_faults(made, steps)
        made.notes.extend(explained.values())
        return _row(file, episode, made, faults, known | _numbers_of(found), found)

    def problem_of(self, motion: Motion, robot: Robot) -> PlanningProblem:
        """Return the problem by which a motion (in radians) of a robot is judged."""
        names = robot.joint_names
        if motion.limits:  # each file may have its own
            return problem_of_motion(motion, robot, self._scene)
        if names not in self._problems:
            self._problems[names] = problem_of_motion(motion, robot, self._scene)
        return self._problems[names]

    def prepared(self, episode: Episode) -> Prepared:
        """Return an episode in radians; InvalidInputError: its joints are not the robot's."""
        raw, motion = episode.motion.positions, episode.motion
        if raw.ndim != 2 or not len(raw):
            raise InvalidInputError("the episode is empty: it has no states")
        if len(raw) < 2:
            raise InvalidInputError("the episode has one state: it does not move")
        robot, columns, notes = self._joints(motion)
        raw = raw[:, columns]
        factors, offsets = scales(
            robot,
            robot.joint_names,
            self.settings.units,
            self.settings.calibration,
            episode.of_lerobot,
        )
        shares = [
            is_gripper(name) and (self.settings.units == "normalised" or episode.of_lerobot)
            for name in robot.joint_names
        ]
        times, period, faults, counted = _times(motion.times, episode.period, len(raw))
        rates = [
            None if kind is None or counted["repeated"] else factors * kind[:, columns]
            for kind in (motion.velocities, motion.accelerations)
        ]
        limits = motion.limits if motion.joint_names == robot.joint_names else {}
        states = factors * raw + offsets
        velocities, accelerations = rates
        made = Motion(robot.joint_names, states, times, velocities, accelerations, limits, True)
        other = None if episode.other is None else factors * episode.other[:, columns] + offsets
        return Prepared(robot, made, raw, shares, other, period, faults, notes, **counted)

    def _joints(self, motion: Motion) -> tuple[Robot, list[int], list[str]]:
        """Return the robot that moves the joints of a motion, their columns, and notes."""
        count = motion.positions.shape[1]
        if motion.joint_names is None:
            held = [joint.name for joint in self.robot.held_joints]
            robots = (self.robot, robot_moving(self.robot, held))
            robot = next((robot for robot in robots if robot.dof == count), None)
            if robot is None:
                raise InvalidInputError(
                    f"it has {count} values a state and no names; the robot has {self.robot.dof} "
                    f"joints, {', '.join(self.robot.joint_names)}"
                )
            return robot, list(range(count)), ["joints have no names: the robot's order is taken"]
        names = [plain_name(name) for name in motion.joint_names]
        robot = robot_moving(self.robot, names)
        missing = [name for name in robot.joint_names if name not in names]
        if missing:
            raise InvalidInputError(
                f"it has no joint {few(missing)}; it has {few(map(shown, names))}: another robot?"
            )
        if repeated := [name for name in names if names.count(name) > 1]:
            raise InvalidInputError(f"it names joint {shown(repeated[0])} twice")
        others = [name for name in names if name not in robot.joint_names]
        notes = [f"not judged: {few(others)}"] if others else []
        return robot, [names.index(name) for name in robot.joint_names], notes


def _times(
    given: np.ndarray | None, period: float | None, count: int
) -> tuple[np.ndarray, float, list[SampleFault], dict[str, Any]]:
    """Return increasing times (m,) [s], the usual step, faults of the stamps, and their counts."""
    if given is None or len(given) != count:
        raise InvalidInputError("it has no times: give --rate, samples a second")
    steps = np.diff(given)
    ahead = steps[np.isfinite(steps) & (steps > 0.0)]
    if period is None:
        if not len(ahead):
            raise InvalidInputError("its times do not increase: give --rate, samples a second")
        period = float(np.median(ahead))
    if not np.isfinite(given).all():
        k = int((~np.isfinite(given)).argmax())
        faults = [SampleFault("stamps", f"the time of sample {k} is {given[k]}")]
        return period * np.arange(count), period, faults, {"repeated": 1}
    faults = list(stamp_faults(given, period))
    repeated = int((steps <= 0.0).sum())
    counted = {
        "repeated": repeated,
        "gaps": len([1 for fault in faults if fault.kind == "gap"]),
        "largest_gap_s": float(steps.max()),
    }
    times = period * np.arange(count) if repeated else given - given[0]
    return times, period, faults, counted


def _faults_of(found: DryRun, robot: Robot) -> Iterator[SampleFault]:
    """Yield the faults of a certificate."""
    for fault in found.certificate.faults:
        at = None
        if fault.at is not None and found.times is not None:
            at = float(np.interp(fault.at, np.arange(len(found.times)), found.times))
        yield SampleFault(str(fault.kind), fault.text, at, _named(fault.text, robot))


def _explained(
    found: DryRun, made: Prepared, limits: JointLimits, steps: np.ndarray
) -> dict[str, str]:
    """Return which limits are exceeded by no more than the steps of the encoders explain.

    Positions are known to half a step r / 2. Where they alternate by it, a spline through samples
    that are h apart has velocities of up to 3 (r / 2) / h and accelerations of up to 12 (r / 2) /
    h^2. All joints keep their limit and that, if the largest share of a limit is at most 1 plus
    the least share of these.

    Args:
        found: the check.
        made: the episode; with velocities in the file, nothing is explained.
        limits: of the joints.
        steps: (n,) of the encoders, see `resolution` [rad or m].

    Returns:
        A note by the kind of limit.
    """
    notes = dict[str, str]()
    moved = np.ptp(made.motion.positions, axis=0) > 0.0
    if made.motion.velocities is not None or not moved.any():
        return notes
    for kind, limit, size in (
        ("velocity", limits.velocity, 1.5 * steps / made.period),
        ("acceleration", limits.acceleration, 6.0 * steps / made.period**2),
    ):
        room = float((size / limit)[moved].min())
        use = next((use for use in found.uses if use.kind == kind), None)
        if use is not None and use.exceeded and use.share <= 1.0 + room:
            notes[kind] = (
                f"{kind} of {use.of} is {use.share:.2f} of its limit, which the steps of "
                "the encoder explain"
            )
    return notes


def _named(text: str, robot: Robot) -> str:
    """Return the first joint that a text names, or the bodies that touch in it."""
    if "in collision: " in text:
        return text.partition("in collision: ")[2]
    words = text.replace(",", " ").split()
    return next((word for word in words if word in robot.joint_names), "")


def _jerk_faults(made: Prepared, steps: np.ndarray) -> Iterator[SampleFault]:
    """Yield a jerk beyond its limit that every smooth motion through the samples has.

    steps: (n,) of the encoders [rad or m]; a third difference is wrong by up to 8 halves of them.
    """
    limit, times = made.robot.limits.get("jerk"), made.motion.times
    if limit is None or times is None or len(times) < 4 or made.motion.accelerations is not None:
        return
    jerks, begins = least_jerk(made.motion.positions, times)
    used = (np.abs(jerks) - 4.0 * steps / made.period**3) / limit
    k, joint = divmod(int(used.argmax()), used.shape[1])
    if used[k, joint] > 1.0 + LIMIT_OVERSHOOT[FaultKind.JERK]:
        name = made.robot.joint_names[joint]
        text = (
            f"{name} needs {abs(jerks[k, joint]):.4g} rad/s^3 between samples, its jerk limit is "
            f"{limit[joint]:.4g}"
        )
        yield SampleFault("jerk", text, float(begins[k]), name)


def _numbers_of(found: DryRun) -> dict[str, Any]:
    """Return the columns of a row that the certificate fills: shares and distances."""
    columns: dict[str, Any] = {}
    for use in found.uses:
        kind = "position" if use.kind == "limits" else str(use.kind)
        if kind in SHARES:
            columns[kind] = round(max(use.share, columns.get(kind, 0.0)), 6)
    certificate = found.certificate
    columns["self_mm"], columns["self_proven_mm"] = _millimetres(certificate.self_clearance)
    columns["obstacle_mm"], _ = _millimetres(certificate.obstacle_clearance)
    return columns


def _millimetres(clearance: Clearance | None) -> tuple[float | None, float | None]:
    """Return the least distance found and the proven one [mm]; None where it is not known."""
    if clearance is None:
        return None, None
    values = clearance.distance_m, clearance.at_least_m
    found, proven = (round(1e3 * x, 3) if np.isfinite(x) else None for x in values)
    return found, proven


def _row(
    file: str,
    episode: Episode,
    made: Prepared,
    faults: list[SampleFault],
    known: dict[str, Any],
    found: DryRun | None,
) -> Row:
    """Return the row of an episode.

    Args:
        file: name of its file.
        episode: the episode.
        made: the episode in radians.
        faults: all faults.
        known: further columns.
        found: the certificate; None: the motion was not judged.
    """
    # of faults at one time, that of the samples is the cause
    faults = sorted(faults, key=lambda fault: -1.0 if fault.at_s is None else fault.at_s)
    verdict = CERTIFIED
    if faults or found is None:
        missing = found is not None and found.certificate.verdict is Verdict.NOT_PROVEN
        alone = all(fault.kind == "not_proven" for fault in faults)
        verdict = NOT_PROVEN if missing and alone else REFUSED
    first = faults[0] if faults else SampleFault("", "")
    return Row(
        file,
        episode.name,
        verdict,
        " ".join(dict.fromkeys(fault.kind for fault in faults)),
        first.text,
        first.joint,
        None if first.at_s is None else round(first.at_s, 4),
        note="; ".join(made.notes),
        **known,
    )


def whole_error(error: Exception) -> str:
    """Return the reason of an episode that was not read, as one line."""
    said = " ".join(str(error).split())
    return said if isinstance(error, CvqmptError) else f"{type(error).__name__}: {said}"[:300]
