"""Trajectories: joint positions, velocities and accelerations over time; their files.

Between two states a trajectory is a quintic polynomial; `extremes` and `bounds` are about these.

A csv file has one row per state and perhaps a header of joint names, see `tables`. With a column
``time`` it is a trajectory, with columns ``JOINT_position``, ``JOINT_velocity`` and perhaps
``JOINT_acceleration``.
A json file holds a list of states, an object with ``joint_names`` and ``states`` (or ``path``, as
``cvqmpt plan --json`` prints), or ROS's `JointTrajectory`, also inside of the messages of
`ros_messages`. A yaml file holds the same, as ``ros2 topic echo --full-length`` prints it. An npz
file holds arrays ``t`` (k,) and ``q`` (k, n), perhaps ``v``, ``a`` and ``joint_names``.

Files are written with accelerations, which are continuous: a controller then follows the quintics
through positions, velocities and accelerations, and these are certified.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import (
    InvalidInputError,
    known_fields,
    mapping,
    require_choice,
    shown,
    unique,
)
from cvqmpt_lab.base.files import csv_table, finite, write_text
from cvqmpt_lab.base.readers import kind_of, plain_readers, read_arrays, read_by_suffix
from cvqmpt_lab.base.values import numbers
from cvqmpt_lab.features.motion.bags import is_bag, message_of_bag
from cvqmpt_lab.features.motion.ros_messages import joint_trajectory, nanoseconds
from cvqmpt_lab.features.motion.tables import read_table
from cvqmpt_lab.robot.robot import LIMIT_UNITS, JointLimits

if TYPE_CHECKING:
    from scipy.interpolate import PPoly  # half a second to import

log = logging.getLogger("cvqmpt")
CSV_COLUMN_KINDS = ("position", "velocity", "acceleration")  # columns are called JOINT_kind


NOT_GIVEN: Any = None  # a value of a state that need not be given


class JointState(NamedTuple):
    """Positions, velocities, accelerations [rad, rad/s, rad/s^2], (n,) or (k, n) at k times.

    Velocities are 0 and accelerations unknown where they are not given.
    """

    positions: np.ndarray
    velocities: np.ndarray = NOT_GIVEN
    accelerations: np.ndarray = NOT_GIVEN


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Joint states at k times."""

    joint_names: tuple[str, ...]  # n names
    times: np.ndarray  # (k,) from 0, increasing [s]
    positions: np.ndarray  # (k, n) [rad]
    velocities: np.ndarray  # (k, n) [rad/s]
    accelerations: np.ndarray  # (k, n) [rad/s^2]
    deviation: float = 0.0  # largest distance from the path that it was made from [rad]

    def __repr__(self) -> str:
        return (
            f"Trajectory of {len(self.joint_names)} joints, {len(self.times)} states, "
            f"{self.duration:.2f} s"
        )

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return float(self.times[-1])

    def at(self, t: float | np.ndarray) -> JointState:
        """State at a time or at times (k,) [s]; at rest before the start and after the end.

        Between two states q(t) is the quintic through their positions, velocities and
        accelerations.
        """
        moment = np.asarray(t, dtype=float)
        if not np.isfinite(moment).all():
            raise InvalidInputError(f"time {t}: give finite seconds from 0 to {self.duration:.3f}")
        inside = np.clip(moment, 0.0, self.duration)
        moving = (moment == inside).astype(float)[..., None]
        velocity, acceleration = (self.curve.derivative(order)(inside) for order in (1, 2))
        return JointState(self.curve(inside), moving * velocity, moving * acceleration)

    def sampled(self, period: float) -> Trajectory:
        """The same motion at equidistant times, at most period [s] apart, ends included."""
        if not (np.isfinite(period) and period > 0.0):
            raise InvalidInputError(f"sampling period {period}: give seconds above 0, such as 0.01")
        times = np.linspace(0.0, self.duration, max(2, int(np.ceil(self.duration / period)) + 1))
        return Trajectory(self.joint_names, times, *self.at(times), self.deviation)

    @cached_property
    def curve(self) -> PPoly:
        """q(t) (n,): a quintic between neighbouring states, as robot controllers interpolate."""
        return quintic(self.times, self.positions, self.velocities, self.accelerations)


