"""Collision shapes of links as convex polytopes: hulls of meshes, convex pieces of concave ones.

A mesh of a named arm is one convex hull. Of a robot that is read from a file, a mesh is cut into
convex pieces where its hull extends far beyond it, see `link_pieces`.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from cvqmpt_lab.base.caches import cached_arrays, sources_digest
from cvqmpt_lab.base.convex import (
    MIN_THICKNESS_M,
    box_corners,
    polytope_around_ball,
    prism_around,
    require_near,
    require_volume,
    thickness,
)
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.robot.robot import LinkGeometry, in_link

# In coal 3.0 the first distance of a box in a process decides on which side all later boxes are
# larger by 1e-10. This call makes it the same in every process: else the last digits of all
# distances would depend on the first problem of the process.
_BOX, _BESIDE = coal.Box(1.0, 1.0, 1.0), coal.Transform3s(np.eye(3), np.array([2.0, 0.0, 0.0]))
coal.distance(
    _BOX, coal.Transform3s(), _BOX, _BESIDE, coal.DistanceRequest(), coal.DistanceResult()
)


def coal_distance(*bodies: Any) -> float:
    """Return the distance [m] of two coal objects, or of shape, pose, shape, pose; < 0: overlap."""
    return float(coal.distance(*bodies, coal.DistanceRequest(), coal.DistanceResult()))


class MeshFile(NamedTuple):
    """A collision mesh of a URDF."""

    path: str
    scale: tuple[float, ...]  # factors (3,) of x, y, z


class Hull(NamedTuple):
    """Convex hull of a mesh."""

    shape: coal.CollisionGeometry
    rounded: float  # how far it may extend beyond the true hull [m]; 0: it is the true hull


def take_meshes(root: ElementTree.Element) -> dict[str, MeshFile]:
    """Return a URDF's collision meshes by pinocchio's name of the body; each becomes a box.

    Pinocchio would read all triangles, which takes more than a second for fine meshes.

    root: root element of the URDF, with full paths of meshes; it is changed.
    """
    taken = {}
    for link in root.findall("link"):
        for k, shape in enumerate(link.findall("collision/geometry/*")):
            if shape.tag == "mesh":
                scale = tuple(map(float, shape.attrib.pop("scale", "1 1 1").split()))
                taken[f"{link.get('name')}_{k}"] = MeshFile(shape.attrib.pop("filename"), scale)
                shape.tag, shape.attrib["size"] = "box", "1 1 1"
    return taken


def hulls_of_meshes(meshes: Iterable[MeshFile], digests: Mapping[str, str]) -> dict[MeshFile, Hull]:
    """Return the convex hulls of meshes; they are kept in the user's cache.

    Args:
        meshes: the meshes.
        digests: sha256 of the mesh files by path.

    Raises:
        InvalidInputError: a mesh cannot be read or has no hull; the message names it.
    """
    listed = list(dict.fromkeys(meshes))

    def make() -> dict[str, np.ndarray]:
        arrays = dict[str, np.ndarray]()
        for k, mesh in enumerate(listed):
            points, corners, rounded = _hull_of(*mesh)
            arrays |= {f"{k} points": points, f"{k} corners": corners}
            arrays[f"{k} rounded"] = np.array(rounded)
        return arrays

    def fits(arrays: Mapping[str, np.ndarray]) -> bool:
        return all(
            _are_polytope(arrays[f"{k} points"], arrays[f"{k} corners"])
            and arrays[f"{k} rounded"].shape == ()
            for k in range(len(listed))
        )

    found = cached_arrays("hulls", made_of(listed, digests), make, fits) if listed else {}
    hulls = {}
    for k, mesh in enumerate(listed):
        points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        points.extend(list(found[f"{k} points"]))
        triangles.extend([coal.Triangle(*row) for row in found[f"{k} corners"].tolist()])
        hulls[mesh] = Hull(coal.Convex(points, triangles), float(found[f"{k} rounded"]))
    return hulls


def made_of(meshes: Sequence[MeshFile], digests: Mapping[str, str], more: str = "") -> bytes:
    """Return the data that shapes of meshes depend on, as the key of a cache."""
    made_of = [f"{sources_digest(Path(__file__))} {coal.__version__} {more}"]
    made_of += [f"{digests[mesh.path]} {mesh.scale}" for mesh in meshes]
    return "\n".join(made_of).encode()


def _hull_of(path: str, scale: Sequence[float]) -> tuple[np.ndarray, np.ndarray, float]:
    """Return a mesh's hull: points (n, 3) [m], triangles (m, 3) of their indices, and `rounded`."""
    what = f"collision mesh {path}"
    try:
        mesh = coal.MeshLoader().load(path, np.array(scale))
    except (ValueError, RuntimeError) as error:
        said = " ".join(str(error).split())
        raise InvalidInputError(f"{what} cannot be read: {said}") from error
    if mesh.num_vertices == 0:
        raise InvalidInputError(f"{what} is empty")
    points = np.array(mesh.vertices())
    rounded = 0.0
    if len(points) > 2 and _is_flat(points, what):
        from cvqmpt_lab.base.convex_pieces import thickened  # takes 0.3 s to import

        points, rounded = thickened(points), MIN_THICKNESS_M
    try:
        hull = coal_hull(points, what)
    except RuntimeError as error:
        reason = str(error).rpartition("message: ")[2].strip()
        if "neighbors" not in reason:
            raise InvalidInputError(f"{what} has no convex hull ({reason}): simplify it") from error
        hull, beyond = _rounded_hull(points, what)
        rounded += beyond
    return (*_polytope(hull), rounded)


