"""Collision shapes of links as convex polytopes."""

from itertools import product
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.robot import LinkGeometry, in_link

FARTHEST = 1e4  # [m] from the origin of its frame, of a vertex
THINNEST = 1e-6  # [m] of a mesh up to 1 m across; of a larger one in proportion

# In coal 3.0 the first direction in which a process asks for the furthest point of a box decides,
# for all boxes afterwards, whether they are larger by 1e-10 of their size on one side. They are: it
# is decided here, along an axis. Else the last digits of all distances would depend on the first
# problem of a process.
_BOX, _BESIDE = coal.Box(1.0, 1.0, 1.0), coal.Transform3s(np.eye(3), np.array([2.0, 0.0, 0.0]))
coal.distance(
    _BOX, coal.Transform3s(), _BOX, _BESIDE, coal.DistanceRequest(), coal.DistanceResult()
)


def coal_distance(*bodies: Any) -> float:
    """Distance [m] of two of coal's objects, or of two shapes, a pose after each;
    negative where they overlap.
    """
    return float(coal.distance(*bodies, coal.DistanceRequest(), coal.DistanceResult()))


def replace_meshes_by_hulls(geometry: pin.GeometryModel) -> None:
    """Every collision mesh becomes its convex hull; InvalidInputError names one that has none."""
    for item in geometry.geometryObjects:
        shape = item.geometry
        if isinstance(shape, coal.BVHModelBase):
            what = f"collision mesh {item.meshPath or item.name}"
            if shape.num_vertices == 0:
                raise InvalidInputError(f"{what} is empty")
            require_volume(np.array(shape.vertices()), what)
            try:
                shape.buildConvexHull(True, "Qt")
            except RuntimeError as error:  # e.g. a corner with more than 255 neighbours
                reason = str(error).rpartition("message: ")[2].strip()
                raise InvalidInputError(
                    f"{what} has no convex hull ({reason}): simplify it"
                ) from error
            item.geometry = shape.convex


def require_volume(points: np.ndarray, what: str) -> None:
    """InvalidInputError for points (n, 3) that are too far away, or whose hull is too thin, for
    Qhull (it crashes).
    """
    farthest = float(np.abs(points).max())
    if not farthest <= FARTHEST:
        raise InvalidInputError(
            f"{what} has a vertex at {farthest:.3g} m, beyond {FARTHEST:g}: give metres"
        )
    centred = points - points.mean(axis=0)
    along = np.ptp(centred @ np.linalg.svd(centred, full_matrices=False)[2].T, axis=0)
    thickness = float(along.min()) if len(points) > 3 else 0.0
    least = THINNEST * max(1.0, float(along.max()))
    if not thickness >= least:
        raise InvalidInputError(
            f"{what} is {thickness:.2g} m thick, less than {least:.2g}: give a mesh with volume, "
            f"or a box"
        )


def convex_hull(points: np.ndarray) -> coal.CollisionGeometry:
    """The convex hull of points (n, 3) [m] in coal; InvalidInputError if it has no volume."""
    require_volume(points, "a convex mesh")
    listed = coal.StdVec_Vec3s()
    listed.extend(list(points))
    return coal.Convex.convexHull(listed, True, "Qt")


def link_geometry(item: pin.GeometryObject, frames: list[np.ndarray]) -> LinkGeometry:
    """A convex piece as arrays; frames: of `axis_frames`.

    InvalidInputError for one beyond FARTHEST.
    """
    link, T_link_geometry = in_link(frames, item.parentJoint, item.placement)
    vertices = hull_vertices(item.geometry)
    farthest = float(np.abs(vertices).max())
    if not farthest <= FARTHEST:
        raise InvalidInputError(
            f"collision shape {item.name} has a vertex at {farthest:.3g} m, beyond {FARTHEST:g}: "
            f"give metres"
        )
    return LinkGeometry(item.name, link, T_link_geometry, vertices)


def hull_vertices(shape: coal.CollisionGeometry) -> np.ndarray:
    """Vertices (n, 3) [m] of a polytope that contains the shape: exact for hulls and boxes.

    Round shapes (cylinder, capsule, sphere) are circumscribed by 24-sided prisms or boxes.
    """
    if isinstance(shape, coal.ConvexBase):
        return np.array(shape.points(), dtype=float).reshape(-1, 3)
    corners = np.array(list(product((-1.0, 1.0), repeat=3)))
    if isinstance(shape, coal.Box):
        return corners * shape.halfSide
    if isinstance(shape, coal.Sphere):
        return corners * shape.radius
    if isinstance(shape, coal.Cylinder | coal.Capsule):
        half = shape.halfLength + (shape.radius if isinstance(shape, coal.Capsule) else 0.0)
        return prism_vertices(shape.radius, half)
    raise InvalidInputError(
        f"collision shape {type(shape).__name__} is not supported: use a mesh, box or cylinder"
    )


def enclosing_points(shape: coal.CollisionGeometry) -> np.ndarray:
    """Points (n, 3) [m] whose hull contains any shape:
    vertices of a polytope, else the corners of its box.
    """
    if isinstance(shape, coal.ConvexBase):
        return hull_vertices(shape)
    shape.computeLocalAABB()
    return np.array(list(product(*zip(shape.aabb_local.min_, shape.aabb_local.max_, strict=True))))


def prism_vertices(radius: float, half_length: float, sides: int = 24) -> np.ndarray:
    """Vertices (2 sides, 3) of the prism around a cylinder along z [m]."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = radius / np.cos(np.pi / sides) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.c_[ring, np.full(sides, z)] for z in (-half_length, half_length)])