@dataclass(frozen=True, eq=False)
class Motion:
    """A path or trajectory as read from a file; numbers may be nan or infinite.

    Lists, tensors and arrays of other types become arrays of float64.
    """

    joint_names: tuple[str, ...] | None  # n names; None: the file has no names
    positions: np.ndarray  # (m, n) [rad or m]
    times: np.ndarray | None = None  # (m,) [s]; None: it is a path
    velocities: np.ndarray | None = None  # (m, n) [rad/s or m/s], only with times
    accelerations: np.ndarray | None = None  # (m, n) [rad/s^2 or m/s^2]; None: not in the file
    # (n,) by kind: limits that the file says it was timed with, inf where there is none
    limits: Mapping[str, np.ndarray] = field(default_factory=dict)
    # whether `times` are seconds for certain; else a motion that hardly uses its limits is refused
    in_seconds: bool = False

    def __post_init__(self) -> None:
        for name in ("positions", "times", "velocities", "accelerations"):
            value: Any = getattr(self, name)
            if value is not None and getattr(value, "dtype", None) != np.float64:
                object.__setattr__(self, name, numbers(value, f"motion.{name}"))
        # the curves through positions alone would ignore them
        if self.accelerations is not None and self.velocities is None:
            raise InvalidInputError(
                "the motion has accelerations, but no velocities: give both, or leave the "
                "accelerations out"
            )
        if self.velocities is not None and self.times is None:
            raise InvalidInputError(
                "the motion has velocities, but no times: give the times, or leave the velocities "
                "out to judge a path"
            )

    def of_joints(self, names: tuple[str, ...]) -> Motion:
        """Reorder the joints as in `names`; InvalidInputError if the joints are others."""
        if self.joint_names is None or self.joint_names == names:
            return self
        given = list(self.joint_names)
        if sorted(given) != sorted(names):
            if repeated := [name for name in given if given.count(name) > 1]:
                raise InvalidInputError(f"the file names joint {shown(repeated[0])} twice")
            others = [name for name in given if name not in names]
            cure = "give the robot that was planned"
            if set(names) < set(given):
                cure = (
                    f"leave out {', '.join(map(shown, others))}, fixed joints or ones that follow"
                )
            raise InvalidInputError(
                f"the file moves joints {', '.join(map(shown, given))}; the robot has "
                f"{', '.join(names)}: {cure}"
            )
        order = [self.joint_names.index(name) for name in names]
        velocities, accelerations = (
            None if kind is None else kind[:, order]
            for kind in (self.velocities, self.accelerations)
        )
        limits = {kind: values[order] for kind, values in self.limits.items()}
        states = self.positions[:, order]
        return Motion(names, states, self.times, velocities, accelerations, limits, self.in_seconds)

    def at_speed(self, factor: float) -> Motion:
        """Return a trajectory with `factor` times the speed, 0 < factor; a path is unchanged."""
        if self.times is None:
            return self
        v, a = self.velocities, self.accelerations
        return replace(
            self,
            times=self.times / factor,
            velocities=None if v is None else factor * v,
            accelerations=None if a is None else factor**2 * a,
            in_seconds=True,
        )


def save_trajectory(
    trajectory: Trajectory, path: Path | str, limits: JointLimits | None = None
) -> None:
    """Write a .csv or .json file; json also has the limits with which the motion was timed."""
    kind = kind_of(path, TRAJECTORY_WRITERS, "trajectory")
    text = TRAJECTORY_WRITERS[kind](trajectory)
    if limits is not None and kind == ".json":
        text = as_ros_json(trajectory, limits)
    write_text(Path(path), text)


def as_csv(trajectory: Trajectory) -> str:
    """Text of a csv file: a header, then one line per state.

    The columns are the time [s], all positions, all velocities and all accelerations.
    """
    columns = [f"{name}_{kind}" for kind in CSV_COLUMN_KINDS for name in trajectory.joint_names]
    state = (trajectory.positions, trajectory.velocities, trajectory.accelerations)
    table = np.column_stack([trajectory.times, *state])
    return csv_table([["time", *columns], *table.tolist()])


