"""Find the supporting plane of a scan; level the scan by it if the camera's pose is unknown."""

from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import rigid
from cvqmpt_lab.base.values import FloatArray
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box

PLANE_TOLERANCE_M = 0.01  # points this near are on the plane: table tops bend, cameras err
CAMERA_UP = np.array([0.0, -1.0, 0.0])  # in an optical frame: x right, y down, z ahead


class SupportingPlane(NamedTuple):
    """The plane n x = d in a cloud, with unit normal n and offset d."""

    normal: FloatArray  # (3,) of length 1, away from the support
    offset: float  # [m]
    share: float  # share of the cloud's points on the plane
    residual: float  # root mean square distance of these points [m]


def supporting_plane(
    points: FloatArray,
    up: FloatArray,
    tilt: float,
    rng: np.random.Generator,
    least: float = 0.1,
    fewest: int = 30,
    most: int = 50_000,
    rounds: int = 3,
) -> SupportingPlane:
    """Return the plane n x = d with the most points, by RANSAC and then least squares (SVD).

    Args:
        points: (m, 3) [m].
        up: (3,) expected normal.
        tilt: largest angle between the normal and `up` [rad].
        rng: random numbers for triples of points.
        least: smallest share of points on the plane.
        fewest: smallest number of points on the plane.
        most: largest number of points that the plane is fitted to.
        rounds: number of least-squares fits.

    Raises:
        InvalidInputError: no plane with such a normal has enough points.
    """
    some = points[rng.integers(len(points), size=min(len(points), most))]
    normal, offset = _ransac(some, up, tilt, rng)
    for _ in range(rounds):
        near = some[np.abs(some @ normal - offset) <= PLANE_TOLERANCE_M]
        if len(near) < 3:
            break
        middle = near.mean(axis=0)
        fitted = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        normal = fitted if fitted @ normal > 0.0 else -fitted
        offset = float(normal @ middle)
    heights = points @ normal - offset
    on = np.abs(heights) <= PLANE_TOLERANCE_M
    share = float(on.mean())
    if share < least or on.sum() < fewest or normal @ up < np.cos(tilt):
        raise InvalidInputError(
            f"no supporting plane: the best one has {on.sum()} of {len(points)} points, "
            f"{least:.0%} and {fewest} are needed; crop the cloud to the table, or give the "
            "camera's pose"
        )
    return SupportingPlane(normal, offset, share, float(np.sqrt(np.mean(heights[on] ** 2))))


def table_below(
    points: FloatArray, down: float, highest: float, rng: np.random.Generator
) -> SupportingPlane:
    """Return the largest plane below a camera without roll that is level within 30 deg.

    In the frame of a camera that looks down by the angle p, up is (0, -cos p, -sin p).

    Args:
        points: (m, 3) [m] in the optical frame.
        down: p, from 0 (ahead) to pi / 2 (straight down) [rad].
        highest: largest height of the camera above the plane [m].
        rng: random numbers for triples of points.

    Raises:
        InvalidInputError: there is no such plane; the message describes the largest plane.
    """
    tilt = np.radians(30.0)
    if not 0.0 <= down <= 0.5 * np.pi:
        raise InvalidInputError(
            f"a camera that looks {np.degrees(down):g} deg down: give from 0 (ahead) to 90"
        )
    up = np.array([0.0, -np.cos(down), -np.sin(down)])
    level = (
        f"level within {np.degrees(tilt):.0f} deg for a camera that looks "
        f"{np.degrees(down):g} deg down"
    )
    cure = (
        "crop the cloud to the table, give the camera's pose (--extrinsics), or the angle by which "
        "it looks down (--down)"
    )
    try:
        plane = supporting_plane(points, up, tilt, rng)
    except InvalidInputError as error:
        largest = supporting_plane(points, up, np.pi, rng)
        towards_camera = -np.sign(largest.offset) * largest.normal
        angle = np.degrees(np.arccos(np.clip(towards_camera @ up, -1.0, 1.0)))
        raise InvalidInputError(
            f"no table: the largest plane, of {largest.share:.0%} of the points, is "
            f"{angle:.0f} deg off level, and no plane of 10% of the points is {level}; {cure}"
        ) from error
    if not 0.0 < -plane.offset <= highest:
        raise InvalidInputError(
            f"no table: the camera is {-plane.offset:.2f} m above the largest plane that is "
            f"{level}, of {plane.share:.0%} of the points; it must be above it, at most "
            f"{highest:.2f} m (the arm's reach); {cure}"
        )
    return plane


