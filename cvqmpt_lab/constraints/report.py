"""Reports on bounds: the share that a path uses, and the bound that is violated most."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.base.poses import rotation_matrices, rotation_vectors, tilts
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.constraints.task_space_region import ROWS, UNITS, TaskSpaceRegion
from cvqmpt_lab.robot.robot import Robot


@dataclass(frozen=True)
class BoundUse:
    """Largest use of one entry's bounds along a path."""

    region: int  # index of the region, from 0
    row: int  # row of its `bounds`, 0 to 9
    value: float  # displacement closest to a bound, or furthest beyond it [m] or [rad]
    lower: float  # lower bound, -inf where there is none [m] or [rad]
    upper: float  # upper bound, inf where there is none [m] or [rad]

    @property
    def excess(self) -> float:
        """max(lower - value, value - upper) [m] or [rad]; negative inside."""
        return max(self.lower - self.value, self.value - self.upper)

    @property
    def unit(self) -> str:
        """Unit of value and bounds."""
        return str(UNITS[self.row])

    def __str__(self) -> str:
        """Return the use in words: "rotation about y 0.071 of 0.100 rad"."""
        if self.lower == -self.upper:
            return f"{ROWS[self.row]} {abs(self.value):.3g} of {self.upper:.3g} {self.unit}"
        lower = shown_lower(self.row, self.lower)
        return f"{ROWS[self.row]} {self.value:.3g} of {lower:.3g} to {self.upper:.3g} {self.unit}"


def shown_lower(row: int, lower: float) -> float:
    """Return the lower bound of a row of `bounds` to show: from row 6 on, at least 0."""
    return max(lower, 0.0) if row >= 6 else lower


def bounds_text(regions: Sequence[TaskSpaceRegion]) -> str:
    """Return bounds in words: "rotation about y -0.1 to 0.1 rad, ..."; ";" between regions."""
    texts = []
    for region in regions:
        bounds = [(row, *region.bounds[row]) for row in region.bounded_rows]
        texts.append(
            ", ".join(
                f"{ROWS[k]} {shown_lower(k, low):g} to {high:g} {UNITS[k]}"
                for k, low, high in bounds
            )
        )
    return "; ".join(texts) or "none"


def bound_usage(
    robot: Robot, regions: Sequence[TaskSpaceRegion], states: np.ndarray
) -> tuple[BoundUse, ...]:
    """Return the largest use of every bound of regions over states (m, n), m >= 1, by pinocchio."""
    uses = []
    for k, region in enumerate(regions):
        x = displacements(robot, region, states)
        worst = excess(region, x).argmax(axis=0)
        for row in map(int, region.bounded_rows):
            bounds = map(float, region.bounds[row])
            uses.append(BoundUse(k, row, float(x[worst[row], row]), *bounds))
    return tuple(uses)


def displacements(robot: Robot, region: TaskSpaceRegion, states: np.ndarray) -> np.ndarray:
    """Return displacements x (m, 10) of frame e at states (m, n), see `bounds` [m, rad]."""
    poses = robot.poses(states, region.end_effector)
    return displaced(region, poses, region.reference_poses(robot, states))


def displaced(region: TaskSpaceRegion, poses: np.ndarray, references: np.ndarray) -> np.ndarray:
    """Return displacements (m, 10): x of T = (T0_w)^-1 T0_e (Tw_e)^-1, see `TaskSpaceRegion`.

    Args:
        region: the region.
        poses: T0_e (m, 4, 4) of frame e [m].
        references: T0_w (1 or m, 4, 4) of the region's frame [m].
    """
    T = np.linalg.inv(references) @ poses @ np.linalg.inv(region.Tw_e)
    R, t = T[:, :3, :3], T[:, :3, 3]
    radius, axis = np.hypot(t[:, 0], t[:, 1]), R[:, :, 2]
    off_axis = np.linalg.norm(np.cross(t, axis), axis=1)
    places = np.hypot(radius, t[:, 2]), radius, np.arctan2(off_axis, -(t * axis).sum(axis=1))
    return np.column_stack([t, rotation_vectors(R), tilts(R), *places])


def excess(region: TaskSpaceRegion, x: np.ndarray) -> np.ndarray:
    """Return max(lower - x, x - upper) of displacements x (m, 10), negative inside; -inf: free."""
    lower, upper = region.bounds.T
    bounded = np.isin(np.arange(len(ROWS)), region.bounded_rows)
    return np.where(bounded, np.maximum(lower - x, x - upper), -np.inf)


def broken_bound(region: TaskSpaceRegion, x: np.ndarray) -> str:
    """Return the bound that the best of displacements x (m, 10) violates most, in words, or ""."""
    beyond = excess(region, x)
    k = int(beyond.max(axis=1).argmin())
    if beyond[k].max() <= PROJECTION_TOLERANCE:
        return ""
    row = int(beyond[k].argmax())
    use = BoundUse(0, row, float(x[k, row]), *map(float, region.bounds[row]))
    # names of regions in problem files (see `named`) by the rows that they bound
    kinds = {
        (6,): "upright",
        (3, 4): "upright",
        (4, 5): "upright-box",
        (3, 4, 5): "fixed-orientation",
        (2,): "plane",
        (0, 1): "line",
        (7,): "distance",
        (8,): "on-cylinder",
        (9,): "look-at",
        (7, 9): "look-at",
        (0, 1, 2, 3, 4, 5): "pose",
        (0, 1, 2, 5, 6): "pose",
    }
    kind = kinds.get(tuple(region.bounded_rows.tolist()), "the region")
    leaning = ""
    if kind.startswith("upright"):
        leans = np.arccos(rotation_matrices(x[k, None, 3:6])[0, 0, 0].clip(-1.0, 1.0))
        leaning = f" (it tilts by {np.degrees(leans if kind == 'upright-box' else x[k, 6]):.0f}°)"
    return f"`{kind}` by {use.excess:.3g} {use.unit}: {use}{leaning}"
