"""How much of its bounds a path uses: the state closest to each bound or furthest over it;
which bound is broken.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TOLERANCE, TaskSpaceRegion
from cvqmpt_lab.poses import rotation_matrices, rotation_vectors
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.values import FloatArray

ROWS = (*(f"position {axis}" for axis in "xyz"), *(f"rotation about {axis}" for axis in "xyz"))
UNITS = ("m",) * 3 + ("rad",) * 3


@dataclass(frozen=True)
class BoundUse:
    """The state of a path that stands closest to a bound of one entry of one region, or furthest
    beyond it.
    """

    region: int  # Which of the regions, from 0
    row: int  # Which row of its `Bw`, 0 to 5
    value: float  # Displacement there [m] or [rad]
    lower: float  # Lower bound, -inf where there is none [m] or [rad]
    upper: float  # Upper bound, inf where there is none [m] or [rad]

    @property
    def excess(self) -> float:
        """How far the value lies beyond its bound; negative inside [m] or [rad]."""
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
    """For people: "rotation about y -0.1 to 0.1 rad, rotation about z ...";
    regions are divided by semicolons.
    """
    texts = (
        ", ".join(
            f"{ROWS[row]} {low:g} to {high:g} {UNITS[row]}" for row, (low, high) in _bounded(region)
        )
        for region in regions
    )
    return "; ".join(texts) or "none"


def _bounded(region: TaskSpaceRegion) -> list[tuple[int, FloatArray]]:
    """Row and bounds (2,) of each entry that can be violated."""
    return [(int(row), region.Bw[row]) for row in region.bounded_rows]


def bound_usage(
    robot: Robot, regions: Sequence[TaskSpaceRegion], states: np.ndarray
) -> tuple[BoundUse, ...]:
    """The largest use of every bound of a constraint, `problem.constraint`, over states (m, n), m
    >= 1.

    Poses by pinocchio: nothing here is shared with the planners' kernels.
    """
    uses = []
    for k, region in enumerate(regions):
        x = displacements(robot, region, states)
        for row in map(int, region.bounded_rows):
            lower, upper = map(float, region.Bw[row])
            excess = np.maximum(lower - x[:, row], x[:, row] - upper)
            uses.append(BoundUse(k, row, float(x[np.argmax(excess), row]), lower, upper))
    return tuple(uses)


def displacements(robot: Robot, region: TaskSpaceRegion, states: np.ndarray) -> np.ndarray:
    """Where the end effector stands in a region, (m, 6):
    position [m] and rotation vector [rad] that `Bw` bounds.
    """
    return displaced(region, robot.poses(states), region.reference_poses(robot, states))


def displaced(region: TaskSpaceRegion, poses: np.ndarray, references: np.ndarray) -> np.ndarray:
    """The same (m, 6) of end-effector poses (m, 4, 4), where the region's frame stands at
    references (1 or m, 4, 4).
    """
    T = np.linalg.inv(references) @ poses @ np.linalg.inv(region.Tw_e)
    return np.hstack([T[:, :3, 3], rotation_vectors(T[:, :3, :3])])


KINDS = {
    (4, 5): "upright",
    (3, 4, 5): "fixed-orientation",
    (2,): "plane",
    (0, 1): "line",
    tuple(range(6)): "pose",
}
"""Names of regions in problem files (see `named`) by the rows that they bound."""


def broken_bound(region: TaskSpaceRegion, x: np.ndarray) -> str:
    """Which bound the displacement of (m, 6) that breaks a region least breaks most, and by how
    much.

    "`upright` by 0.41 rad: rotation about y 0.51 of 0.1 rad (it tilts by 29°)"; "" when one keeps
    the region to 1e-4.
    """
    rows = region.bounded_rows
    lower, upper = region.Bw[rows].T
    excess = np.maximum(lower - x[:, rows], x[:, rows] - upper)
    k = int(excess.max(axis=1, initial=-np.inf).argmin())
    if excess[k].max(initial=-np.inf) <= TOLERANCE:
        return ""
    row = int(rows[excess[k].argmax()])
    use = BoundUse(0, row, float(x[k, row]), *map(float, region.Bw[row]))
    kind = KINDS.get(tuple(rows.tolist()), "the region")
    tilt = np.degrees(np.arccos(np.clip(rotation_matrices(x[k, None, 3:])[0, 0, 0], -1.0, 1.0)))
    tilts = f" (it tilts by {tilt:.0f}°)" if kind == "upright" else ""
    return f"`{kind}` by {use.excess:.3g} {use.unit}: {use}{tilts}"
