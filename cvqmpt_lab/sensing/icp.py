"""Point-to-plane ICP of measured points onto the surface of an arm, and that surface as samples
with normals.

Minimised over a small motion of the camera and a systematic error o of its depths is
sum_i w_i (n_i . (T p_i + o a_i - s_i))^2 + a prior on o, for points p_i, rays a_i, and the nearest
surface sample s_i with normal n_i; weights w_i = (1 - (d_i / reach)^2)^2 (Tukey) leave out points
that are no part of the surface.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation

from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.sensing.filters import near_robot
from cvqmpt_lab.sensing.scan import Arm
from cvqmpt_lab.values import FloatArray

# [m] samples deeper inside another piece of the arm are not part of its outer surface
BURIED = -1e-3
# [m] points farther from the surface are left out, in turn
REACHES = (0.06, 0.04, 0.025, 0.015, 0.01, 0.006)
STEPS = 5  # Gauss-Newton steps with each
INLIERS = 0.02  # [m] points no farther from the surface in the end lie on it
MOST_POINTS = 100_000  # considered; of those near the surface a tenth is used
OFFSET = 0.004  # [m] standard deviation of a camera's systematic error of depth
NOISE = 0.003  # [m] standard deviation of what points otherwise are off
INDEPENDENT = 1000  # as many of their errors are taken as independent
STIFF = 1e-6  # keeps equations solvable


@dataclass(frozen=True, eq=False)
class Surface:
    """Samples of a surface, spread evenly over its area."""

    points: FloatArray  # (s, 3) [m, robot base frame]
    normals: FloatArray  # (s, 3), outwards, unit
    link: np.ndarray  # (s,) int, pose row of the link that each is on; 0 is the world

    def __getitem__(self, rows: np.ndarray) -> "Surface":
        return Surface(self.points[rows], self.normals[rows], self.link[rows])


def arm_surface(arm: Arm, count: int, rng: np.random.Generator) -> Surface:
    """About `count` samples of the hulls that collision checking takes the links for, without those
    inside others.
    """
    q = np.ascontiguousarray(arm.q, dtype=float)
    (rotations,), (translations,) = link_poses(arm.robot.kinematics, q[None])
    links = arm.robot.links
    hulls = [ConvexHull(part.vertices_in_link) for part in links]
    link = np.repeat([part.link for part in links], [len(hull.simplices) for hull in hulls])
    corners = np.concatenate([hull.points[hull.simplices] for hull in hulls])
    outwards = np.concatenate([hull.equations[:, :3] for hull in hulls])
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


class IcpResult(NamedTuple):
    """A camera's pose at which its points lie on the surface."""

    T_world_camera: FloatArray  # (4, 4) [m]
    # root mean square distance of the points on the surface from it [m]; inf without any
    residual: float
    deviation: float  # standard deviation of the camera's position [m], by a jackknife over links


class _Planes(NamedTuple):
    """Points that are near the surface, and the planes that it has there."""

    distance: FloatArray  # (k,), of each point from its plane [m]
    # (k, 7), its change by a turn about the middle [rad], a shift [m], and more depth [m]
    rows: FloatArray
    middle: FloatArray  # (3,) [m]
    link: np.ndarray  # (k,) int, of the surface under each


def point_to_plane_icp(
    points: FloatArray, surface: Surface, T_start: FloatArray, rng: np.random.Generator
) -> IcpResult:
    """Align points (m, 3) [m, camera frame] with the surface [world], from a pose (4, 4) that is
    nearly right.
    """
    tree, T, offset = cKDTree(surface.points), T_start, 0.0
    some = points[rng.permutation(len(points))[:MOST_POINTS]]
    placed = some @ T[:3, :3].T + T[:3, 3]
    close = np.isfinite(tree.query(placed, distance_upper_bound=2.0 * REACHES[0])[0])
    some = some[close][: MOST_POINTS // 10]
    for reach in np.repeat(REACHES, STEPS):
        planes = _planes(some, offset, surface, tree, T, reach)
        if len(planes.distance) < 7:
            return IcpResult(T, np.inf, np.inf)
        H, g = _equations(planes, np.square(1.0 - np.square(planes.distance / reach)), offset)
        step = -np.linalg.solve(H, g)
        motion = small_motions(step[None, :6])[0]
        motion[:3, 3] += planes.middle - motion[:3, :3] @ planes.middle
        T, offset = motion @ T, offset + step[6]
    planes = _planes(some, offset, surface, tree, T, INLIERS)
    weight = np.square(1.0 - np.square(planes.distance / INLIERS))
    residual = float(np.sqrt(np.mean(np.square(planes.distance))))
    return IcpResult(T, residual, _deviation(planes, weight, offset, T[:3, 3] - planes.middle))


def _equations(planes: _Planes, weight: FloatArray, offset: float) -> tuple[FloatArray, FloatArray]:
    """Normal equations (7, 7), (7,) of a step, in which a systematic error of depth is small [m]."""
    H = (weight[:, None] * planes.rows).T @ planes.rows + STIFF * np.eye(7)
    g = planes.rows.T @ (weight * planes.distance)
    prior = weight.sum() / INDEPENDENT * (NOISE / OFFSET) ** 2
    H[6, 6] += prior
    g[6] += prior * offset
    return H, g


def _deviation(planes: _Planes, weight: FloatArray, offset: float, to_camera: FloatArray) -> float:
    """Standard deviation [m] of the camera's position, by the jackknife over links."""
    links = np.unique(planes.link)
    if len(links) < 2:
        return np.inf
    moved = []
    for link in links:
        H, g = _equations(planes, weight * (planes.link != link), offset)
        step = -np.linalg.solve(H, g)
        moved.append(np.cross(step[:3], to_camera) + step[3:6])
    away = moved - np.mean(moved, axis=0)
    spread = np.linalg.eigvalsh(away.T @ away)[-1]
    return float(np.sqrt(spread * (len(links) - 1) / len(links)))


def small_motions(changes: np.ndarray) -> FloatArray:
    """Motions (k, 4, 4) by rotation vectors [rad] and shifts [m], the halves of changes (k, 6)."""
    T = np.tile(np.eye(4), (len(changes), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_rotvec(changes[:, :3]).as_matrix(), changes[:, 3:]
    return T


def _planes(
    points: FloatArray, offset: float, surface: Surface, tree: cKDTree, T: FloatArray, reach: float
) -> _Planes:
    """Points (m, 3) [camera frame], an offset [m] farther, that are within reach [m] of what faces
    the camera.
    """
    away = points / np.linalg.norm(points, axis=1, keepdims=True)
    placed, away = (points + offset * away) @ T[:3, :3].T + T[:3, 3], away @ T[:3, :3].T
    far, nearest = tree.query(placed, distance_upper_bound=1.5 * reach)
    found = np.isfinite(far)
    placed, away, nearest = placed[found], away[found], nearest[found]
    normals, on = surface.normals[nearest], surface.points[nearest]
    distance = np.einsum("ki,ki->k", normals, placed - on)
    good = (np.abs(distance) < reach) & (np.einsum("ki,ki->k", normals, T[:3, 3] - on) > 0.0)
    placed, away, normals = placed[good], away[good], normals[good]
    middle = placed.mean(axis=0) if len(placed) else np.zeros(3)
    along = np.einsum("ki,ki->k", normals, away)[:, None]
    rows = np.hstack([np.cross(placed - middle, normals), normals, along])
    return _Planes(distance[good], rows, middle, surface.link[nearest[good]])
