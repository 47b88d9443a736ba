"""Convex polytopes of the links' collision shapes; choice of the link pairs that are checked.

An SRDF lists the pairs that are not checked. Without an SRDF, a pair is left out if its links are
fixed to each other, if they are neighbours (one joint and no other body is between them), or if
they overlap in nearly every random configuration. The result depends on the robot alone.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from cvqmpt_lab.base.caches import cached_arrays, sources_digest
from cvqmpt_lab.base.convex import (
    box_corners,
    polytope_around_ball,
    prism_around,
    require_near,
    require_volume,
)
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import read_xml
from cvqmpt_lab.robot.kinematics import Kinematics, link_poses
from cvqmpt_lab.robot.robot import LeftOut, LinkGeometry, in_link
from cvqmpt_lab.robot.urdf import Urdf

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


def hulls_of_meshes(
    root: ElementTree.Element, digests: Mapping[str, str]
) -> dict[str, coal.CollisionGeometry]:
    """Return the convex hulls of a URDF's collision meshes by pinocchio's name of the body.

    They are kept in the user's cache. In `root` each mesh is replaced by a box: pinocchio would
    read all triangles, which takes more than a second for fine meshes.

    Args:
        root: root element of the URDF, with full paths of meshes; it is changed.
        digests: sha256 of the mesh files by path.

    Raises:
        InvalidInputError: a mesh cannot be read or has no hull; the message names it.
    """
    wanted: dict[str, tuple[str, tuple[float, ...]]] = {}
    for link in root.findall("link"):
        for k, shape in enumerate(link.findall("collision/geometry/*")):
            if shape.tag == "mesh":
                scale = tuple(map(float, shape.attrib.pop("scale", "1 1 1").split()))
                wanted[f"{link.get('name')}_{k}"] = shape.attrib.pop("filename"), scale
                shape.tag, shape.attrib["size"] = "box", "1 1 1"
    meshes = list(dict.fromkeys(wanted.values()))
    made_of = [f"{sources_digest(Path(__file__))} {coal.__version__}"]
    made_of += [f"{digests[path]} {scale}" for path, scale in meshes]

    def make() -> dict[str, np.ndarray]:
        arrays = {}
        for k, (path, scale) in enumerate(meshes):
            arrays[f"{k} points"], arrays[f"{k} corners"] = _hull_of(path, scale)
        return arrays

    def fits(arrays: Mapping[str, np.ndarray]) -> bool:
        return all(
            _are_polytope(arrays[f"{k} points"], arrays[f"{k} corners"]) for k in range(len(meshes))
        )

    found = cached_arrays("hulls", "\n".join(made_of).encode(), make, fits) if meshes else {}
    shapes = {}
    for k, mesh in enumerate(meshes):
        points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        points.extend(list(found[f"{k} points"]))
        triangles.extend([coal.Triangle(*row) for row in found[f"{k} corners"].tolist()])
        shapes[mesh] = coal.Convex(points, triangles)
    return {name: shapes[mesh] for name, mesh in wanted.items()}


def _hull_of(path: str, scale: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh's hull: its points (n, 3) [m] and the point indices (m, 3) of its triangles."""
    what = f"collision mesh {path}"
    try:
        mesh = coal.MeshLoader().load(path, np.array(scale))
    except (ValueError, RuntimeError) as error:
        said = " ".join(str(error).split())
        raise InvalidInputError(f"{what} cannot be read: {said}") from error
    if mesh.num_vertices == 0:
        raise InvalidInputError(f"{what} is empty")
    require_volume(np.array(mesh.vertices()), what)
    try:
        mesh.buildConvexHull(True, "Qt")
    except RuntimeError as error:
        # e.g. a corner with more than 255 neighbours
        reason = str(error).rpartition("message: ")[2].strip()
        raise InvalidInputError(f"{what} has no convex hull ({reason}): simplify it") from error
    hull = mesh.convex
    triangles = [hull.polygons(k) for k in range(hull.num_polygons)]
    corners = np.array([[triangle[k] for k in range(3)] for triangle in triangles], dtype=np.int32)
    return hull_vertices(hull), corners