def _is_flat(points: np.ndarray, what: str, flat: float = 1e-6) -> bool:
    """Return whether points (n, 3) [m] are in one plane, to a share `flat` of their length."""
    require_near(points, what)
    length = float(np.ptp(points, axis=0).max())
    return length > MIN_THICKNESS_M and thickness(points) < max(1e-6, flat * length)


def _polytope(hull: coal.CollisionGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Return a hull's points (n, 3) [m] and triangles (m, 3) of their indices."""
    triangles = [hull.polygons(k) for k in range(hull.num_polygons)]
    corners = np.array([[triangle[k] for k in range(3)] for triangle in triangles], dtype=np.int32)
    return hull_vertices(hull), corners


def _rounded_hull(
    points: np.ndarray, what: str, planes: Sequence[int] = (200, 120, 60, 30)
) -> tuple[coal.CollisionGeometry, float]:
    """Return a hull around points (n, 3) with fewer planes, and how far it extends beyond theirs.

    Coal refuses a hull with a corner that has more than 255 neighbours. `planes` are tried in turn.
    """
    from cvqmpt_lab.base.convex_pieces import polytope_around  # takes 0.3 s to import

    for most in planes:
        corners, beyond = polytope_around(points, most)
        try:
            return coal_hull(corners), beyond
        except RuntimeError:
            continue
    raise InvalidInputError(f"{what} has no convex hull that can be compared: simplify it")


def triangles_of_file(path: str, scale: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (n, 3) [m] of a mesh file and the indices (f, 3) of its triangles.

    ValueError or RuntimeError if the file cannot be read. scale: factors (3,) of x, y, z.
    """
    mesh = coal.MeshLoader().load(path, np.array(scale))
    faces = [[face[0], face[1], face[2]] for face in map(mesh.tri_indices, range(mesh.num_tris))]
    points = np.array(mesh.vertices(), dtype=float).reshape(-1, 3)
    indices = np.array(faces, dtype=int).reshape(-1, 3)
    if len(np.unique(indices)) == len(points):
        return points, indices
    return _triangles_of_parts(path, scale, points)


def _triangles_of_parts(
    path: str, scale: Sequence[float], expected: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a file with several parts, e.g. one of each material.

    coal's loader counts the vertices of each part from 0, so that triangles of later parts have
    corners of the first one, and vertices remain that no triangle has.

    Where trimesh does not find them either, the triangles are those of the hull of all vertices,
    which contains the mesh.

    Args:
        path: path of the file.
        scale: factors (3,) of x, y, z.
        expected: vertices (n, 3) by coal's loader, which are right [m].
    """
    from cvqmpt_lab.base.mesh_parts import hull_faces, points_and_faces  # 1 s to import

    points, faces = points_and_faces(path)
    points = points * scale
    near = 1e-4 * np.ptp(expected, axis=0).max()
    if len(points):
        low, high = points.min(axis=0), points.max(axis=0)
        ends = np.abs([low - expected.min(axis=0), high - expected.max(axis=0)])
        if ends.max() < near:
            return points, faces
    return hull_faces(expected)


def _are_polytope(points: np.ndarray, corners: np.ndarray) -> bool:
    """Return whether arrays from the cache have the form that `_hull_of` returns."""
    return bool(
        points.dtype == np.float64
        and corners.dtype == np.int32
        and points.ndim == corners.ndim == 2
        and points.shape[1] == corners.shape[1] == 3
        and np.isfinite(points).all()
        and ((corners >= 0) & (corners < len(points))).all()
    )


def coal_hull(points: np.ndarray, what: str = "a convex mesh") -> coal.CollisionGeometry:
    """Return coal's convex hull of points (n, 3) [m].

    InvalidInputError if it has no volume; what: noun of the message.
    """
    require_volume(points, what)
    listed = coal.StdVec_Vec3s()
    listed.extend(list(points))
    return coal.Convex.convexHull(listed, True, "Qt")


def link_geometry(item: pin.GeometryObject, frames: list[np.ndarray]) -> LinkGeometry:
    """Return a convex piece as arrays; frames: result of `axis_frames`."""
    link, T_link_geometry = in_link(frames, item.parentJoint, item.placement)
    vertices = hull_vertices(item.geometry)
    require_near(vertices, f"collision shape {item.name}")
    return LinkGeometry(item.name, link, T_link_geometry, vertices)


def hull_vertices(shape: coal.CollisionGeometry) -> np.ndarray:
    """Return vertices (n, 3) [m] of a polytope that contains the shape; exact for hulls and boxes.

    A cylinder or capsule is inside a prism of 24 sides, a sphere inside a polytope of 98 vertices.
    """
    match shape:
        case coal.ConvexBase():
            return np.array(shape.points(), dtype=float).reshape(-1, 3)
        case coal.Box():
            return box_corners(-shape.halfSide, shape.halfSide)
        case coal.Sphere():
            return polytope_around_ball(shape.radius)
        case coal.Cylinder():
            return prism_around(shape.radius, (-shape.halfLength, shape.halfLength), sides=24)
        case coal.Capsule():
            half = shape.halfLength + shape.radius
            return prism_around(shape.radius, (-half, half), sides=24)
    raise InvalidInputError(
        f"collision shape {type(shape).__name__} is not supported: use a mesh, box or cylinder"
    )


def enclosing_points(shape: coal.CollisionGeometry) -> np.ndarray:
    """Return points (n, 3) [m] whose hull contains a shape: its vertices, or corners of its box."""
    if isinstance(shape, coal.ConvexBase):
        return hull_vertices(shape)
    shape.computeLocalAABB()
    box = shape.aabb_local
    return box_corners(box.min_, box.max_)
