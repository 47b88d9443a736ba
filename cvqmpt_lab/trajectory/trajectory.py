"""Trajectories: joint positions, velocities and accelerations over time; as csv and, for ROS, as
json.

Files leave accelerations out: a controller then follows the cubics through positions and
velocities, which are what is certified. With accelerations, which jump between pieces, ROS's would
follow quintics that exceed them by up to 75 %.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import write_text

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline  # half a second to import


class JointState(NamedTuple):
    """Positions, velocities and accelerations (n,), or (k, n) for k moments [rad, rad/s, rad/s^2]."""

    positions: np.ndarray
    velocities: np.ndarray
    accelerations: np.ndarray


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Joint states at k times, at rest at both ends."""

    joint_names: tuple[str, ...]  # n names
    times: np.ndarray  # (k,) from 0, increasing [s]
    positions: np.ndarray  # (k, n) [rad]
    velocities: np.ndarray  # (k, n) [rad/s]
    accelerations: np.ndarray  # (k, n) [rad/s^2]; where one jumps, the value after the jump
    deviation: float = 0.0  # largest distance from the path that was timed [rad]

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
        """State at a time or at times (k,) [s]; at rest before the start and after the end."""
        moment = np.asarray(t, dtype=float)
        if not np.isfinite(moment).all():
            raise InvalidInputError(f"time {t}: give finite seconds from 0 to {self.duration:.3f}")
        inside = np.clip(moment, 0.0, self.duration)
        moving = (moment == inside).astype(float)[..., None]
        position, velocity, acceleration = self._motion
        return JointState(
            position(inside), moving * velocity(inside), moving * acceleration(inside)
        )

    def sampled(self, period: float) -> Trajectory:
        """The same motion at even times, at most period [s] apart, ends included."""
        if not (np.isfinite(period) and period > 0.0):
            raise InvalidInputError(f"sampling period {period}: give seconds above 0, such as 0.01")
        times = np.linspace(0.0, self.duration, max(2, int(np.ceil(self.duration / period)) + 1))
        return Trajectory(self.joint_names, times, *self.at(times), deviation=self.deviation)

    @cached_property
    def _motion(self) -> tuple[CubicHermiteSpline, CubicHermiteSpline, CubicHermiteSpline]:
        """Cubic pieces through positions and velocities, as a robot's controller interpolates, and
        derivatives.
        """
        from scipy.interpolate import CubicHermiteSpline

        spline = CubicHermiteSpline(self.times, self.positions, self.velocities)
        return spline, spline.derivative(1), spline.derivative(2)


# Files.
KINDS = ("position", "velocity", "acceleration")  # of columns


def save_trajectory(trajectory: Trajectory, path: Path | str) -> None:
    """Write a .csv or .json file."""
    write_text(Path(path), _WRITERS[file_type(path)](trajectory))


def file_type(path: Path | str) -> str:
    """The ending of a trajectory file, ".csv" or ".json"; anything else is refused."""
    ending = Path(path).suffix.lower()
    if ending not in _WRITERS:
        raise UnknownChoiceError(f"trajectory file type of {path}:", ending, _WRITERS)
    return ending


def as_csv(trajectory: Trajectory) -> str:
    """Header, then a line a time: time [s], then all positions, then all velocities."""
    columns = [f"{name}_{kind}" for kind in KINDS[:2] for name in trajectory.joint_names]
    table = np.column_stack([trajectory.times, trajectory.positions, trajectory.velocities])
    lines = [
        ",".join(["time", *columns]),
        *(",".join(repr(float(x)) for x in row) for row in table),
    ]
    return "\n".join(lines) + "\n"


def as_ros_json(trajectory: Trajectory) -> str:
    """The fields of `trajectory_msgs/JointTrajectory`."""
    points = []
    for k, t in enumerate(trajectory.times):
        sec, nanosec = divmod(round(1e9 * t), 1_000_000_000)
        states = {
            kind: getattr(trajectory, kind)[k].tolist() for kind in ("positions", "velocities")
        }
        when = {"time_from_start": {"sec": sec, "nanosec": nanosec}}
        points.append({**states, "accelerations": [], "effort": [], **when})
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    message = {"header": header, "joint_names": list(trajectory.joint_names), "points": points}
    return json.dumps(message, allow_nan=False) + "\n"


_WRITERS = {".csv": as_csv, ".json": as_ros_json}
