"""How much of its bounds a path uses, and which bound is broken most."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.constraints.task_space_region import ROWS, TOLERANCE, UNITS, TaskSpaceRegion
from cvqmpt_lab.poses import rotation_matrices, rotation_vectors
from cvqmpt_lab.robot.robot import Robot


@dataclass(frozen=True)
class BoundUse:
    """Largest use of one entry's bounds along a path."""

    region: int  # which of the regions, from 0
    row: int  # of its `Bw`, 0 to 5
    value: float  # displacement closest to a bound, or furthest beyond it [m] or [rad]
    lower: float  # lower bound, -inf where there is none [m] or [rad]
    upper: float  # upper bound, inf where there is none [m] or [rad]

    @property
    def excess(self) -> float:
        """max(lower - value, value - upper) [m] or [rad]; negative inside."""
        return max(self.lower - self.value, self.value - self.upper)

    @property
    def unit(self) -> str:
        """Of value and bounds."""
        return UNITS[self.row]

    def __str__(self) -> str:
        """For people: "rotation about y 0.071 of 0.100 rad"."""
        if self.lower == -self.upper:
            return f"{ROWS[self.row]} {abs(self.value):.3g} of {self.upper:.3g} {self.unit}"
        return (
            f"{ROWS[self.row]} {self.value:.3g} of {self.lower:.3g} to {self.upper:.3g} {self.unit}"
        )


def bounds_text(regions: Sequence[TaskSpaceRegion]) -> str:
    """For people: "rotation about y -0.1 to 0.1 rad, rotation about z ..."; ";" between regions."""
    texts = []
    for region in regions:
        bounds = [(row, *region.Bw[row]) for row in region.bounded_rows]
        texts.append(
            ", ".join(f"{ROWS[k]} {low:g} to {high:g} {UNITS[k]}" for k, low, high in bounds)
        )
    return "; ".join(texts) or "none"


def bound_usage(
    robot: Robot, regions: Sequence[TaskSpaceRegion], states: np.ndarray
) -> tuple[BoundUse, ...]:
    """The largest use of every bound of regions over states (m, n), m >= 1; poses by pinocchio."""
    uses = []
    for k, region in enumerate(regions):
        x = displacements(robot, region, states)
        worst = excess(region, x).argmax(axis=0)
        for row in map(int, region.bounded_rows):
            uses.append(BoundUse(k, row, float(x[worst[row], row]), *map(float, region.Bw[row])))
    return tuple(uses)


def displacements(robot: Robot, region: TaskSpaceRegion, states: np.ndarray) -> np.ndarray:
    """Displacements x (m, 6) of the end effector at states (m, n), which `Bw` bounds [m, rad]."""
    return displaced(region, robot.poses(states), region.reference_poses(robot, states))


def displaced(region: TaskSpaceRegion, poses: np.ndarray, references: np.ndarray) -> np.ndarray:
    """Displacements (m, 6): x = (t, Log R) of T = (T0_w)^-1 T0_e (Tw_e)^-1 with parts t and R.

    Args:
        region: the region.
        poses: T0_e (m, 4, 4) of the end effector [m].
        references: T0_w (1 or m, 4, 4) of the region's frame [m].
    """
    T = np.linalg.inv(references) @ poses @ np.linalg.inv(region.Tw_e)
    return np.hstack([T[:, :3, 3], rotation_vectors(T[:, :3, :3])])


def excess(region: TaskSpaceRegion, x: np.ndarray) -> np.ndarray:
    """max(lower - x, x - upper) of displacements x (m, 6), negative inside; -inf without bounds."""
    lower, upper = region.Bw.T
    bounded = np.isin(np.arange(6), region.bounded_rows)
    return np.where(bounded, np.maximum(lower - x, x - upper), -np.inf)


def broken_bound(region: TaskSpaceRegion, x: np.ndarray) -> str:
    """The bound that the best of displacements x (m, 6) breaks most, in words, or ""."""
    beyond = excess(region, x)
    k = int(beyond.max(axis=1).argmin())
    if beyond[k].max() <= TOLERANCE:
        return ""
    row = int(beyond[k].argmax())
    use = BoundUse(0, row, float(x[k, row]), *map(float, region.Bw[row]))
    # names of regions in problem files (see `named`) by the rows that they bound
    kinds = {
        (4, 5): "upright",
        (3, 4, 5): "fixed-orientation",
        (2,): "plane",
        (0, 1): "line",
        (0, 1, 2, 3, 4, 5): "pose",
    }
    kind = kinds.get(tuple(region.bounded_rows.tolist()), "the region")
    tilt = np.degrees(np.arccos(np.clip(rotation_matrices(x[k, None, 3:])[0, 0, 0], -1.0, 1.0)))
    tilts = f" (it tilts by {tilt:.0f}°)" if kind == "upright" else ""
    return f"`{kind}` by {use.excess:.3g} {use.unit}: {use}{tilts}"