def as_ros_json(trajectory: Trajectory, limits: JointLimits | None = None) -> str:
    """Text of a json file with the fields of ROS's `trajectory_msgs/JointTrajectory`.

    limits: of the robot, written by kind as "limits", null where a joint has none; None: left out.
    """
    state = (trajectory.positions, trajectory.velocities, trajectory.accelerations)
    duration = ("sec", "nanosec")
    points = [
        {
            "positions": q.tolist(),
            "velocities": v.tolist(),
            "accelerations": a.tolist(),
            "effort": [],
            "time_from_start": dict(zip(duration, divmod(round(1e9 * t), 10**9), strict=True)),
        }
        for t, q, v, a in zip(trajectory.times, *state, strict=True)
    ]
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    message: dict[str, Any] = {"header": header, "joint_names": list(trajectory.joint_names)}
    if limits is not None:
        own = [limits.joint_names.index(name) for name in trajectory.joint_names]
        known = {kind: getattr(limits, kind) for kind in LIMIT_UNITS}
        message["limits"] = {
            kind: finite(values[own].tolist())
            for kind, values in known.items()
            if values is not None
        }
    message["points"] = points
    return json.dumps(message, allow_nan=False) + "\n"


TRAJECTORY_WRITERS = {".csv": as_csv, ".json": as_ros_json}


def read_motion(path: Path, topic: str | None = None) -> Motion:
    """Read a motion from a file; InvalidInputError names the file and what is wrong in it.

    topic: topic of a recording, see `bags`; None: the only one with motions.
    """
    if is_bag(path):
        return _checked(_from_value(message_of_bag(path, topic)), path)
    if topic is not None:
        raise InvalidInputError(f"topic {topic!r} belongs to a recording; {path} is none")
    readers = {".csv": _from_csv, **plain_readers(_from_value), ".npz": _from_arrays}
    return _checked(read_by_suffix(readers, path, "motion"), path)


def _checked(motion: Motion, path: Path) -> Motion:
    """Return a motion whose arrays fit together; refuse others."""
    for kind in (motion.positions, motion.velocities, motion.accelerations):
        if kind is not None and (kind.ndim != 2 or kind.shape != motion.positions.shape):
            raise InvalidInputError(
                f"motion {path}: arrays of {motion.positions.shape} and {kind.shape} states"
            )
    if not len(motion.positions):
        raise InvalidInputError(f"motion {path}: it has no states: give two or more")
    if motion.joint_names is not None and motion.positions.shape[1] != len(motion.joint_names):
        raise InvalidInputError(
            f"motion {path}: {len(motion.joint_names)} joint names, {motion.positions.shape[1]} "
            "values a state"
        )
    return motion


def _from_csv(data: bytes) -> Motion:
    # some programs begin a text with a byte order mark
    header, table, in_seconds, named = read_table(data.decode("utf-8-sig"))
    if header is None or "time" not in header:
        return Motion(header if named else None, table)
    unique(header, "columns")
    names = tuple(name.removesuffix("_position") for name in header if name.endswith("_position"))
    if not any(name.endswith(tuple(f"_{kind}" for kind in CSV_COLUMN_KINDS)) for name in header):
        names = tuple(name for name in header if name != "time")
        header = tuple(name if name == "time" else f"{name}_position" for name in header)
    columns = dict(zip(header, table.T, strict=False))
    expected = ["time", *(f"{name}_{kind}" for kind in CSV_COLUMN_KINDS for name in names)]
    if not names or not set(header) <= set(expected):
        odd = next((name for name in header if name not in expected), header[0])
        raise InvalidInputError(
            f"column {shown(odd)}: with a column 'time', give JOINT_position, JOINT_velocity, or "
            "joint names alone"
        )
    kinds: list[Any] = [None, None, None]
    for k, kind in enumerate(CSV_COLUMN_KINDS):
        if any(column.endswith(f"_{kind}") for column in header):
            for name in names:
                if f"{name}_{kind}" not in columns:
                    raise InvalidInputError(
                        f"it has no column {shown(f'{name}_{kind}')}, other joints have: give all "
                        "or none"
                    )
            kinds[k] = np.stack([columns[f"{name}_{kind}"] for name in names], axis=1)
    own = names if named else None
    return Motion(own, kinds[0], columns["time"], kinds[1], kinds[2], in_seconds=in_seconds)