def _ransac(
    points: FloatArray,
    up: FloatArray,
    tilt: float,
    rng: np.random.Generator,
    triples: int = 1000,
    sample: int = 3000,
) -> tuple[FloatArray, float]:
    """Return normal (3,) and offset [m] of the best plane through one of `triples` of points.

    The best plane has the most of `sample` random points. If a fifth of the cloud is a table, one
    triple in a hundred is on it.
    """
    a, b, c = points[rng.integers(len(points), size=(3, triples))]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals[lengths > 0.0] /= lengths[lengths > 0.0, None]
    normals[normals @ up < 0.0] *= -1.0
    allowed = (lengths > 0.0) & (normals @ up >= np.cos(tilt))
    if not allowed.any():
        return up, np.inf
    normals, a = normals[allowed], a[allowed]
    offsets = np.einsum("ij,ij->i", normals, a)
    some = points[rng.integers(len(points), size=min(len(points), sample))]
    counts = (np.abs(some @ normals.T - offsets) <= PLANE_TOLERANCE_M).sum(axis=0)
    best = int(np.argmax(counts))
    return normals[best], float(offsets[best])


def level_pose(
    points: FloatArray,
    plane: SupportingPlane,
    front: tuple[float, float, float],
    edge: float = 0.02,
) -> FloatArray:
    """Return T_world_camera (4, 4) by which the table is horizontal with its near edge at `front`.

    The table is ahead of the camera.

    Args:
        points: (m, 3) [m] in the optical frame, as for `table_below`.
        plane: plane of the table.
        front: middle of the table's near edge in the world [m].
        edge: quantile of the table's points that is taken as its edge; outside of it the table is
            visible only in part.
    """
    # if the normal is within 11 deg of the camera's axis, "ahead" is the upper side of the image
    straight_down = abs(plane.normal[2]) > np.cos(np.radians(11.0))
    R = _axes(plane.normal, CAMERA_UP if straight_down else np.array([0.0, 0.0, 1.0]))
    table = points[on_table(points, plane)] @ R.T
    near = np.quantile(table[:, 0], edge)
    middle = np.quantile(table[:, 1], (edge, 1.0 - edge)).mean()
    return rigid(R, np.array(front) - (near, middle, plane.offset))


def on_table(points: FloatArray, plane: SupportingPlane, gap: float = 0.05) -> np.ndarray:
    """Return a mask (m,) of points (m, 3) [m] on the plane's largest patch without a `gap` [m]."""
    on = np.abs(points @ plane.normal - plane.offset) <= PLANE_TOLERANCE_M
    across = points[on] @ _axes(plane.normal, np.eye(3)[np.argmin(np.abs(plane.normal))])[:2].T
    cells = np.floor((across - across.min(axis=0)) / gap).astype(int)
    taken = np.zeros(cells.max(axis=0) + 1, dtype=bool)
    taken[tuple(cells.T)] = True
    from scipy import ndimage  # takes 0.1 s to import

    patch = ndimage.label(taken, np.ones((3, 3)))[0][tuple(cells.T)]
    on[on] = patch == np.bincount(patch).argmax()
    return on


def box_around(points: FloatArray, plane: SupportingPlane) -> SceneObject:
    """Return a flat box "table" in the plane that contains points (m, 3) [m, world] of it."""
    axes = _axes(plane.normal, np.array([1.0, 0.0, 0.0]))
    along = points @ axes.T
    low, high = along.min(axis=0), along.max(axis=0)
    T = rigid(axes.T, axes.T @ (*(0.5 * (low + high))[:2], plane.offset))
    length, width = np.maximum(high - low, 2.0 * PLANE_TOLERANCE_M)[:2].tolist()
    return SceneObject("table", Box((length, width, 2.0 * PLANE_TOLERANCE_M)), T)


def _axes(normal: FloatArray, ahead: FloatArray) -> FloatArray:
    """Return a frame (3, 3), rows x, y, z: z is the normal, x is nearest to `ahead`."""
    x = ahead - np.dot(ahead, normal) * normal
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])
