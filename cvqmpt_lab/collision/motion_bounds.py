"""Bounds on how far points of a robot move while its configuration stays in a convex hull.

From Jacobians and a ball around each link (Schwarzer, Saha and Latombe 2005; here second order).
"""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from cvqmpt_lab.robot.hulls import enclosing_points
from cvqmpt_lab.robot.robot import Robot


class Sweep:
    """Motion bounds of a robot's links, for many hulls of configurations at once.

    `in_world` bounds the links with these joint ids; `between` the geometry's collision pairs.
    """

    def __init__(self, robot: Robot, geometry: pin.GeometryModel, links: Sequence[int]) -> None:
        self._model, self._data = robot.model, robot.model.createData()
        objects, joints = geometry.geometryObjects, robot.model.njoints
        support = np.zeros((joints, robot.dof), dtype=bool)
        balls = np.zeros((joints, 4))
        for k in range(1, joints):
            support[k, [robot.model.idx_vs[i] for i in robot.model.supports[k] if i > 0]] = True
            balls[k] = _ball_around([item for item in objects if item.parentJoint == k])
        joints = [item.parentJoint for item in objects]
        pairs = [(joints[p.first], joints[p.second]) for p in geometry.collisionPairs]
        unique, pair = np.unique(
            np.array(pairs, dtype=int).reshape(-1, 2), axis=0, return_inverse=True
        )
        a, b = unique.T
        alone = np.array(links, dtype=int)
        self._centres = [
            (int(k), balls[k, :3].copy()) for k in np.unique(np.concatenate([alone, a, b]))
        ]
        self._in_world = _Motions(alone, support[alone], balls, robot.kinematics.prismatic)
        sides = np.concatenate([support[a] & ~support[b], support[b] & ~support[a]])
        self._of_pairs = _Motions(np.concatenate([a, b]), sides, balls, robot.kinematics.prismatic)
        self._pair = pair.reshape(-1)

    def in_world(self, q: np.ndarray, hulls: np.ndarray) -> np.ndarray:
        """Bounds (k, l) [m] on the motion of any point of each link.

        Args:
            q: (k, n), where motions begin.
            hulls: (k, c, n), corners of the hulls that configurations stay in.
        """
        return self._in_world.bounds(*self._posed(q), hulls - q[:, None])

    def between(self, q: np.ndarray, hulls: np.ndarray) -> np.ndarray:
        """Bounds (k, p) [m] on the relative motion of two points of a pair: the sum of theirs."""
        bounds = self._of_pairs.bounds(*self._posed(q), hulls - q[:, None])
        return bounds.reshape(len(q), 2, -1).sum(1)[:, self._pair]

    def _posed(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns of the Jacobians (6, k, n) and centres of the balls (3, k, j) at q (k, n)."""
        columns, poses = np.empty((len(q), 6, self._model.nv)), self._data.oMi
        centres = np.zeros((len(q), self._model.njoints, 3))
        for row, column, moved in zip(q, columns, centres, strict=True):
            jacobian = pin.computeJointJacobians(self._model, self._data, row)
            column[:] = jacobian.reshape(6, -1)  # (6,) of a single joint
            for k, centre in self._centres:
                moved[k] = poses[k].act(centre)
        return columns.transpose(1, 0, 2), centres.transpose(2, 0, 1)


class _Motions:
    """Links (l,), each moved by some joints (l, n) while the others stand still."""

    def __init__(
        self, links: np.ndarray, moving: np.ndarray, balls: np.ndarray, slides: np.ndarray
    ) -> None:
        self._links, self._moving, self._radii = links, moving.astype(float), balls[links, 3, None]
        self._turning = (moving & ~slides).astype(float)

    def bounds(self, columns: np.ndarray, centres: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Bounds (k, l) [m] on the motion of any point x of each link.

        With d the change to a corner of the hull and s_j the largest speed of x per unit of joint
        j, each within the hull:

            |x(q + d) - x(q)| <= |J d| + 1/2 sum_j |d_j| s_j (|d_j| + 2 sum_{i < j} |d_i|)

        The second term bounds half the second derivative along a straight line: for a joint i
        before j, d/dq_i turns the vector axis_j x (x - origin_j), whose length is at most s_j.
        Sliders do not turn: they are left out of the inner sum. s_j grows as joints after j move.

        Args:
            columns: (6, k, n), Jacobian columns.
            centres: (3, k, j), of the links' balls [m].
            changes: (k, c, n), from q to the corners of hulls.
        """
        if len(self._radii) == 0:
            return np.zeros((len(changes), 0))
        v0, v1, v2, w0, w1, w2 = columns[:, :, None]
        x, y, z = centres[:, :, self._links, None]
        # of each link's centre, and its turn
        twists = np.empty((2, 3, len(changes), *self._moving.shape))
        twists[0] = v0 + w1 * z - w2 * y, v1 + w2 * x - w0 * z, v2 + w0 * y - w1 * x
        twists[1] = columns[3:, :, None]
        twists *= self._moving
        first = _lengths(twists @ changes.transpose(0, 2, 1))
        furthest = (first[0] + first[1] * self._radii).max(axis=2)
        speeds, turns = _lengths(twists)
        most = np.abs(changes).max(axis=1)[:, None]
        turned = most * self._turning
        around = 2.0 * np.cumsum(turned, axis=2) - turned
        later, second = np.zeros(furthest.shape), np.zeros(furthest.shape)
        for j in range(self._moving.shape[1] - 1, -1, -1):
            fastest = speeds[..., j] + turns[..., j] * self._radii[:, 0] + later
            moved = most[..., j] * self._moving[:, j] * fastest
            second += 0.5 * around[..., j] * moved
            later += moved
        return furthest + second


def _lengths(vectors: np.ndarray) -> np.ndarray:
    """Lengths |x| of vectors x (2, 3, ...) along the second axis."""
    return np.sqrt(np.einsum("ai...,ai...->a...", vectors, vectors))


def balls_around(items: Sequence[pin.GeometryObject]) -> np.ndarray:
    """Centres and radii (p, 4) [m] of balls around each piece alone."""
    return np.array([_ball_around([item]) for item in items]).reshape(-1, 4)


def _ball_around(items: Sequence[pin.GeometryObject]) -> np.ndarray:
    """Centre in the joint's frame and radius (4,) [m] of a ball that holds pieces."""
    if not items:
        return np.zeros(4)
    placed = [(enclosing_points(item.geometry), item.placement) for item in items]
    corners = np.concatenate([points @ T.rotation.T + T.translation for points, T in placed])
    centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    return np.append(centre, np.linalg.norm(corners - centre, axis=1).max())
