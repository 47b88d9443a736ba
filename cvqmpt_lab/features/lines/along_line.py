"""The constraint of a frame that follows straight lines from pose to pose."""

from collections.abc import Sequence
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

# number of lines, the nearest ones by position, with which a pose is compared
CANDIDATES = 3


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
    """A frame within distances of a line, or of the nearest of several lines; F has two entries.

    With p and R the pose of the frame and T(s) the place of a line nearest to p,

        F = (max(0, |p - p(s)| - metres + allowed), max(0, angle of R(s)^T R - radians + allowed)).

    On a line that only turns, s is the place whose orientation is nearest. Of several lines, F is
    that of the best line (its larger entry is the smallest) among the CANDIDATES nearest to p.

    Args:
        robot: the robot.
        line: the line, or several lines.
        metres: largest distance from it [m].
        radians: largest angle from its orientation [rad].
        frame: a frame of the robot; None: its end effector.
        allowed: violation that a certificate allows: where F is at most this, the frame is within
            both distances [m, rad].
    """

    def __init__(
        self,
        robot: Robot,
        line: Line | Sequence[Line],
        metres: float,
        radians: float,
        frame: str | None = None,
        allowed: float = 0.0,
    ) -> None:
        self._robot, self._frame = robot, frame
        self.lines = (line,) if isinstance(line, Line) else tuple(line)
        self.metres, self.radians, self._allowed = metres, radians, allowed
        self._begins = np.array([one.begin for one in self.lines])
        self._ways = np.array([one.end[:3, 3] - one.begin[:3, 3] for one in self.lines])
        self._turns = np.array([one.turn for one in self.lines])
        self._lengths = np.array([one.length for one in self.lines])

    @property
    def dim(self) -> int:
        """2: the distance and the angle."""
        return 2

    def residual(self, q: np.ndarray) -> np.ndarray:
        """Return F(q) (2,) or (b, 2) [m, rad]."""
        T = poses_at_once(self._robot, np.atleast_2d(q), self._frame)
        _, F = self._best(T)
        return F if np.ndim(q) == 2 else F[0]

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return dF/dq (2, n) or (b, 2, n), by central differences."""
        return differences(self.residual, np.asarray(q, dtype=float))

    def describe(self) -> str:
        """Return the line and its tolerances in words."""
        within = bound_text(1e3 * self.metres, up=True)
        turned = bound_text(self.radians, up=True)
        several = len(self.lines) > 1
        of = f"{len(self.lines)} lines" if several else "a line"
        length = f"{self._lengths.sum():.3g} m{' in all' * several}"
        return f"within {within} mm and {turned} rad of {of} of {length}"

    def bound_between(self, states: np.ndarray) -> np.ndarray:
        """Return by how much F can exceed its larger value at both ends of each motion (k - 1,).

        The distance from a line is a convex function of p, and p strays from a straight motion by
        at most D (lever D + slides) / 4, D = sum_j |dq_j|. The frame turns by at most D. The place
        on the line moves by at most as much as p, and R(s) turns with it. On a line that only
        turns, R(s) turns by at most pi / 2 D, the largest change of a rotation vector.

        With F_l of line l and its bound b_l, F of several lines is at most the smallest
        max(F_l at one end, F_l at the other end) + b_l, over the best lines of the two ends.
        """
        changes = np.abs(np.diff(self._robot.kinematics.joint_values(states), axis=0))
        if len(self.lines) == 1:
            return self._bound(changes, np.zeros(len(changes), dtype=int))
        T = poses_at_once(self._robot, states, self._frame)
        best, F = self._best(T)
        largest = F.max(axis=1)
        first, last = best[:-1], best[1:]
        at_last = largest[1:].copy()  # F at the last end of the best line of the first end
        at_first = largest[:-1].copy()
        (other,) = np.nonzero(first != last)
        at_last[other] = self._of(T[other + 1], first[other]).max(axis=1)
        at_first[other] = self._of(T[other], last[other]).max(axis=1)
        by_first = np.maximum(largest[:-1], at_last) + self._bound(changes, first)
        by_last = np.maximum(at_first, largest[1:]) + self._bound(changes, last)
        return np.minimum(by_first, by_last) - np.maximum(largest[:-1], largest[1:])

    def _bound(self, changes: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Return the bounds (k - 1,) of motions with |dq| of all joints (k - 1, joints).

        number: (k - 1,) numbers of the lines with which the motions are compared.
        """
        slides = self._robot.kinematics.prismatic
        D, slide = changes[:, ~slides].sum(axis=1), changes[:, slides].sum(axis=1)
        lever = longest_lever(self._robot, symmetric_region(np.eye(4), np.eye(4), [0.0] * 6))
        moved, length = lever * D + slide, self._lengths[number]
        turn, long = np.linalg.norm(self._turns[number], axis=1), length > 1e-9
        with_it = np.where(long, turn / np.where(long, length, 1.0) * moved, ROTATION_RATE * D)
        return np.maximum(0.25 * D * moved, 0.5 * (D + with_it))

    def _best(self, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers (b,) of the best lines at poses T (b, 4, 4), and their F (b, 2)."""
        nearest = self._nearest(T)
        best = nearest[:, 0].copy()
        F = self._of(T, best)
        for others in nearest.T[1:]:
            (off,) = np.nonzero(F.max(axis=1) > 0.0)
            found = self._of(T[off], others[off])
            better = found.max(axis=1) < F[off].max(axis=1)
            F[off[better]], best[off[better]] = found[better], others[off[better]]
        return best, F

    def _nearest(self, T: np.ndarray) -> np.ndarray:
        """Return the numbers (b, c) of the lines nearest to the positions of poses T (b, 4, 4)."""
        count = len(self.lines)
        if count == 1:
            return np.zeros((len(T), 1), dtype=int)
        found = []
        for part in np.array_split(T[:, :3, 3], len(T) * count // 1_000_000 + 1):
            off = part[:, None] - self._begins[:, :3, 3]
            square = np.where(self._lengths > 1e-9, self._lengths, 1.0) ** 2
            s = (np.einsum("bli,li->bl", off, self._ways) / square).clip(0.0, 1.0)
            away = np.linalg.norm(off - s[..., None] * self._ways, axis=2)
            found.append(np.argsort(away, axis=1, kind="stable")[:, :CANDIDATES])
        return np.concatenate(found)

    def _of(self, T: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Return F (b, 2) of poses T (b, 4, 4) with respect to lines with these numbers (b,)."""
        kept = np.array([self.metres, self.radians]) - self._allowed
        return (self._away(T, number) - kept).clip(min=0.0)

    def _away(self, T: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Return distance and angle (b, 2) of poses T (b, 4, 4) from lines with numbers (b,)."""
        p, R = self._begins[number, :3, 3], self._begins[number, :3, :3]
        way, turn, length = self._ways[number], self._turns[number], self._lengths[number]
        long = length > 1e-9
        along = ((T[:, :3, 3] - p) * way).sum(axis=1) / np.where(long, length, 1.0) ** 2
        if not long.all():
            turned = rotation_vectors(R.transpose(0, 2, 1) @ T[:, :3, :3])
            about = (turned * turn).sum(axis=1) / np.maximum((turn**2).sum(axis=1), 1e-12)
            along = np.where(long, along, about)
        s = along.clip(0.0, 1.0)[:, None]
        moved = np.linalg.norm(T[:, :3, 3] - p - s * way, axis=1)
        nearest = R @ rotation_matrices(s * turn)
        off = rotation_vectors(nearest.transpose(0, 2, 1) @ T[:, :3, :3])
        return np.stack([moved, np.linalg.norm(off, axis=1)], axis=1)