def triangles_of_file(path: str, scale: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (n, 3) [m] of a mesh file and the indices (f, 3) of its triangles.

    ValueError or RuntimeError if the file cannot be read. scale: factors (3,) of x, y, z.
    """
    mesh = coal.MeshLoader().load(path, np.array(scale))
    faces = [[face[0], face[1], face[2]] for face in map(mesh.tri_indices, range(mesh.num_tris))]
    points = np.array(mesh.vertices(), dtype=float).reshape(-1, 3)
    return points, np.array(faces, dtype=int).reshape(-1, 3)


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


def coal_hull(points: np.ndarray) -> coal.CollisionGeometry:
    """Return coal's convex hull of points (n, 3) [m]; InvalidInputError if it has no volume."""
    require_volume(points, "a convex mesh")
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


# start of the reason why a pair is not checked: overlap in a share of random configurations
OVERLAP = "overlap in "

Pair = tuple[str, str]


class _Sampling(NamedTuple):
    """Random configurations by which pairs that nearly always overlap are found."""

    samples: int = 2000  # number of configurations
    always: float = 0.95  # a pair that overlaps in this share of them is left out
    # a pair is dismissed after `few` configurations if its share is below `always` by more than
    # this: five standard deviations
    spread: float = 0.15
    few: int = 50
    contact: float = 1e-6  # distance [m] that counts as overlap; with 0, coal misses 1.3 mm


_USUAL = _Sampling()


def left_out_pairs(
    model: pin.Model,
    geometry: pin.GeometryModel,
    links: Sequence[LinkGeometry],
    kinematics: Kinematics,
    urdf: Urdf,
    srdf: str,
    sampling: _Sampling = _USUAL,
) -> tuple[LeftOut, ...]:
    """Return the link pairs that are not checked: from an SRDF, else by the rule at the top.

    Args:
        model: pinocchio's model of the joints.
        geometry: pinocchio's model of the convex pieces.
        links: the pieces as arrays.
        kinematics: the joints as arrays.
        urdf: content of the URDF.
        srdf: path of an SRDF, or "".
        sampling: random configurations.
    """
    if srdf:
        names = dict.fromkeys(model.frames[i.parentFrame].name for i in geometry.geometryObjects)
        return _left_out_by_srdf(srdf_root(Path(srdf)), list(names))
    pieces: dict[str, list[int]] = {}
    for k, item in enumerate(geometry.geometryObjects):
        pieces.setdefault(model.frames[item.parentFrame].name, []).append(k)
    # for each link, the next link towards the base that has pieces
    above = {
        link: next((joint.parent for joint in urdf.chain(link)[::-1] if joint.parent in pieces), "")
        for link in pieces
    }
    joints = {name: geometry.geometryObjects[own[0]].parentJoint for name, own in pieces.items()}
    every = list(combinations(pieces, 2))
    reasons = {}
    for pair in every:
        a, b = joints[pair[0]], joints[pair[1]]
        neighbours = above[pair[1]] == pair[0] or above[pair[0]] == pair[1]
        if neighbours and a in (model.parents[b], *model.children[b]):
            reasons[pair] = "adjacent"
        if a == b:
            reasons[pair] = "fixed to each other"
    lower, upper = kinematics.lower, kinematics.upper
    states = np.random.default_rng(0).uniform(lower, upper, (sampling.samples, len(lower)))
    robot = model, geometry, links, kinematics, pieces
    others = [pair for pair in every if pair not in reasons]
    first = _touching(*robot, others, states[: sampling.few], sampling.contact)
    often = [pair for pair, hit in first.items() if hit.mean() >= sampling.always - sampling.spread]
    for pair, hit in _touching(*robot, often, states, sampling.contact).items():
        if hit.mean() >= sampling.always:
            reasons[pair] = f"{OVERLAP}{100.0 * hit.mean():.4g} % of random states"
    return tuple(LeftOut(*pair, reasons[pair]) for pair in every if pair in reasons)


def _left_out_by_srdf(srdf: ElementTree.Element, links: Sequence[str]) -> tuple[LeftOut, ...]:
    """Return the pairs of links that an SRDF leaves out, as MoveIt reads it.

    A link of disable_default_collisions is compared only where enable_collisions says so;
    disable_collisions counts last.
    """
    listed = tuple(
        LeftOut(
            item.get("link1", ""),
            item.get("link2", ""),
            "SRDF: " + item.get("reason", "left out by the SRDF"),
        )
        for item in srdf.findall("disable_collisions")
    )
    off, enabled = default_off(srdf)
    known = {frozenset((pair.first, pair.second)) for pair in listed}
    return listed + tuple(
        LeftOut.by_default(*pair)
        for pair in combinations(links, 2)
        if off & set(pair) and frozenset(pair) not in enabled | known
    )


def default_off(srdf: ElementTree.Element) -> tuple[set[str], set[frozenset[str]]]:
    """Return the links that an SRDF compares with nothing by default, and the enabled pairs."""
    off = {item.get("link", "") for item in srdf.findall("disable_default_collisions")}
    pairs = srdf.findall("enable_collisions")
    return off, {frozenset((item.get("link1", ""), item.get("link2", ""))) for item in pairs}


def srdf_oddities(srdf: ElementTree.Element) -> dict[str, list[str]]:
    """Return elements of an SRDF that leave no pair out though they may be meant to, by reason."""
    # elements about pairs of links, with the attributes that name these
    of_pairs = {
        "disable_collisions": ("link1", "link2"),
        "enable_collisions": ("link1", "link2"),
        "disable_default_collisions": ("link",),
    }
    # other elements, of MoveIt and of pinocchio's robots
    others = (
        *("group", "group_state", "end_effector", "virtual_joint", "passive_joint", "gripper"),
        *("joint_property", "link_sphere_approximation", "specificities", "rotor_params"),
    )
    unknown = {item.tag for item in srdf}.difference(of_pairs, others)
    lacking = [
        f"<{item.tag}> without {name}"
        for item in srdf
        for name in of_pairs.get(item.tag, ())
        if name not in item.attrib
    ]
    return {
        "elements of the SRDF that are not known and have no effect": sorted(unknown),
        "elements of the SRDF without effect": lacking,
    }


def checked_pairs(
    model: pin.Model, geometry: pin.GeometryModel, left_out: Sequence[LeftOut]
) -> tuple[tuple[int, int], ...]:
    """Set the pairs of pieces that the geometry model checks; return their indices."""
    skipped = {frozenset((pair.first, pair.second)) for pair in left_out}
    names = [model.frames[item.parentFrame].name for item in geometry.geometryObjects]
    geometry.addAllCollisionPairs()
    every = [(int(pair.first), int(pair.second)) for pair in geometry.collisionPairs]
    kept = tuple((i, k) for i, k in every if frozenset((names[i], names[k])) not in skipped)
    geometry.removeAllCollisionPairs()
    for i, k in kept:
        geometry.addCollisionPair(pin.CollisionPair(i, k))
    return kept


def _touching(
    model: pin.Model,
    geometry: pin.GeometryModel,
    links: Sequence[LinkGeometry],
    kinematics: Kinematics,
    pieces: Mapping[str, list[int]],
    pairs: Sequence[Pair],
    states: np.ndarray,
    margin: float,
) -> dict[Pair, np.ndarray]:
    """Return (k,) bool by pair: are its links closer than margin [m] in each of states (k, n)?"""
    tested = pin.GeometryModel(geometry)
    tested.removeAllCollisionPairs()
    indices = [(k, i, j) for k, (a, b) in enumerate(pairs) for i in pieces[a] for j in pieces[b]]
    for _, i, j in indices:
        tested.addCollisionPair(pin.CollisionPair(i, j))
    owner, first, second = np.array(indices, dtype=int).reshape(-1, 3).T
    data, tested_data = model.createData(), pin.GeometryData(tested)
    for request in tested_data.collisionRequests:
        request.security_margin = margin
    # pieces whose balls are apart need no exact check
    rotations, translations = link_poses(kinematics, states)
    centres, radii = np.empty((len(states), len(links), 3)), np.empty(len(links))
    for i, piece in enumerate(links):
        middle, radii[i] = piece.ball
        centres[:, i] = rotations[:, piece.link] @ middle + translations[:, piece.link]
    hits = np.zeros((len(states), len(pairs)), dtype=bool)
    values = kinematics.joint_values(states)
    for hit, q, centre in zip(hits, values, centres, strict=True):
        apart = np.linalg.norm(centre[first] - centre[second], axis=1)
        pin.updateGeometryPlacements(model, data, tested, tested_data, q)
        for k in np.flatnonzero(apart <= radii[first] + radii[second] + margin).tolist():
            if not hit[owner[k]]:
                hit[owner[k]] = pin.computeCollision(tested, tested_data, k)
    return dict(zip(pairs, hits.T, strict=True))


def srdf_root(path: Path) -> ElementTree.Element:
    """Read an SRDF file; InvalidInputError if it is malformed."""
    root = read_xml(path, "SRDF file")
    if root.tag != "robot":
        raise InvalidInputError(f"SRDF file {path} has the root <{root.tag}>, not <robot>")
    for element in root.iter():
        if element.tag.startswith("xacro:") or "${" in " ".join(element.attrib.values()):
            raise InvalidInputError(
                f"SRDF file {path} has unexpanded elements of xacro, <{element.tag}>, whose pairs "
                f"of links would be left out: xacro {path.name} > expanded.srdf, and give that file"
            )
    return root
