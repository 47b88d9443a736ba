"""Trajectories as files: csv for spreadsheets and plots, json for ROS.

The json file is a `trajectory_msgs/JointTrajectory` message field by field, so a ROS 2 user replays it with
``ros2 topic pub --once /CONTROLLER/joint_trajectory trajectory_msgs/msg/JointTrajectory "$(cat FILE.json)"``.
"""

import json
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.files import write_text
from cvqmpt_lab.trajectory.trajectory import Trajectory

KINDS = ("position", "velocity", "acceleration")


def save_trajectory(trajectory: Trajectory, path: Path | str) -> None:
    """Write a .csv or .json file, whole or not at all."""
    writer = _WRITERS[file_type(path)]
    write_text(Path(path), writer(trajectory))


def file_type(path: Path | str) -> str:
    """The ending of a trajectory file, ".csv" or ".json"; anything else is refused."""
    ending = Path(path).suffix.lower()
    if ending not in _WRITERS:
        raise UnknownChoiceError(f"trajectory file type of {path}:", ending, _WRITERS)
    return ending


def as_csv(trajectory: Trajectory) -> str:
    """Header, then a line a time: time [s], then all positions, velocities, accelerations."""
    columns = [f"{name}_{kind}" for kind in KINDS for name in trajectory.joint_names]
    table = np.column_stack(
        [trajectory.times, trajectory.positions, trajectory.velocities, trajectory.accelerations]
    )
    lines = [",".join(["time", *columns]), *(",".join(repr(float(x)) for x in row) for row in table)]
    return "\n".join(lines) + "\n"


def as_ros_json(trajectory: Trajectory) -> str:
    """The fields of `trajectory_msgs/JointTrajectory`."""
    points = [
        {
            "positions": q.tolist(),
            "velocities": v.tolist(),
            "accelerations": a.tolist(),
            "effort": [],
            "time_from_start": _duration(t),
        }
        for t, q, v, a in zip(
            trajectory.times,
            trajectory.positions,
            trajectory.velocities,
            trajectory.accelerations,
            strict=True,
        )
    ]
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    message = {"header": header, "joint_names": list(trajectory.joint_names), "points": points}
    return json.dumps(message, allow_nan=False) + "\n"


def _duration(seconds: float) -> dict[str, int]:
    """Whole seconds and nanoseconds."""
    whole, rest = divmod(round(1e9 * seconds), 1_000_000_000)
    return {"sec": whole, "nanosec": rest}


_WRITERS = {".csv": as_csv, ".json": as_ros_json}
