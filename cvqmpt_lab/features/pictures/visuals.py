"""Bodies of a robot as they are drawn: visual meshes, simplified and kept in the user's cache."""

import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.caches import cached_arrays, sources_digest
from cvqmpt_lab.base.errors import InvalidInputError, few
from cvqmpt_lab.base.poses import rigid, rotation_of_rpy
from cvqmpt_lab.features.pictures.meshes import Colour, Mesh, hull_mesh, shape_mesh, unit
from cvqmpt_lab.robot import hulls
from cvqmpt_lab.robot.robot import LinkGeometry, Robot
from cvqmpt_lab.robot.source import content_digest, mesh_path, read_source
from cvqmpt_lab.robot.urdf import read_urdf
from cvqmpt_lab.robot.urdf_bodies import collada_unit
from cvqmpt_lab.scene.shapes import Box, Cylinder, Sphere


class DrawnPiece(NamedTuple):
    """One drawn body of a link."""

    name: str
    link: int  # pose row that it is fixed to, see `LinkGeometry`
    T_link_mesh: np.ndarray  # (4, 4) [m]
    mesh: Mesh
    colour: Colour | None = None  # of its material in the URDF


class _Visual(NamedTuple):
    """One visual body of a URDF: a mesh or a shape."""

    T_frame_body: np.ndarray  # (4, 4) [m]
    colour: Colour | None
    path: str = ""  # of the mesh
    scale: tuple[float, ...] = ()
    shape: Box | Cylinder | Sphere | None = None

    @property
    def file(self) -> tuple[str, tuple[float, ...]]:
        """Path and scale of the mesh."""
        return self.path, self.scale


@lru_cache(maxsize=8)
def drawn_pieces(robot: Robot) -> tuple[DrawnPiece, ...]:
    """Return a robot's visual bodies; hulls of links that have none, or whose mesh is not readable.

    A robot whose source has "bodies": "hulls" is drawn by its hulls.
    """
    given = read_source(robot.source)
    by_link: dict[str, list[LinkGeometry]] = {}
    objects = robot.collision_model.geometryObjects
    for piece, item in zip(robot.links, objects, strict=True):
        by_link.setdefault(robot.model.frames[item.parentFrame].name, []).append(piece)
    if given.bodies == "hulls":
        return tuple(_drawn_hull(piece) for pieces in by_link.values() for piece in pieces)
    folders, urdf = [Path(folder) for folder in given.package_dirs], Path(given.urdf)
    visuals, failed = dict[str, list[_Visual]](), dict[str, str]()
    root = read_urdf(urdf, given.package_dirs).root
    # a material of a link may be named alone, and have its colour at the top of the file
    materials = {element.get("name"): element for element in root.findall("material")}
    for element in root.findall("link"):
        name, bodies = element.get("name", ""), element.findall("visual")
        if bodies and name in robot.frame_names:
            try:
                visuals[name] = [_visual(body, urdf, folders, materials) for body in bodies]
            except (InvalidInputError, ValueError, OSError) as error:
                failed[name] = str(error)
    meshes = _simplified_meshes(
        [visual for own in visuals.values() for visual in own if visual.path]
    )
    found = list[DrawnPiece]()
    for name in dict.fromkeys((*by_link, *visuals)):
        own = visuals.get(name, [])
        unread = [visual.path for visual in own if visual.path and not meshes[visual.file]]
        if unread:
            failed[name] = f"{unread[0]} cannot be read"
        if unread or not own:
            found += [_drawn_hull(piece) for piece in by_link.get(name, [])]
            continue
        for k, visual in enumerate(own):
            body = shape_mesh(visual.shape) if visual.shape else meshes[visual.file]
            if body is not None:
                row, T_link_frame = robot.link_of(name)
                placed = T_link_frame @ visual.T_frame_body
                found.append(DrawnPiece(f"{name}_{k}", row, placed, body, visual.colour))
    if failed:
        why = next(iter(failed.values()))
        warnings.warn(f"drawn by collision hulls: {few(list(failed))} ({why})", stacklevel=2)
    return tuple(found)


