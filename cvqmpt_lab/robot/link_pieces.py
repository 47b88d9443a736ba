"""Convex pieces of concave collision meshes, of robots that are read from a file.

The hull of a concave mesh fills free space: a column under a roof, or a room, would be solid. A
mesh is cut where its gap, the largest distance of a point in its hull from it, is large:

- above `STANDING_GAP_M` if it stands still, or if it overlaps a link in every configuration,
- above `MOVING_GAP_M` else.

Meshes of arms by name stay hulls, with gaps of up to 0.27 m: their committed results depend on it.
"""

from collections.abc import Collection, Iterable, Mapping
from itertools import combinations
from pathlib import Path

import numpy as np
import pinocchio as pin

from cvqmpt_lab.base import convex
from cvqmpt_lab.base.caches import cached_arrays, sources_digest
from cvqmpt_lab.base.convex import thickness
from cvqmpt_lab.base.errors import few
from cvqmpt_lab.robot.hulls import (
    MeshFile,
    coal_hull,
    link_geometry,
    made_of,
    take_meshes,
    triangles_of_file,
)
from cvqmpt_lab.robot.kinematics import Kinematics
from cvqmpt_lab.robot.pairs import CUT, RESTING_M, Bodies, always_overlapping, by_structure
from cvqmpt_lab.robot.robot import Robot, axis_frames
from cvqmpt_lab.robot.source import content_digest, find_collision_meshes, read_source
from cvqmpt_lab.robot.urdf import Urdf, one_coordinate_a_joint, read_urdf
from cvqmpt_lab.robot.urdf_bodies import prepare_bodies

STANDING_GAP_M = 0.005
MOVING_GAP_M = 0.05  # arms by name: UR 0.037, Kinova 0.031, xArm 7 0.051, SO-ARM 0.031
MOST_STANDING_PIECES = 48
MOST_MOVING_PIECES = 12
MOST_TRIANGLES = 200_000  # finer meshes stay hulls: cutting them takes minutes


def cut_concave_links(
    model: pin.Model,
    geometry: pin.GeometryModel,
    kinematics: Kinematics,
    urdf: Urdf,
    srdf: str,
    meshes: Mapping[str, MeshFile],
    digests: Mapping[str, str],
) -> tuple[pin.GeometryModel, list[str]]:
    """Return bodies in which concave meshes are convex pieces, and notes about them.

    Args:
        model: pinocchio's model of the joints.
        geometry: pinocchio's model of the bodies, meshes as hulls.
        kinematics: the joints as arrays.
        urdf: content of the URDF.
        srdf: path of an SRDF, or "".
        meshes: mesh files by the body's name.
        digests: sha256 of mesh files by path.
    """
    if not meshes:
        return geometry, []
    gaps = gaps_of_meshes(meshes.values(), digests)
    made, counts = with_pieces(geometry, meshes, gaps, digests, ())
    if not srdf:
        frames = axis_frames(model)
        links = [link_geometry(item, frames) for item in made.geometryObjects]
        bodies = Bodies(model, made, links, kinematics)
        known = by_structure(bodies, urdf)
        others = [pair for pair in combinations(bodies.pieces, 2) if pair not in known]
        always = always_overlapping(bodies, bodies.of_links(others), 50, RESTING_M)
        nested = {link for pair in always for link in pair}
        names = [name for name in meshes if name.rpartition("_")[0] in nested]
        if nested:
            made, counts = with_pieces(geometry, meshes, gaps, digests, names)
    if not counts:
        return geometry, []
    said = [f"{name} ({n}; its hull adds {gaps[meshes[name]]:.2g} m)" for name, n in counts.items()]
    return made, [f"concave meshes in convex pieces: {few(said)}"]