def _from_arrays(data: bytes, most: int = 2**26) -> Motion:
    """Return the motion of an npz file with times ``t`` (k,) and positions ``q`` (k, n).

    most: largest size of its arrays [bytes], a million states of seven joints.
    """
    found = read_arrays(data, most)
    if "q" not in found:
        raise InvalidInputError(
            "it has no array 'q' of states; save it by np.savez(file, t=t, q=q)"
        )
    for key in found:
        require_choice("array", key, ("t", "q", "v", "a", "joint_names"))
    t, v, a = (numbers(found[key], key) if key in found else None for key in "tva")
    names = tuple(map(str, found["joint_names"])) if "joint_names" in found else None
    if t is None and (v is not None or a is not None):
        raise InvalidInputError("it has velocities or accelerations, but no times 't'")
    return Motion(names, numbers(found["q"], "q"), t, v, a)


def _from_value(found: Any) -> Motion:
    """Return the motion of a json or yaml value."""
    if isinstance(found, list):
        return Motion(None, _table(found))
    content = mapping(found, "", "'states', 'path' or 'points'")
    key = next((key for key in ("states", "path") if content.get(key) is not None), None)
    if key is None:
        content = joint_trajectory(content)
    names = content.get("joint_names", content.get("joints"))
    if names is not None:
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InvalidInputError(f"'joint_names' {shown(names)}: give a list of names")
        names = tuple(names)
    if key is None:
        known = ("header", "joint_names", "joints", "points", "limits")
        known_fields(content, "the trajectory", known)
        motion = _from_points(names, content["points"])
        return replace(motion, limits=_limits(content.get("limits", {}), motion))
    for other in ("points", "times", "time", "velocities", "accelerations"):
        if content.get(other):
            raise InvalidInputError(
                f"{other!r} beside {key!r} is not read: leave it out, or write a JointTrajectory, "
                "whose 'points' have times"
            )
    return Motion(names, _table(content[key]))


def _from_points(names: tuple[str, ...] | None, points: list[dict[str, Any]]) -> Motion:
    """Motion through the points of a `JointTrajectory`."""
    if not points:
        raise InvalidInputError("its trajectory is empty: 'points' has no entry")
    if points[-1] == "...":
        raise InvalidInputError("it ends with '...': print it by ros2 topic echo --full-length")
    known = ("positions", "velocities", "accelerations")
    for k, point in enumerate(points):
        known_fields(point, f"point {k}", (*known, "effort", "time_from_start"))
    kinds = []
    for key in known:
        given = [bool(point.get(key)) for point in points]
        if any(given) and not all(given):
            raise InvalidInputError(
                f"point {given.index(False)} has no {key!r}, others have: give all or none"
            )
        kinds.append(_table([point[key] for point in points]) if all(given) else None)
    if kinds[0] is None:
        raise InvalidInputError("a point has no 'positions'")
    elapsed = [
        nanoseconds(f"time_from_start of point {k}", point.get("time_from_start"))
        for k, point in enumerate(points)
    ]
    times = np.array(
        [seconds + 1e-9 * rest for seconds, rest in (divmod(t, 10**9) for t in elapsed)]
    )
    in_seconds = all(isinstance(point["time_from_start"], Mapping) for point in points)
    if not in_seconds:
        log.warning("time_from_start is a number in the motion: it is read as seconds")
    return Motion(names, kinds[0], times, kinds[1], kinds[2], in_seconds=in_seconds)


def _limits(given: Any, motion: Motion) -> dict[str, np.ndarray]:
    """Return the limits of a file by kind, inf where it says null."""
    known_fields(given, "limits", tuple(LIMIT_UNITS))
    found = {}
    for kind, row in given.items():
        count = motion.positions.shape[1]
        if not isinstance(row, list) or len(row) != count:
            raise InvalidInputError(f"limits: {kind} is {shown(row)}; give {count} numbers or null")
        values = numbers([math.inf if x is None else x for x in row], f"limits: {kind}")
        if not (values > 0.0).all():
            raise InvalidInputError(f"limits: {kind} is {shown(row)}; give numbers above 0")
        found[kind] = values
    return found


def _table(rows: list[list[float]]) -> np.ndarray:
    """States (m, n); ValueError if a value is no number or rows differ in length."""
    if not rows:
        raise InvalidInputError("it has no states: give two or more")
    table = numbers(rows, "states")
    if table.ndim != 2:
        raise ValueError(f"states of shape {table.shape}, give a list of lists of numbers")
    return table


