"""How far the points of links can move while joints change: from Jacobians and a ball around each link."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from cvqmpt_lab.robot.robot import Robot


class Sweep:
    """How far points of a robot can move while its configuration stays in a hull."""

    def __init__(self, robot: Robot, geometry: pin.GeometryModel, links: Sequence[int]) -> None:
        """links: joints whose motion in the world is asked for; pairs of pieces are the geometry's."""
        objects, joints = geometry.geometryObjects, robot.model.njoints
        support = np.zeros((joints, robot.dof), dtype=bool)
        balls = np.zeros((joints, 4))
        for k in range(1, joints):
            support[k, [robot.model.idx_vs[i] for i in robot.model.supports[k] if i > 0]] = True
            balls[k] = _ball_around([_ball(item) for item in objects if item.parentJoint == k])
        pairs = [
            (objects[p.first].parentJoint, objects[p.second].parentJoint) for p in geometry.collisionPairs
        ]
        unique, pair = np.unique(np.array(pairs, dtype=int).reshape(-1, 2), axis=0, return_inverse=True)
        a, b = unique.T
        alone = np.array(links, dtype=int)
        self._in_world = _Motions(alone, support[alone], balls)
        sides = np.concatenate([support[a] & ~support[b], support[b] & ~support[a]])
        self._of_pairs = _Motions(np.concatenate([a, b]), sides, balls)
        self._pair = pair.reshape(-1)

    def in_world(self, data: pin.Data, changes: np.ndarray) -> np.ndarray:
        """Bounds (l,) [m] on the motion of any point of each link, from where data has it.

        changes: (k, n), to the corners of a hull of configurations; the bound holds for all in it.
        """
        return self._in_world.bounds(data, changes)

    def between(self, data: pin.Data, changes: np.ndarray) -> np.ndarray:
        """Bounds (p,) [m] on the motion of any two points of each pair of pieces against each other."""
        return self._of_pairs.bounds(data, changes).reshape(2, -1).sum(0)[self._pair]


class _Motions:
    """Some links, each moved by some joints while the others stand still."""

    def __init__(self, links: np.ndarray, moving: np.ndarray, balls: np.ndarray) -> None:
        """links: (l,) joints that carry them. moving: (l, n). balls: (joints, 4), around what each carries."""
        joints, self._row = np.unique(links, return_inverse=True)
        self._balls = [(int(k), balls[k, :3].copy()) for k in joints]
        self._moving, self._radii = moving.astype(float), balls[links, 3]

    def bounds(self, data: pin.Data, changes: np.ndarray) -> np.ndarray:
        """How far any point of each link can move (l,) [m].

        To first order a point moves as the Jacobian says. What is left is at most angle * way, where `angle` is the
        sum of all joints' turns, and `way` the sum of what each joint alone moves the point: its distance from the
        axis, which itself grows by no more than the way.
        """
        if len(self._radii) == 0:
            return np.zeros(0)
        J, poses = data.J, data.oMi
        x, y, z = np.array([poses[k].act(centre) for k, centre in self._balls]).T[:, self._row, None]
        v0, v1, v2, w0, w1, w2 = J
        twists = np.empty(
            (6, *self._moving.shape)
        )  # of each link, by each joint: its centre's, then its turn
        twists[0], twists[1], twists[2] = v0 + w1 * z - w2 * y, v1 + w2 * x - w0 * z, v2 + w0 * y - w1 * x
        twists[3:] = J[3:, None]
        twists *= self._moving
        joint = np.sqrt(np.einsum("aclj,aclj->alj", *[twists.reshape(2, 3, *self._moving.shape)] * 2))
        total = twists @ changes.T
        first = np.sqrt(np.einsum("aclk,aclk->alk", *[total.reshape(2, 3, *total.shape[1:])] * 2))
        furthest = (first[0] + first[1] * self._radii[:, None]).max(axis=1)
        way, angle = joint @ np.abs(changes).max(axis=0)
        way = way + angle * self._radii
        return np.where(angle < 0.8, furthest + angle * way / (1.0 - np.minimum(angle, 0.8)), np.inf)


def _ball(item: pin.GeometryObject) -> np.ndarray:
    """Centre in the joint's frame and radius of a ball around a piece, (4,) [m]."""
    item.geometry.computeLocalAABB()
    return np.append(item.placement.act(np.array(item.geometry.aabb_center)), item.geometry.aabb_radius)


def _ball_around(balls: list[np.ndarray]) -> np.ndarray:
    """A ball (4,) that holds others (4,) [m]."""
    if not balls:
        return np.zeros(4)
    centre = np.mean(balls, axis=0)[:3]
    return np.append(centre, max(np.linalg.norm(ball[:3] - centre) + ball[3] for ball in balls))