def with_pieces(
    geometry: pin.GeometryModel,
    meshes: Mapping[str, MeshFile],
    gaps: Mapping[MeshFile, float],
    digests: Mapping[str, str],
    overlapping: Collection[str],
) -> tuple[pin.GeometryModel, dict[str, int]]:
    """Return bodies in which meshes are cut by the rule at the top; and counts of pieces by body.

    Args:
        geometry: the bodies, meshes as hulls.
        meshes: mesh files by the body's name.
        gaps: result of `gaps_of_meshes`.
        digests: sha256 of mesh files by path.
        overlapping: names of bodies that overlap others in every configuration.
    """
    most: dict[MeshFile, int] = {}
    for item in geometry.geometryObjects:
        if item.name in meshes:
            mesh, stands = meshes[item.name], item.parentJoint == 0
            least = STANDING_GAP_M if stands or item.name in overlapping else MOVING_GAP_M
            if gaps[mesh] > least:
                count = MOST_STANDING_PIECES if stands else MOST_MOVING_PIECES
                most[mesh] = max(count, most.get(mesh, 0))
    pieces = pieces_of_meshes(most, digests)
    made, counts = pin.GeometryModel(), {}
    for item in geometry.geometryObjects:
        shapes = pieces.get(meshes[item.name], []) if item.name in meshes else []
        if len(shapes) < 2:
            made.addGeometryObject(item)
            continue
        counts[item.name] = len(shapes)
        for k, points in enumerate(shapes):
            carrier = item.parentJoint, item.parentFrame, item.placement
            piece = pin.GeometryObject(f"{item.name}{CUT}{k}", *carrier, coal_hull(points))
            made.addGeometryObject(piece)
    return made, counts


def gaps_of_meshes(meshes: Iterable[MeshFile], digests: Mapping[str, str]) -> dict[MeshFile, float]:
    """Return how far the hull of each mesh extends beyond it [m], to a fiftieth of its length.

    The values are kept in the user's cache. digests: sha256 of the mesh files by path.
    """
    listed = list(dict.fromkeys(meshes))

    def make() -> dict[str, np.ndarray]:
        from cvqmpt_lab.base.convex_pieces import hull_gap  # takes 0.3 s to import

        gaps = {}
        for k, mesh in enumerate(listed):
            triangles = _triangles(mesh)
            thick = thickness(triangles.reshape(-1, 3)) > 2.0 * convex.MIN_THICKNESS_M
            fine = len(triangles) > MOST_TRIANGLES
            gaps[str(k)] = np.array(hull_gap(triangles) if thick and not fine else 0.0)
        return gaps

    key = made_of(listed, digests, _sources())
    found = cached_arrays("hull_gaps", key, make, lambda arrays: len(arrays) == len(listed))
    return {mesh: float(found[str(k)]) for k, mesh in enumerate(listed)}


def hull_gaps(robot: Robot) -> dict[str, float]:
    """Return how far hulls of a robot's meshes extend beyond them [m], by piece, largest first.

    Meshes in convex pieces are left out.
    """
    given = read_source(robot.source)
    urdf = read_urdf(Path(given.urdf), given.package_dirs)
    root = one_coordinate_a_joint(urdf)
    prepare_bodies(root, urdf.path, given.visual_as_collision)
    folders = [Path(folder) for folder in given.package_dirs]
    paths, _ = find_collision_meshes(root, urdf.path, folders, given.skip_missing_meshes)
    whole = {piece.name for piece in robot.links}
    meshes = {name: mesh for name, mesh in take_meshes(root).items() if name in whole}
    gaps = gaps_of_meshes(meshes.values(), {path: content_digest(path) for path in paths})
    found = {name: gaps[mesh] for name, mesh in meshes.items()}
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def pieces_of_meshes(
    wanted: Mapping[MeshFile, int], digests: Mapping[str, str]
) -> dict[MeshFile, list[np.ndarray]]:
    """Return the corners (k, 3) [m] of convex pieces that together contain each mesh.

    They are kept in the user's cache.

    Args:
        wanted: largest number of pieces of each mesh.
        digests: sha256 of the mesh files by path.
    """
    listed = list(wanted)

    def make() -> dict[str, np.ndarray]:
        from cvqmpt_lab.base.convex_pieces import convex_pieces

        return {
            f"{k} {i}": points
            for k, mesh in enumerate(listed)
            for i, points in enumerate(convex_pieces(_triangles(mesh), most_pieces=wanted[mesh]))
        }

    if not listed:
        return {}
    key = made_of(listed, digests, f"{_sources()} {list(wanted.values())}")
    found = cached_arrays("link_pieces", key, make)
    return {
        mesh: [points for name, points in found.items() if name.split()[0] == str(k)]
        for k, mesh in enumerate(listed)
    }


def _sources() -> str:
    """Return the digest of the files that cut meshes."""
    folder = Path(convex.__file__).parent
    return sources_digest(
        folder / "convex.py", folder / "convex_pieces.py", Path(__file__).with_name("hulls.py")
    )


def _triangles(mesh: MeshFile) -> np.ndarray:
    """Return the triangles (f, 3, 3) of a mesh [m]."""
    points, faces = triangles_of_file(*mesh)
    return points[faces]