def quintic(times: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> PPoly:
    """Piecewise quintic polynomial through positions, velocities and accelerations.

    A piece of duration h begins with q, v, a and ends with q1, v1, a1. With

        p = q1 - q - v h - a h^2 / 2,    w = (v1 - v) h - a h^2,    c = (a1 - a) h^2

    its coefficients of (t / h)^3, ^4 and ^5 are 10 p - 4 w + c / 2, -15 p + 7 w - c and
    6 p - 3 w + c / 2.

    Args:
        times: (k,) increasing [s].
        q: positions (k, n) [rad or m].
        v: velocities (k, n) [rad/s or m/s].
        a: accelerations (k, n) [rad/s^2 or m/s^2].
    """
    from scipy.interpolate import PPoly

    h = np.diff(times)[:, None]
    c = (a[1:] - a[:-1]) * h**2
    w = (v[1:] - v[:-1]) * h - a[:-1] * h**2
    p = q[1:] - q[:-1] - v[:-1] * h - 0.5 * a[:-1] * h**2
    factors = (
        (6.0 * p - 3.0 * w + 0.5 * c) / h**5,
        (-15.0 * p + 7.0 * w - c) / h**4,
        (10.0 * p - 4.0 * w + 0.5 * c) / h**3,
        0.5 * a[:-1],
        v[:-1],
        q[:-1],
    )
    return PPoly(np.array(factors), times)


def extremes(curve: PPoly, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Extremes of a derivative on each piece of a curve.

    On a piece a derivative is a polynomial p(u) of degree d, 0 <= u <= 1. Its extremes are at 0, at
    1 or at a root of p' between them.

    Returns:
        u (m, k, n), m candidates on each of k pieces, and the values of the derivative there.
    """
    spans = np.diff(curve.x)[:, None]
    p = curve.derivative(order).c
    p = p[p.any(axis=(1, 2)).argmax() :]  # leading coefficients are 0 where the curve is a cubic
    p = p * spans ** np.arange(len(p))[::-1, None, None]
    shares = _monotone_between(p)
    return shares, np.polyval(p, shares)


def bounds(curve: PPoly, order: int) -> np.ndarray:
    """Upper bounds (k, n) of a derivative's absolute value on each piece.

    The bound is the largest Bernstein coefficient. The Bernstein coefficients of
    p(u) = sum_i c_i u^i of degree d are sum_(i <= j) C(j, i) / C(d, i) c_i, j = 0..d.
    """
    c = curve.derivative(order).c[::-1]
    c = c * np.diff(curve.x)[:, None] ** np.arange(len(c))[:, None, None]
    rows = [
        [math.comb(j, i) / math.comb(len(c) - 1, i) for i in range(len(c))] for j in range(len(c))
    ]
    return np.abs(np.tensordot(rows, c, 1)).max(axis=0)


def _monotone_between(p: np.ndarray, halvings: int = 12) -> np.ndarray:
    """Sorted u (d + 1, ...) from 0 to 1; polynomials p(u) are monotone between neighbours.

    Roots of p' are found by bisection, one in each interval on which p' is monotone. Because p' is
    0 at an extreme, the error of the extreme value is of second order in the error of the root.

    p: coefficients (d + 1, ...), the highest power first.
    """
    powers = np.arange(len(p))[::-1]
    ends = np.stack([np.zeros(p.shape[1:]), np.ones(p.shape[1:])])
    if len(p) < 3:
        return ends
    if len(p) == 3:
        with np.errstate(all="ignore"):
            root = np.nan_to_num(-p[1] / (2.0 * p[0]), nan=0.0, posinf=0.0, neginf=0.0)
        return np.stack([ends[0], np.clip(root, 0.0, 1.0), ends[1]])
    slope = p[:-1] * powers[:-1].reshape(-1, *[1] * (p.ndim - 1))
    cuts = _monotone_between(slope)
    low, high = cuts[:-1], cuts[1:]
    sign = np.sign(np.polyval(slope, low))
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        before = np.sign(np.polyval(slope, middle)) == sign
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    return np.concatenate([ends[:1], low, ends[1:]])
