"""Where rays enter and leave shapes, in numpy."""

import numpy as np
from scipy.spatial import ConvexHull

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Shape, Sphere, shape_vertices


def seen_corners(shape: Shape, name: str) -> FloatArray:
    """Points (n, 3) [m] whose convex hull holds the shape, in its frame."""
    match shape:
        case Box() | ConvexMesh():
            return shape_vertices(shape)
        case Cylinder(radius, height):
            return shape_vertices(Box((2.0 * radius, 2.0 * radius, height)))
        case Sphere(radius):
            return shape_vertices(Box((2.0 * radius,) * 3))
    raise InvalidInputError(
        f"cameras cannot see object {name!r}, a {type(shape).__name__}: use its points as the cloud"
    )


def ray_interval(shape: Shape, eye: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where along each ray (..., 3) from eye (3,), in the shape's frame, it enters and leaves the shape [rays]."""
    match shape:
        case Box(size):
            return _between_planes(eye, rays, np.multiply(0.5, size))
        case Sphere(radius):
            return _within_radius(eye, rays, radius)
        case Cylinder(radius, height):
            side = _within_radius(eye[:2], rays[..., :2], radius)
            ends = _between_planes(eye[2:], rays[..., 2:], np.array([0.5 * height]))
            return np.maximum(side[0], ends[0]), np.minimum(side[1], ends[1])
        case ConvexMesh(vertices):
            planes = ConvexHull(vertices).equations
            towards = rays @ planes[:, :3].T
            cut = -(planes[:, :3] @ eye + planes[:, 3]) / towards
            enter = np.where(towards < 0.0, cut, -np.inf).max(axis=-1)
            beside = (towards == 0.0) & (planes[:, :3] @ eye + planes[:, 3] > 0.0)
            leave = np.where(towards > 0.0, cut, np.inf).min(axis=-1)
            return enter, np.where(beside.any(axis=-1), -np.inf, leave)
    raise TypeError(type(shape))


def _between_planes(eye: FloatArray, rays: FloatArray, half: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Interval of each ray (..., d) in which every coordinate lies between -half and half (d,)."""
    one, other = (-half - eye) / rays, (half - eye) / rays
    return np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)


def _within_radius(eye: FloatArray, rays: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
    """Interval of each ray (..., d) that lies less than radius from the origin of its d coordinates."""
    a, b = np.einsum("...i,...i->...", rays, rays), rays @ eye
    c = eye @ eye - radius * radius
    root = np.sqrt(b * b - a * c)  # NaN for rays that miss, which then compare as false
    parallel = np.where(c <= 0.0, np.inf, np.nan)
    return np.where(a > 0.0, (-b - root) / a, -parallel), np.where(a > 0.0, (root - b) / a, parallel)
