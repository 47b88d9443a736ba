"""Reports on bounds: the share that a path uses, and the bound that is violated most."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.base.poses import rotation_matrices
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.constraints.task_space_region import (
    ROWS,
    UNITS,
    TaskSpaceRegion,
    displacements,
    excess,
    shown_lower,
)
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
