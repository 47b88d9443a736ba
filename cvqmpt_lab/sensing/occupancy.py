"""An occupancy map from points: cells that hold some and, as an option, cells no ray crossed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.cells import distinct, map_of_points
from cvqmpt_lab.scene.cloud_files import Cloud
from cvqmpt_lab.scene.shapes import OccupancyMap, require_resolution
from cvqmpt_lab.sensing.filters import near_robot
from cvqmpt_lab.sensing.scan import Arm
from cvqmpt_lab.values import FloatArray


@dataclass(frozen=True, kw_only=True)
class MapSettings:
    """Settings of an occupancy map."""

    resolution: float = 0.02  # edge of its cells [m]
    padding: float = 0.0  # distance by which cells are inflated [m]
    unknown: Literal["free", "occupied"] = "free"  # cells no ray crossed; MoveIt: free
    lower: tuple[float, float, float] = (-1.2, -1.2, -0.4)  # corner of unknown cells [m]
    upper: tuple[float, float, float] = (1.2, 1.2, 1.4)  # opposite corner [m, robot base frame]
    robot_margin: float = 0.05  # cells this near to the robot are no unknown ones [m]

    def __post_init__(self) -> None:
        require_resolution(self.resolution)
        if not np.all(np.subtract(self.upper, self.lower) >= self.resolution):
            raise InvalidInputError(
                f"box of a map from {self.lower} to {self.upper} m holds no cell of "
                f"{self.resolution:g} m; give a lower corner below the upper one"
            )


def occupancy_map(
    points: FloatArray,
    settings: MapSettings,
    captures: Sequence[Cloud] = (),
    arm: Arm | None = None,
) -> OccupancyMap:
    """Map of cells that hold points (m, 3) [m, robot base frame], and of unknown cells if wanted.

    captures: all that the sensors saw, where unknown is occupied; cells between a sensor and its
        points are known.
    arm: the robot meanwhile; it stands in known space.
    InvalidInputError: no cell is occupied; unknown cells without captures, or too many of them.
    """
    if settings.unknown == "occupied":
        points = np.concatenate([points, _unknown(settings, captures, arm)])
    if len(points) == 0:
        raise InvalidInputError(
            "no point is left to make a map of; crop less, or plan without a map"
        )
    return map_of_points(points, settings.resolution, settings.padding)


def _unknown(
    settings: MapSettings, captures: Sequence[Cloud], arm: Arm | None, most: int = 1 << 27
) -> FloatArray:
    """Centres (k, 3) [m] of cells that no ray crossed, in a box of at most `most` cells (bytes)."""
    if not captures:
        raise InvalidInputError(
            "unknown space is occupied, but the captures with their cameras' poses are missing"
        )
    first: FloatArray = np.floor(np.divide(settings.lower, settings.resolution))
    across = (np.ceil(np.divide(settings.upper, settings.resolution)) - first).astype(np.int64)
    if across.prod() > most:
        raise InvalidInputError(
            f"box from {settings.lower} to {settings.upper} m holds {across.prod():.2g} cells of "
            f"{settings.resolution:g} m, more than {most:.2g}; give a smaller box or larger cells"
        )
    known = np.zeros(across, dtype=bool)
    for capture in captures:
        origin = capture.T_world_camera[:3, 3] / settings.resolution - first
        ends = capture.in_world / settings.resolution - first
        least = np.floor(ends.min(axis=0, initial=0.0)).astype(np.int64)
        ends = distinct(np.floor(ends).astype(np.int64) - least) + least + 0.5  # one ray per cell
        for crossed in _crossed(origin, ends, across):
            known[tuple(crossed.T)] = True
    places = (np.argwhere(~known) + first + 0.5) * settings.resolution
    return places if arm is None else places[~near_robot(places, *arm, settings.robot_margin)]


def _crossed(origin: FloatArray, ends: FloatArray, across: np.ndarray) -> Iterator[np.ndarray]:
    """Cells (k, 3) of a unit grid that segments from origin (3,) to ends (r, 3) cross, by steps.

    All segments are traversed in parallel (Amanatides and Woo, "A fast voxel traversal algorithm",
    1987).
    """
    ray = ends - origin
    ray[ray == 0.0] = 1e-12
    sides = np.stack([-origin / ray, (across - origin) / ray])
    enter = np.maximum(sides.min(axis=0).max(axis=1), 0.0)
    leave = np.minimum(sides.max(axis=0).min(axis=1), 1.0)
    through = enter < leave
    ray, enter, leave = ray[through], enter[through], leave[through]
    cell = np.clip(np.floor(origin + enter[:, None] * ray).astype(np.int64), 0, across - 1)
    step = np.where(ray > 0.0, 1, -1)
    border = (cell + (step > 0) - origin) / ray  # share of the ray at which the next cell begins
    while len(cell):
        yield cell
        rows, axis = np.arange(len(cell)), border.argmin(axis=1)
        going = border[rows, axis] < leave
        rows, axis = rows[going], axis[going]
        cell[rows, axis] += step[rows, axis]
        border[rows, axis] += 1.0 / np.abs(ray[rows, axis])
        going[rows] = ((cell[rows] >= 0) & (cell[rows] < across)).all(axis=1)
        cell, border, step, ray, leave = (part[going] for part in (cell, border, step, ray, leave))
