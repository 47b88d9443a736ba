"""The constraint of a frame that follows a straight line from one pose to another."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.base.poses import rotation_matrices, rotation_vectors
from cvqmpt_lab.base.values import bound_text
from cvqmpt_lab.constraints.bounds_between import ROTATION_RATE, longest_lever
from cvqmpt_lab.constraints.constraint import Constraint
from cvqmpt_lab.constraints.function import differences
from cvqmpt_lab.constraints.task_space_region import symmetric_region
from cvqmpt_lab.robot.joint_frames import poses_at_once
from cvqmpt_lab.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class Line:
    """A straight motion of a frame from one pose to another: T(s), 0 <= s <= 1.

    The position is (1 - s) p_0 + s p_1, the orientation R_0 exp(s Log(R_0^T R_1)).
    """

    begin: np.ndarray  # (4, 4), pose in the world
    end: np.ndarray  # (4, 4)

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return float(np.linalg.norm(self.end[:3, 3] - self.begin[:3, 3]))

    @property
    def turn(self) -> np.ndarray:
        """Rotation vector (3,) from the first to the last orientation, in the first frame [rad]."""
        return rotation_vectors((self.begin[:3, :3].T @ self.end[:3, :3])[None])[0]

    def at(self, s: np.ndarray) -> np.ndarray:
        """Return the poses (k, 4, 4) at s (k,)."""
        T = np.tile(np.eye(4), (len(s), 1, 1))
        T[:, :3, :3] = self.begin[:3, :3] @ rotation_matrices(s[:, None] * self.turn)
        p0, p1 = self.begin[:3, 3], self.end[:3, 3]
        T[:, :3, 3] = p0 + s[:, None] * (p1 - p0)
        return T


class AlongLine(Constraint):
    """A frame within distances of a line; F has two entries.

    With p and R the pose of the frame and T(s) the place of the line nearest to p,

        F = (max(0, |p - p(s)| - metres + allowed), max(0, angle of R(s)^T R - radians + allowed)).

    On a line that only turns, s is the place whose orientation is nearest.

    Args:
        robot: the robot.
        line: the line.
        metres: largest distance from it [m].
        radians: largest angle from its orientation [rad].
        frame: a frame of the robot; None: its end effector.
        allowed: violation that a certificate allows: where F is at most this, the frame is within
            both distances [m, rad].
    """

    def __init__(
        self,
        robot: Robot,
        line: Line,
        metres: float,
        radians: float,
        frame: str | None = None,
        allowed: float = 0.0,
    ) -> None:
        self._robot, self._line, self._frame = robot, line, frame
        self._metres, self._radians, self._allowed = metres, radians, allowed

    @property
    def dim(self) -> int:
        """2: the distance and the angle."""
        return 2

    def residual(self, q: np.ndarray) -> np.ndarray:
        """Return F(q) (2,) or (b, 2) [m, rad]."""
        kept = np.array([self._metres, self._radians]) - self._allowed
        F = (self._away(np.atleast_2d(q)) - kept).clip(min=0.0)
        return F if np.ndim(q) == 2 else F[0]

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return dF/dq (2, n) or (b, 2, n), by central differences."""
        return differences(self.residual, np.asarray(q, dtype=float))

    def describe(self) -> str:
        """Return the line and its tolerances in words."""
        within = bound_text(1e3 * self._metres, up=True)
        turned = bound_text(self._radians, up=True)
        return f"within {within} mm and {turned} rad of a line of {self._line.length:.3g} m"

    def bound_between(self, states: np.ndarray) -> np.ndarray:
        """Return by how much F can exceed its larger value at both ends of each motion (k - 1,).

        The distance from a line is a convex function of p, and p strays from a straight motion by
        at most D (lever D + slides) / 4, D = sum_j |dq_j|. The frame turns by at most D. The place
        on the line moves by at most as much as p, and R(s) turns with it. On a line that only
        turns, R(s) turns by at most pi / 2 D, the largest change of a rotation vector.
        """
        robot = self._robot
        changes = np.abs(np.diff(robot.kinematics.joint_values(states), axis=0))
        slides = robot.kinematics.prismatic
        D, slide = changes[:, ~slides].sum(axis=1), changes[:, slides].sum(axis=1)
        lever = longest_lever(robot, symmetric_region(np.eye(4), np.eye(4), [0.0] * 6))
        moved, line = lever * D + slide, self._line
        with_it = ROTATION_RATE * D
        if line.length > 1e-9:
            with_it = float(np.linalg.norm(line.turn)) / line.length * moved
        return np.maximum(0.25 * D * moved, 0.5 * (D + with_it))

    def _away(self, q: np.ndarray) -> np.ndarray:
        """Return distance and angle (b, 2) from the line at q (b, n)."""
        T, line = poses_at_once(self._robot, q, self._frame), self._line
        way = line.end[:3, 3] - line.begin[:3, 3]
        if line.length > 1e-9:
            s = ((T[:, :3, 3] - line.begin[:3, 3]) @ way / (way @ way)).clip(0.0, 1.0)
        else:
            turned = rotation_vectors(line.begin[:3, :3].T @ T[:, :3, :3])
            s = (turned @ line.turn / max(line.turn @ line.turn, 1e-12)).clip(0.0, 1.0)
        nearest = line.at(s)
        moved = np.linalg.norm(T[:, :3, 3] - nearest[:, :3, 3], axis=1)
        off = rotation_vectors(nearest[:, :3, :3].transpose(0, 2, 1) @ T[:, :3, :3])
        return np.stack([moved, np.linalg.norm(off, axis=1)], axis=1)
