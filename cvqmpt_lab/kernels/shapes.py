"""Packing convex shapes into arrays for the kernels."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.kernels.separation import BOX, CYLINDER, HULL, SPHERE, ConvexShapes


class ShapeSpec(NamedTuple):
    """One convex shape in plain numbers.

    Attributes
    ----------
    kind: HULL, BOX, CYLINDER or SPHERE.
    size: full edges of a box, (radius, radius, height) of a cylinder, (radius,) of a sphere, unused for a hull [m].
    vertices: (n, 3) of a hull in the shape's frame, else (0, 3).
    T_owner_shape: (4, 4) pose in the frame of the link or the world.
    """

    kind: int
    size: tuple[float, ...]
    vertices: np.ndarray
    T_owner_shape: np.ndarray


def corners(spec: ShapeSpec) -> np.ndarray:
    """Points (n, 3) in the owner's frame whose hull contains the shape [m]."""
    if spec.kind == HULL:
        points = spec.vertices
    else:
        half = {
            BOX: lambda: 0.5 * np.array(spec.size),
            CYLINDER: lambda: np.array([spec.size[0], spec.size[0], 0.5 * spec.size[2]]),
            SPHERE: lambda: np.full(3, spec.size[0]),
        }[spec.kind]()
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
        points = signs * half
    return points @ spec.T_owner_shape[:3, :3].T + spec.T_owner_shape[:3, 3]


def pack_shapes(specs: Sequence[ShapeSpec]) -> ConvexShapes:
    """Struct of arrays of shapes, in the order given."""
    n = len(specs)
    size, radius = np.zeros((n, 3)), np.zeros(n)
    rotation, translation = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    start, count = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    columns: list[np.ndarray] = []
    for i, spec in enumerate(specs):
        if spec.kind == HULL:
            points = corners(spec)
            size[i] = np.abs(points).max(axis=0)
            start[i], count[i] = sum(map(len, columns)), len(points)
            columns.append(points)
            continue
        rotation[i], translation[i] = spec.T_owner_shape[:3, :3], spec.T_owner_shape[:3, 3]
        if spec.kind == BOX:
            size[i] = 0.5 * np.array(spec.size)
        elif spec.kind == CYLINDER:
            size[i] = (spec.size[0], spec.size[0], 0.5 * spec.size[2])
        else:
            radius[i] = spec.size[0]
    vertices = np.concatenate([np.empty((0, 3)), *columns])
    kind = np.array([spec.kind for spec in specs], dtype=np.int64)
    return ConvexShapes(
        kind, size, radius, rotation, translation, start, count, np.ascontiguousarray(vertices.T)
    )