def _drawn_hull(piece: LinkGeometry) -> DrawnPiece:
    return DrawnPiece(piece.name, piece.link, piece.T_link_geometry, hull_mesh(piece.vertices))


def _visual(
    body: ElementTree.Element,
    urdf: Path,
    folders: Sequence[Path],
    materials: Mapping[str | None, ElementTree.Element],
) -> _Visual:
    """Read a visual body; ValueError or InvalidInputError if it is malformed or not found.

    Args:
        body: the element.
        urdf: path of the URDF.
        folders: folders of packages that meshes are in.
        materials: materials at the top of the URDF, by name.
    """

    def values(element: ElementTree.Element | None, name: str, default: str) -> list[float]:
        text = default if element is None else element.get(name, default)
        return [float(word) for word in text.split()]

    origin = body.find("origin")
    x, y, z, roll, pitch, yaw = values(origin, "xyz", "0 0 0") + values(origin, "rpy", "0 0 0")
    T = rigid(rotation_of_rpy(roll, pitch, yaw), (x, y, z))
    own = body.find("material")
    named = None if own is None else materials.get(own.get("name"))
    paint = None if own is None else own.find("color")
    if paint is None and named is not None:
        paint = named.find("color")
    red, green, blue, _ = values(paint, "rgba", "0 0 0 1")
    colour = None if paint is None else (red, green, blue)
    (shape,) = body.findall("geometry/*")
    match shape.tag:
        case "mesh":
            path = mesh_path(shape.get("filename", ""), urdf, folders).resolve()
            dae = path.suffix.lower() == ".dae"  # its unit is ignored by the loader
            length = collada_unit(path.read_bytes()) if dae else 1.0
            scale = tuple(length * value for value in values(shape, "scale", "1 1 1"))
            return _Visual(T, colour, str(path), scale)
        case "box":
            a, b, c = values(shape, "size", "")
            return _Visual(T, colour, shape=Box((a, b, c)))
        case "cylinder":
            (radius,), (length,) = values(shape, "radius", ""), values(shape, "length", "")
            return _Visual(T, colour, shape=Cylinder(radius, length))
        case "sphere":
            return _Visual(T, colour, shape=Sphere(*values(shape, "radius", "")))
    raise ValueError(f"unknown shape {shape.tag}")


