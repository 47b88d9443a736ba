"""The supporting plane of a scan, and how the scan is levelled by it without a camera pose."""

from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import rigid
from cvqmpt_lab.base.values import FloatArray
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box

TOLERANCE = 0.01  # [m] from a plane that counts as on it: table tops bend, and cameras err
CAMERA_UP = np.array([0.0, -1.0, 0.0])  # of an optical frame: x right, y down, z ahead
CAMERA_TILT = np.radians(30.0)  # from a table's normal to the vertical that the camera's pitch says
WORLD_TILT = np.radians(15.0)  # the same for the world's up, when the camera's pose is known


class SupportingPlane(NamedTuple):
    """The plane n x = d in a cloud, with unit normal n and offset d."""

    normal: FloatArray  # (3,), of length 1, towards where things stand
    offset: float  # [m]
    share: float  # of the cloud's points on it
    residual: float  # root mean square distance of those from it [m]


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
    """The plane `n x = d` that holds the most points, by RANSAC and then least squares (SVD).

    Args:
        points: (m, 3) [m].
        up: (3,), from which the normal n is at most `tilt` [rad] off.
        tilt: see `up`.
        rng: draws triples of points.
        least: share of the points that it must hold.
        fewest: number of points that it must hold.
        most: points that it is fitted to.
        rounds: of least squares.

    Raises InvalidInputError if no such plane holds enough points.
    """
    some = points[rng.integers(len(points), size=min(len(points), most))]
    normal, offset = _ransac(some, up, tilt, rng)
    for _ in range(rounds):
        held = some[np.abs(some @ normal - offset) <= TOLERANCE]
        if len(held) < 3:
            break
        middle = held.mean(axis=0)
        fitted = np.linalg.svd(held - middle, full_matrices=False)[2][2]
        normal = fitted if fitted @ normal > 0.0 else -fitted
        offset = float(normal @ middle)
    heights = points @ normal - offset
    on = np.abs(heights) <= TOLERANCE
    share = float(on.mean())
    if share < least or on.sum() < fewest or normal @ up < np.cos(tilt):
        raise InvalidInputError(
            f"no supporting plane: the best one holds {on.sum()} of {len(points)} points, "
            f"{least:.0%} and {fewest} are needed; crop the cloud to the table, or give the "
            "camera's pose"
        )
    return SupportingPlane(normal, offset, share, float(np.sqrt(np.mean(heights[on] ** 2))))


def table_below(
    points: FloatArray, down: float, highest: float, rng: np.random.Generator
) -> SupportingPlane:
    """The largest plane that is level within `CAMERA_TILT`, below a camera that is not rolled.

    A camera that looks down by the angle p has the vertical u = (0, -cos p, -sin p).

    Args:
        points: (m, 3) [m] in the optical frame.
        down: p, from 0 (ahead) to pi / 2 (straight down) [rad].
        highest: that the camera may be above the plane [m].
        rng: draws triples of points.

    Raises InvalidInputError, which says what was found, if there is no such plane.
    """
    if not 0.0 <= down <= 0.5 * np.pi:
        raise InvalidInputError(
            f"a camera that looks {np.degrees(down):g} deg down: give from 0 (ahead) to 90"
        )
    up = np.array([0.0, -np.cos(down), -np.sin(down)])
    level = (
        f"level within {np.degrees(CAMERA_TILT):.0f} deg for a camera that looks "
        f"{np.degrees(down):g} deg down"
    )
    cure = (
        "crop the cloud to the table, give the camera's pose (--extrinsics), or the angle by which "
        "it looks down (--down)"
    )
    try:
        plane = supporting_plane(points, up, CAMERA_TILT, rng)
    except InvalidInputError as error:
        largest = supporting_plane(points, up, np.pi, rng)
        towards = -np.sign(largest.offset) * largest.normal  # the camera
        raise InvalidInputError(
            f"no table: the largest plane, of {largest.share:.0%} of the points, is "
            f"{np.degrees(np.arccos(np.clip(towards @ up, -1.0, 1.0))):.0f} deg off level, and "
            f"none of 10% of the points is {level}; {cure}"
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
    judges: int = 3000,
) -> tuple[FloatArray, float]:
    """Normal (3,) and offset [m] of the best of `triples` planes, by how many of `judges` lie near.

    If a table is a fifth of the cloud, one in a hundred triples of points lies on it.
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
    some = points[rng.integers(len(points), size=min(len(points), judges))]
    counts = (np.abs(some @ normals.T - offsets) <= TOLERANCE).sum(axis=0)
    best = int(np.argmax(counts))
    return normals[best], float(offsets[best])


def level_pose(
    points: FloatArray,
    plane: SupportingPlane,
    front: tuple[float, float, float],
    edge: float = 0.02,
) -> FloatArray:
    """T_world_camera (4, 4) that makes the table horizontal, its near edge's middle at `front` [m].

    The table lies ahead of the camera's eye.

    Args:
        points: (m, 3) [m] in the optical frame, in which the plane was found.
        plane: of the table.
        front: middle of the table's near edge [m].
        edge: quantile of the table's points that counts as its edge; what lies beyond was seen only
            in part.
    """
    # nearer to the camera's axis than 11 deg, "ahead" is the image's upper side
    straight_down = abs(plane.normal[2]) > np.cos(np.radians(11.0))
    R = _axes(plane.normal, CAMERA_UP if straight_down else np.array([0.0, 0.0, 1.0]))
    table = points[on_table(points, plane)] @ R.T
    near = np.quantile(table[:, 0], edge)
    middle = np.quantile(table[:, 1], (edge, 1.0 - edge)).mean()
    return rigid(R, np.array(front) - (near, middle, plane.offset))


def on_table(points: FloatArray, plane: SupportingPlane, gap: float = 0.05) -> np.ndarray:
    """Mask (m,) of points (m, 3) [m] on the plane's largest patch without gaps over `gap` [m]."""
    held = np.abs(points @ plane.normal - plane.offset) <= TOLERANCE
    across = points[held] @ _axes(plane.normal, np.eye(3)[np.argmin(np.abs(plane.normal))])[:2].T
    cells = np.floor((across - across.min(axis=0)) / gap).astype(int)
    taken = np.zeros(cells.max(axis=0) + 1, dtype=bool)
    taken[tuple(cells.T)] = True
    # a tenth of a second to import, which plans without scans need not pay
    from scipy import ndimage

    patch = ndimage.label(taken, np.ones((3, 3)))[0][tuple(cells.T)]
    held[held] = patch == np.bincount(patch).argmax()
    return held


def box_around(points: FloatArray, plane: SupportingPlane) -> SceneObject:
    """A flat box "table", level with the plane, that holds points (m, 3) [m, world] of it."""
    axes = _axes(plane.normal, np.array([1.0, 0.0, 0.0]))
    along = points @ axes.T
    low, high = along.min(axis=0), along.max(axis=0)
    T = rigid(axes.T, axes.T @ (*(0.5 * (low + high))[:2], plane.offset))
    length, width = np.maximum(high - low, 2.0 * TOLERANCE)[:2].tolist()
    return SceneObject("table", Box((length, width, 2.0 * TOLERANCE)), T)


def _axes(normal: FloatArray, ahead: FloatArray) -> FloatArray:
    """A frame (3, 3), rows x, y, z, whose z is the normal and whose x points ahead."""
    x = ahead - np.dot(ahead, normal) * normal
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])
