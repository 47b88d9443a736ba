"""Bounds on the motion of a robot's points while its configuration stays in a convex hull.

They are computed from Jacobians and a ball around each link (Schwarzer, Saha and Latombe 2005; here
of second order).
"""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from cvqmpt_lab.robot.hulls import enclosing_points
from cvqmpt_lab.robot.joint_frames import joint_frames
from cvqmpt_lab.robot.robot import Robot


class Sweep:
    """Motion bounds of a robot's links, for many hulls of configurations at once.

    `in_world` bounds links, given by their joint ids; `between` the geometry's collision pairs.
    """

    def __init__(self, robot: Robot, geometry: pin.GeometryModel, links: Sequence[int]) -> None:
        self.frames = joint_frames(robot)
        # bounds cover all joints; values of mimic joints are linear in q
        self._kinematics = robot.kinematics
        objects, joints = geometry.geometryObjects, robot.model.njoints
        support = np.zeros((joints, robot.model.nv), dtype=bool)
        self._balls = np.zeros((joints, 4))
        for k in range(1, joints):
            support[k, [robot.model.idx_vs[i] for i in robot.model.supports[k] if i > 0]] = True
            self._balls[k] = ball_around([item for item in objects if item.parentJoint == k])
        joint_of = [item.parentJoint for item in objects]
        pairs = [(joint_of[p.first], joint_of[p.second]) for p in geometry.collisionPairs]
        (a, b), self._pair = np.unique(
            np.array(pairs, dtype=int).reshape(-1, 2).T, axis=1, return_inverse=True
        )
        self._pair = self._pair.reshape(-1)
        self._links = np.array(links, dtype=int)
        self._moving = support[self._links]
        self._sides = np.concatenate([a, b])
        self._moving_sides = np.concatenate([support[a] & ~support[b], support[b] & ~support[a]])

    def in_world(
        self, q: np.ndarray, hulls: np.ndarray, skipped: np.ndarray | None = None
    ) -> np.ndarray:
        """Bounds (k, l) [m] on the motion of any point of each link.

        Args:
            q: (k, n), where motions begin.
            hulls: (k, c, n), corners of hulls of configurations.
            skipped: (k,) int, number of leading links that are left out: their bound is 0.
        """
        if skipped is None:
            skipped = np.zeros(len(q), dtype=int)
        q, hulls = self._kinematics.joint_values(q), self._kinematics.joint_values(hulls)
        bounds = np.zeros((len(q), len(self._links)))
        first = int(skipped.min(initial=len(self._links)))
        links, moving = self._links[first:], self._moving[first:]
        bounds[:, first:] = self._bounds(links, moving, q, hulls, self.frames.poses(q))
        bounds[np.arange(len(self._links)) < skipped[:, None]] = 0.0
        return bounds

    def poses(self, q: np.ndarray) -> np.ndarray:
        """Poses (joints + 1, k, 4, 4) of all frames at configurations (k, n)."""
        return self.frames.poses(self._kinematics.joint_values(q))

    def between(self, q: np.ndarray, hulls: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Bounds (k, p) [m] on the relative motion of two points of a pair: sums of two bounds.

        Args:
            q: (k, n), where motions begin.
            hulls: (k, c, n), corners of hulls of configurations.
            poses: of `q`, see `poses`.
        """
        q, hulls = self._kinematics.joint_values(q), self._kinematics.joint_values(hulls)
        bounds = self._bounds(self._sides, self._moving_sides, q, hulls, poses)
        first, second = np.split(bounds, 2, axis=1)
        return (first + second)[:, self._pair]

    def _bounds(
        self,
        links: np.ndarray,
        moving: np.ndarray,
        q: np.ndarray,
        hulls: np.ndarray,
        poses: np.ndarray,
    ) -> np.ndarray:
        """Bounds (k, l) [m] on the motion of any point x of each link, by some joints alone.

        With d the change from q to a corner of the hull and s_j the largest speed of x per unit of
        joint j, each within the hull:

            |x(q + d) - x(q)| <= |J d| + 1/2 sum_j |d_j| s_j (|d_j| + 2 sum_{i < j} |d_i|)

        The second term bounds half the second derivative along a straight line: for a joint i
        before j, d/dq_i turns the vector axis_j x (x - origin_j), whose length is at most s_j.
        Sliders do not turn: they are left out of the inner sum. s_j grows as joints after j move.

        n counts all joints, mimic joints included.

        Args:
            links: (l,), joint ids.
            moving: (l, n) bool, the joints that move each link; the others are fixed.
            q: (k, n).
            hulls: (k, c, n).
            poses: (n + 1, k, 4, 4) of all frames at q.
        """
        if len(links) == 0:
            return np.zeros((len(q), 0))
        hinges, balls, placed = self.frames.hinges, self._balls[links, :3, None], poses[links]
        centres = (placed[..., :3, :3] @ balls[:, None])[..., 0] + placed[..., :3, 3]
        # axes of joints (3, k, 1, n), and centres of the links' balls from the joints' origins [m]
        w0, w1, w2 = self.frames.axes(poses).transpose(2, 1, 0)[:, :, None]
        x, y, z = (centres[:, None] - poses[1:, :, :3, 3]).transpose(3, 2, 0, 1)
        # velocities of each link's centre, and angular velocities
        twists = np.empty((2, 3, len(q), *moving.shape))
        for a, product in enumerate((w1 * z - w2 * y, w2 * x - w0 * z, w0 * y - w1 * x)):
            twists[0, a] = product
        twists[1] = w0, w1, w2
        if not hinges.all():
            twists[0][..., ~hinges] = twists[1][..., ~hinges]
            twists[1][..., ~hinges] = 0.0
        twists *= moving
        changes, radii = hulls - q[:, None], self._balls[links, 3, None]
        first = _lengths(twists @ changes.transpose(0, 2, 1))
        furthest = (first[0] + first[1] * radii).max(axis=2)
        speeds, turns = _lengths(twists)
        most = np.abs(changes).max(axis=1)[:, None] * moving
        turned = most * hinges
        around = turned.cumsum(axis=2) - 0.5 * turned
        # joints first: what a step of the loop reads is contiguous
        most = np.ascontiguousarray(most.transpose(2, 0, 1))
        fastest = np.ascontiguousarray((speeds + turns * radii).transpose(2, 0, 1))
        later = np.zeros(furthest.shape)
        for j in range(moving.shape[1] - 1, -1, -1):
            fastest[j] += later
            later += most[j] * fastest[j]
        second = np.einsum("klj,jkl,jkl->kl", around, most, fastest)
        return furthest + second


def _lengths(vectors: np.ndarray) -> np.ndarray:
    """Lengths |x| of vectors x (2, 3, ...) along the second axis."""
    return np.sqrt(np.einsum("ai...,ai...->a...", vectors, vectors))


def ball_around(items: Sequence[pin.GeometryObject]) -> np.ndarray:
    """Centre in the joint's frame and radius (4,) [m] of a ball that contains pieces."""
    if not items:
        return np.zeros(4)
    placed = [(enclosing_points(item.geometry), item.placement) for item in items]
    corners = np.concatenate([points @ T.rotation.T + T.translation for points, T in placed])
    centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    return np.append(centre, np.linalg.norm(corners - centre, axis=1).max())