def _simplified_meshes(
    visuals: Sequence[_Visual],
) -> Mapping[tuple[str, tuple[float, ...]], Mesh | None]:
    """Return the simplified meshes by path and scale; None for unreadable files."""
    wanted = list(dict.fromkeys(visual.file for visual in visuals))
    # robots of many links have coarser ones, so that pages stay small
    most = min(max(40_000 // max(len(visuals), 1), 300), 3000)
    made_of = [f"{sources_digest(Path(__file__), Path(hulls.__file__))} {most}"]
    made_of += [f"{content_digest(path)} {scale}" for path, scale in wanted]

    def make() -> dict[str, np.ndarray]:
        arrays = {}
        for k, (path, scale) in enumerate(wanted):
            arrays[f"{k} points"], arrays[f"{k} faces"] = _read(path, scale, most)
        return arrays

    def fits(arrays: Mapping[str, np.ndarray]) -> bool:
        return all(
            arrays[f"{k} points"].shape[1:] == arrays[f"{k} faces"].shape[1:] == (3,)
            and (arrays[f"{k} faces"] < len(arrays[f"{k} points"])).all()
            for k in range(len(wanted))
        )

    arrays = cached_arrays("visuals", "\n".join(made_of).encode(), make, fits) if wanted else {}
    return {
        mesh: shaded(arrays[f"{k} points"], arrays[f"{k} faces"])
        if len(arrays[f"{k} faces"])
        else None
        for k, mesh in enumerate(wanted)
    }


def _read(path: str, scale: Sequence[float], most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a file's mesh of at most so many triangles, of none if it cannot be read."""
    try:
        points, faces = hulls.triangles_of_file(path, scale)
    except (ValueError, RuntimeError):
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=int)
    return simplified(points, faces[:, ::-1] if np.prod(scale) < 0.0 else faces, most)


def simplified(points: np.ndarray, faces: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Simplify a mesh by clusters of its vertices in cells of a grid, until it is small enough.

    Each cluster becomes the point with the least squared distances from the planes of its
    triangles, which keeps edges sharp.

    Args:
        points: vertices (n, 3) [m].
        faces: indices (f, 3) of the triangles' vertices.
        most: largest number of triangles of the result.

    Returns:
        Vertices (m, 3) and faces (g, 3), g <= most.
    """
    low = points.min(axis=0, initial=np.inf)
    cell = 1e-6 * np.ptp(points, axis=0).max() if len(points) else 1.0
    a, b, c = (points[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)  # twice the area long
    area = np.linalg.norm(normals, axis=1)
    directions = normals / np.maximum(area, 1e-30)[:, None]
    offsets = (directions * a).sum(axis=1)
    while True:
        at = np.floor((points - low) / cell).astype(int)
        key = (at[:, 0] << 42) + (at[:, 1] << 21) + at[:, 2]
        cluster = np.unique(key, return_inverse=True)[1].reshape(-1)
        kept = cluster[faces]
        kept = kept[(kept != np.roll(kept, 1, axis=1)).all(axis=1)]
        first = kept.argmin(axis=1)[:, None]  # the same triangle begins with the same vertex
        if len(kept) <= 4 * most:
            kept = np.unique(np.take_along_axis(kept, (first + [0, 1, 2]) % 3, axis=1), axis=0)
        if len(kept) <= most:
            break
        cell = max(1.15 * cell, np.ptp(points, axis=0).max() / 128)
    count = cluster.max(initial=-1) + 1
    number = np.bincount(cluster, minlength=count)[:, None]
    middle = np.zeros((count, 3))
    np.add.at(middle, cluster, points)
    middle /= number
    squares, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for k in range(3):  # planes through each corner, seen from the middle of its cluster
        at = cluster[faces[:, k]]
        away = offsets - (directions * middle[at]).sum(axis=1)
        np.add.at(squares, at, area[:, None, None] * directions[:, :, None] * directions[:, None])
        np.add.at(right, at, (area * away)[:, None] * directions)
    # a weak spring to the middle where planes do not fix the point
    spring = 0.05 * np.trace(squares, axis1=1, axis2=2) + 1e-30
    moves = np.linalg.solve(squares + spring[:, None, None] * np.eye(3), right[..., None])[..., 0]
    return middle + np.clip(moves, -cell, cell), kept


def shaded(points: np.ndarray, faces: np.ndarray, smooth: float = 0.7) -> Mesh:
    """Return a mesh; facets that meet at less than `smooth` [rad] are shaded as one surface.

    Args:
        points: vertices (n, 3) [m].
        faces: indices (f, 3), anticlockwise from outside.
        smooth: largest angle between facets of a curved surface [rad].
    """
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    corners, faces = corners[area > 1e-12], faces[area > 1e-12]
    normals = normals[area > 1e-12]
    facing = unit(normals)
    # all pairs of corners at the same vertex
    order = np.argsort(faces.reshape(-1), kind="stable")
    count = np.bincount(faces.reshape(-1), minlength=len(points))
    begin, own = np.cumsum(count) - count, faces.reshape(-1)
    first = np.repeat(np.arange(len(own)), count[own])
    within = np.arange(len(first)) - np.repeat(np.cumsum(count[own]) - count[own], count[own])
    second = order[begin[own[first]] + within]
    near = (facing[first // 3] * facing[second // 3]).sum(axis=1) > np.cos(smooth)
    mixed = np.zeros((len(own), 3))
    np.add.at(mixed, first[near], normals[second[near] // 3])
    return Mesh(
        corners,
        unit(mixed).reshape(-1, 3, 3),
        np.ones((len(faces), 3)),
        np.zeros(len(faces), dtype=int),
    )
