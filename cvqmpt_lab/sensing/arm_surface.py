"""The outer surface of an arm as samples: what a depth camera can see of it, and from where."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.kernels.manifold.kinematics import link_poses
from cvqmpt_lab.robot.robot import LinkGeometry
from cvqmpt_lab.sensing.filters import near_robot
from cvqmpt_lab.sensing.scan import Arm

BURIED = -1e-3
"""[m] samples deeper inside another piece of the arm are not part of its outer surface."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Samples of a surface, spread evenly over its area."""

    points: FloatArray
    """(s, 3) [m, robot base frame]."""
    normals: FloatArray
    """(s, 3), outwards, unit."""
    link: np.ndarray
    """(s,) int, pose row of the link that each is on; 0 is the world."""

    def __getitem__(self, rows: np.ndarray) -> "Surface":
        return Surface(self.points[rows], self.normals[rows], self.link[rows])


def arm_surface(arm: Arm, count: int, rng: np.random.Generator) -> Surface:
    """About `count` samples of the hulls that collision checking takes the links for, without those inside others."""
    (rotations,), (translations,) = link_poses(
        arm.robot.kinematics, np.ascontiguousarray(arm.q, dtype=float)[None]
    )
    triangles, normals = zip(*(_triangles(part) for part in arm.robot.links), strict=True)
    link = np.repeat([part.link for part in arm.robot.links], [len(item) for item in triangles])
    corners, outwards = np.concatenate(triangles), np.concatenate(normals)
    sides = corners[:, 1:] - corners[:, :1]
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    shares = rng.random((count, 2))
    shares = np.where(shares.sum(axis=1, keepdims=True) > 1.0, 1.0 - shares, shares)
    local = corners[face, 0] + np.einsum("sk,ski->si", shares, sides[face])
    turn = rotations[link[face]]
    points = np.einsum("sij,sj->si", turn, local) + translations[link[face]]
    outside = ~near_robot(points, arm.robot, arm.q, BURIED)
    return Surface(points, np.einsum("sij,sj->si", turn, outwards[face]), link[face])[outside]


def _triangles(part: LinkGeometry) -> tuple[FloatArray, FloatArray]:
    """Triangles (t, 3, 3) of a piece's hull and their normals (t, 3), in the frame of its link."""
    T = part.T_link_geometry
    hull = ConvexHull(part.vertices @ T[:3, :3].T + T[:3, 3])
    return hull.points[hull.simplices], hull.equations[:, :3]
