"""How far points of a robot can move while its joints change:
bounds from Jacobians and a ball around each link.
"""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from cvqmpt_lab.robot.hulls import enclosing_points
from cvqmpt_lab.robot.robot import Robot


class Sweep:
    """Bounds on the motion of points of a robot whose configuration stays in a convex hull;
    many hulls at once.
    """

    def __init__(self, robot: Robot, geometry: pin.GeometryModel, links: Sequence[int]) -> None:
        """links: joints of `in_world`; `between` is about the collision pairs of the geometry."""
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
        """Bounds (k, l) [m] on the motion of any point of each link from q (k, n), in hulls with
        corners (k, c, n).
        """
        return self._in_world.bounds(*self._posed(q), hulls - q[:, None])

    def between(self, q: np.ndarray, hulls: np.ndarray) -> np.ndarray:
        """Bounds (k, p) [m] on the motion of any two points of each pair of pieces against each
        other.
        """
        bounds = self._of_pairs.bounds(*self._posed(q), hulls - q[:, None])
        return bounds.reshape(len(q), 2, -1).sum(1)[:, self._pair]

    def _posed(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """At each of q (k, n):
        the Jacobians' columns (6, k, n), and the centres of the joints' balls (3, k, j).
        """
        columns, poses = np.empty((len(q), 6, self._model.nv)), self._data.oMi
        centres = np.zeros((len(q), self._model.njoints, 3))
        for row, column, moved in zip(q, columns, centres, strict=True):
            jacobian = pin.computeJointJacobians(self._model, self._data, row)
            column[:] = jacobian.reshape(6, -1)  # (6,) of a single joint
            for k, centre in self._centres:
                moved[k] = poses[k].act(centre)
        return columns.transpose(1, 0, 2), centres.transpose(2, 0, 1)


class _Motions:
    """Links, each moved by some joints while the others stand still."""

    def __init__(
        self, links: np.ndarray, moving: np.ndarray, balls: np.ndarray, slides: np.ndarray
    ) -> None:
        """links: (l,) joints that carry them. moving: (l, n). balls:
        (joints, 4), around what each carries.
        """
        self._links, self._moving, self._radii = links, moving.astype(float), balls[links, 3, None]
        self._turning = (moving & ~slides).astype(float)

    def bounds(self, columns: np.ndarray, centres: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Bounds (k, l) [m] on the motion of any point of each link, changes (k, c, n) leading to
        corners of hulls.

        The first-order part is the Jacobian's, |J dq|; the rest is half the second derivative along
        a straight line. For joints i and j, j further out, d/dq_i of (axis_j x (point - origin_j))
        is a rotation of that vector, so its length is at most lever_j, the speed of the point per
        turn of j. A lever grows as the joints after it move.
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
        way, second = np.zeros(furthest.shape), np.zeros(furthest.shape)
        for j in range(self._moving.shape[1] - 1, -1, -1):
            fastest = speeds[..., j] + turns[..., j] * self._radii[:, 0] + way
            moved = most[..., j] * self._moving[:, j] * fastest
            second += 0.5 * around[..., j] * moved
            way += moved
        return furthest + second


def _lengths(vectors: np.ndarray) -> np.ndarray:
    """Of vectors (2, 3, ...) along the second axis."""
    return np.sqrt(np.einsum("ai...,ai...->a...", vectors, vectors))


def balls_around(items: Sequence[pin.GeometryObject]) -> np.ndarray:
    """`_ball_around` each piece alone, (p, 4) [m]."""
    return np.array([_ball_around([item]) for item in items]).reshape(-1, 4)


def _ball_around(items: Sequence[pin.GeometryObject]) -> np.ndarray:
    """Centre in the joint's frame and radius of a ball that holds pieces, (4,) [m]."""
    if not items:
        return np.zeros(4)
    placed = [(enclosing_points(item.geometry), item.placement) for item in items]
    corners = np.concatenate([points @ T.rotation.T + T.translation for points, T in placed])
    centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    return np.append(centre, np.linalg.norm(corners - centre, axis=1).max())
