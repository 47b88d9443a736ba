"""Packing convex shapes into arrays for the kernels."""

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.collision.separation import (
    BOX,
    CYLINDER,
    HULL,
    MAX_HULL_VERTICES,
    SPHERE,
    ConvexShapes,
)
from cvqmpt_lab.collision.sphere_cover import convex_hull
from cvqmpt_lab.errors import InvalidInputError

_PRISM_SIDES = 16


class ShapeSpec(NamedTuple):
    """One convex shape in plain numbers."""

    kind: int  # HULL, BOX, CYLINDER or SPHERE
    size: tuple[float, ...]
    """Full edges of a box, (radius, radius, height) of a cylinder, (radius,) of a sphere, () for a
    hull [m].
    """
    vertices: np.ndarray  # (n, 3) of a hull in the shape's frame, else (0, 3) [m]
    T_owner_shape: np.ndarray  # (4, 4) pose in the frame of the link or the world
    inflation: float = 0.0  # of a box, cylinder or hull, to all sides [m]


def outline(spec: ShapeSpec) -> tuple[np.ndarray, float]:
    """Return points (k, 3) and an inflation radius [m], so that the inflated hull of the points
    holds the shape.

    The points are in the frame of the owner, a link or the world.
    """
    if spec.kind == HULL:
        points = spec.vertices
    elif spec.kind == BOX:
        points = 0.5 * np.array(spec.size) * np.array(list(product((-1.0, 1.0), repeat=3)))
    elif spec.kind == CYLINDER:
        turn = 2.0 * np.pi * np.arange(_PRISM_SIDES) / _PRISM_SIDES
        radius = spec.size[0] / np.cos(np.pi / _PRISM_SIDES)
        half = np.full(_PRISM_SIDES, 0.5 * spec.size[2])
        rim = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), half])
        points = np.concatenate([rim, rim * (1.0, 1.0, -1.0)])
    else:
        points = np.zeros((1, 3))
    inflation = spec.size[0] if spec.kind == SPHERE else spec.inflation
    return points @ spec.T_owner_shape[:3, :3].T + spec.T_owner_shape[:3, 3], inflation


def pack_shapes(specs: Sequence[ShapeSpec]) -> ConvexShapes:
    """Return shapes as a struct of arrays, in the order given; of a mesh only the vertices of its
    hull.

    Raises InvalidInputError for a pose, size or vertex that is not finite, and for a mesh without
    vertices.
    """
    _check(specs)
    n = len(specs)
    size, radius = np.zeros((n, 3)), np.zeros(n)
    rotation, translation = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    count = np.zeros(n, dtype=np.int64)
    corners: list[np.ndarray] = [np.empty((0, 3))]
    for i, spec in enumerate(specs):
        radius[i] = spec.size[0] if spec.kind == SPHERE else spec.inflation
        if spec.kind == HULL:
            points, _ = outline(spec)
            corners.append(convex_hull(points).corners)
            count[i] = len(corners[-1])
            size[i] = np.abs(corners[-1]).max(axis=0)
            continue
        rotation[i], translation[i] = spec.T_owner_shape[:3, :3], spec.T_owner_shape[:3, 3]
        if spec.kind == CYLINDER:
            size[i] = spec.size[0], spec.size[0], 0.5 * spec.size[2]
        elif spec.kind == BOX:
            size[i] = spec.size
            size[i] *= 0.5
    kind = np.array([spec.kind for spec in specs], dtype=np.int64)
    vertices = np.ascontiguousarray(np.concatenate(corners).T)
    return ConvexShapes(
        kind, size, radius, rotation, translation, np.cumsum(count) - count, count, vertices
    )


def _check(specs: Sequence[ShapeSpec]) -> None:
    """Refuse what no kernel could work with."""
    poses = np.array([spec.T_owner_shape for spec in specs]).reshape(-1, 16)
    wrong = ~np.isfinite(poses).all(axis=1)
    for i, spec in enumerate(specs):
        if wrong[i] or not all(map(math.isfinite, spec.size)):
            raise InvalidInputError(
                f"shape {i}: its pose or size {spec.size} is not finite; give numbers [m]"
            )
        if min(spec.size, default=0.0) < 0.0:
            raise InvalidInputError(
                f"shape {i}: its size {spec.size} is negative; give lengths >= 0 [m]"
            )
        if spec.kind == HULL and not 0 < len(spec.vertices) < MAX_HULL_VERTICES:
            raise InvalidInputError(
                f"shape {i}: a mesh with {len(spec.vertices)} vertices; give 1 to "
                f"{MAX_HULL_VERTICES - 1}"
            )
        if spec.kind == HULL and not np.isfinite(spec.vertices).all():
            raise InvalidInputError(f"shape {i}: a mesh vertex is not finite; give numbers [m]")
