"""Data sets of LeRobot, versions 2 and 3: what `meta/info.json` says, and episodes of their files.

Version 2 has one parquet file an episode, version 3 several episodes in a file, told apart by the
column ``episode_index``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, mapping, require_choice, shown
from cvqmpt_lab.base.files import read_json_object
from cvqmpt_lab.base.values import scalar
from cvqmpt_lab.features.audit.parquet import read_columns

INFO = "meta/info.json"
COLUMNS = ("action", "observation.state")  # commanded and measured positions
KEYS = ("timestamp", "frame_index", "episode_index")


@dataclass(frozen=True)
class Info:
    """What the file `meta/info.json` of a data set says."""

    fps: float | None  # frames a second; None: not said
    robot_type: str  # "": not said
    episodes: int | None  # their number; None: not said
    names: Mapping[str, tuple[str, ...] | None]  # joints by column; None: it has no names


class Recorded(NamedTuple):
    """One episode of a data set, in the units of the file."""

    number: int
    names: tuple[str, ...] | None  # n joints
    positions: np.ndarray  # (m, n)
    times: np.ndarray | None  # (m,) [s]
    other: np.ndarray | None  # (m, n) the other one of commanded and measured positions


def read_info(root: Path) -> Info:
    """Read `meta/info.json` of a data set in the folder `root`."""
    data = read_json_object(root / INFO, "description of a data set")
    features = mapping(data.get("features"), f"{root / INFO}: features", "action")
    fps = data.get("fps")
    if fps is not None:
        fps = scalar(float, fps, f"{root / INFO}: fps")
        if not fps > 0.0:
            raise InvalidInputError(f"{root / INFO}: fps is {fps:g}; give a number above 0")
    episodes = data.get("total_episodes")
    count = episodes if isinstance(episodes, int) and 0 <= episodes <= 10**7 else None
    names = {name: _names(features[name]) for name in COLUMNS if name in features}
    return Info(fps, str(data.get("robot_type") or ""), count, names)


def _names(feature: Any) -> tuple[str, ...] | None:
    """Return the names of joints of a feature: a list, or lists by kind."""
    given = feature.get("names") if isinstance(feature, Mapping) else None
    if isinstance(given, Mapping):
        given = [name for part in given.values() if isinstance(part, list) for name in part]
    if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
        return None
    return tuple(given) or None


def read_episodes(path: Path, info: Info, column: str, rate: float | None) -> list[Recorded]:
    """Return the episodes of one parquet file.

    Args:
        path: the file.
        info: what its data set says.
        column: which positions are judged, see `COLUMNS`.
        rate: frames a second, where neither file nor `info` says; None: not given.
    """
    columns = read_columns(path, (*COLUMNS, *KEYS))
    have = [name for name in COLUMNS if name in columns]
    if not have:
        raise InvalidInputError(f"it has no column {' or '.join(COLUMNS)}")
    require_choice("column", column, have)
    positions = _states(columns[column], column)
    rows = len(positions)
    if not rows:
        raise InvalidInputError("the episode is empty: it has no rows")
    fps = info.fps or rate
    if fps is None and "timestamp" not in columns:
        raise InvalidInputError("neither file nor info.json has times: give --rate")
    numbers = columns.get("episode_index", np.zeros(rows))
    if not np.isfinite(numbers).all():
        raise InvalidInputError("column 'episode_index' has rows without a number")
    other = next((_states(columns[name], name) for name in have if name != column), None)
    if other is not None and info.names.get(have[0]) != info.names.get(have[1]):
        other = None
    names = info.names.get(column)
    if names is not None and len(names) != positions.shape[1]:
        raise InvalidInputError(
            f"info.json names {len(names)} joints of {column!r} ({shown(names)}), the file has "
            f"{positions.shape[1]} values a row"
        )
    found = []
    for number in np.unique(numbers).tolist():
        own = numbers == number
        times = columns["timestamp"][own] if "timestamp" in columns else None
        if times is None and fps is not None:
            index = columns["frame_index"][own] if "frame_index" in columns else np.arange(rows)
            times = index[: own.sum()] / fps
        apart = None if other is None or other.shape != positions.shape else other[own]
        found.append(Recorded(int(number), names, positions[own], times, apart))
    return found


def _states(values: np.ndarray, column: str) -> np.ndarray:
    """Return positions (m, n); a column of numbers is one joint."""
    if values.ndim == 1:
        return values[:, None]
    if values.ndim != 2:
        raise InvalidInputError(f"column {column!r} has no rows of numbers")
    return values
