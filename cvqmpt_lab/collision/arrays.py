"""The arrays of the compiled collision checker, from a problem's robot, attachments and scene.

Those of robots are kept in the user's cache: cutting hulls into pieces takes a quarter of a second.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from cvqmpt_lab.collision.covers import ANY_RADIUS, Cloud
from cvqmpt_lab.collision.exact import carried_pairs, reach_with
from cvqmpt_lab.collision.geometry import (
    CELL,
    RobotGeometry,
    SceneGeometry,
    ShapeSpec,
    outline,
    robot_geometry,
    scene_geometry,
)
from cvqmpt_lab.collision.separation import BOX, CYLINDER, HULL, SPHERE, ConvexShapes
from cvqmpt_lab.disk_cache import cached_arrays
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.jit import SOURCES
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.cells import blocks_of
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Measured, PointCloud, Sphere

NO_VERTICES = np.empty((0, 3))
MOST_BLOCKS = 2000  # As large as the pieces that shapes are cut into: a metre and a fifth cubed
# Of the distance grid, along an edge: a long reach has coarser cells instead of more memory
MOST_CELLS = 256
PIECES = "pieces."  # Before the names of the arrays of `RobotGeometry.pieces`


def stored_robot_geometry(
    specs: Sequence[ShapeSpec], link: Sequence[int], pairs: Sequence[tuple[int, int]]
) -> RobotGeometry:
    """What `robot_geometry` makes of its arguments, read from the cache where it is there."""

    def arrays() -> dict[str, np.ndarray]:
        made = robot_geometry(specs, link, pairs)
        pieces = {PIECES + name: array for name, array in made.pieces._asdict().items()}
        return pieces | {name: value for name, value in made._asdict().items() if name != "pieces"}

    made_of = [f"{SOURCES} {list(link)} {list(pairs)}".encode()]
    for spec in specs:
        made_of.append(f"{spec.kind} {spec.size} {spec.inflation} {spec.vertices.shape}".encode())
        made_of += (spec.vertices.tobytes(), spec.T_owner_shape.tobytes())
    found = cached_arrays("robot_geometry", b"".join(made_of), arrays)
    pieces = ConvexShapes(*(found.pop(PIECES + name) for name in ConvexShapes._fields))
    return RobotGeometry(pieces=pieces, largest=float(found.pop("largest")), **found)


@lru_cache(maxsize=8)
def robot_arrays(robot: Robot, attachments: tuple[Attachment, ...] = ()) -> RobotGeometry:
    """Convex pieces of the robot and of what it carries.

    InvalidInputError, before anything is cut, for what is too long or too large.
    """
    reach_with(robot, attachments)
    specs = [ShapeSpec(HULL, (), piece.vertices, piece.T_link_geometry) for piece in robot.links]
    for spec, piece in zip(specs, robot.links, strict=True):
        _require_few_pieces(f"link geometry {piece.name!r}", spec)
    links = [piece.link for piece in robot.links]
    hand, T_link_hand = robot.end_effector_link
    rows = []
    for item in attachments:
        carried = SPECS[type(item.shape)](item.shape, T_link_hand @ item.T_hand_object)
        for spec in carried:
            _require_few_pieces(f"attachment {item.name!r}", spec)
        rows.append(range(len(specs), len(specs) + len(carried)))
        specs.extend(carried)
        links.extend([hand] * len(carried))
    pairs = [(i, row) for i, k in carried_pairs(robot, attachments) for row in rows[k]]
    return stored_robot_geometry(specs, links, [*robot.self_collision_pairs, *pairs])


def _require_few_pieces(name: str, spec: ShapeSpec) -> None:
    """InvalidInputError for a shape that would be cut into thousands of pieces:
    seconds, and soon minutes.
    """
    points, _ = outline(spec._replace(T_owner_shape=np.eye(4)))
    size = np.ptp(points, axis=0)
    if spec.kind != SPHERE and np.prod(np.maximum(size / ANY_RADIUS, 1.0)) > MOST_BLOCKS:
        raise InvalidInputError(
            f"{name} is {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} m large, too large to plan "
            f"with: give sizes in "
            f"metres"
        )


@lru_cache(maxsize=8)
def scene_arrays(scene: Scene, reach: float, clearance: float = 0.0) -> SceneGeometry:
    """Obstacles of a scene with their distance grid over the cube of half edge reach [m] about the
    base.

    clearance: by which every obstacle is inflated [m].
    """
    placed = [(item.shape, item.T_world_object) for item in scene.obstacles]
    clouds = [
        _cloud(shape, T, reach, clearance) for shape, T in placed if isinstance(shape, Measured)
    ]
    solids = [(shape, T) for shape, T in placed if not isinstance(shape, Measured)]
    specs = [
        _inflated(spec, clearance) for shape, T in solids for spec in SPECS[type(shape)](shape, T)
    ]
    cell = max(CELL, 2.0 * reach / MOST_CELLS)
    return scene_geometry(specs, np.full(3, -reach), np.full(3, reach), cell, clouds)


def _cloud(shape: Measured, T: np.ndarray, reach: float, clearance: float) -> Cloud:
    """The balls of a small cloud; of a large one and of a map, boxes in reach;
    inflated by a clearance [m].
    """
    low, high, padding = blocks_of(shape, T, reach + clearance)
    return Cloud(0.5 * (low + high), 0.5 * (high - low), padding + clearance, T)


def _inflated(spec: ShapeSpec, clearance: float) -> ShapeSpec:
    """A shape that reaches this much [m] further to all sides."""
    if spec.kind == SPHERE:
        return spec._replace(size=(spec.size[0] + clearance,))
    return spec._replace(inflation=spec.inflation + clearance)


def _boxes(cloud: PointCloud, T: np.ndarray) -> list[ShapeSpec]:
    """A carried cloud, as the balls or boxes that the exact checker sees."""
    low, high, radius = blocks_of(cloud, T)
    poses = np.tile(T, (len(low), 1, 1))
    poses[:, :3, 3] += 0.5 * (low + high) @ T[:3, :3].T
    return [
        ShapeSpec(BOX, tuple(edges), NO_VERTICES, pose, radius)
        if edges.any()
        else ShapeSpec(SPHERE, (radius,), NO_VERTICES, pose)
        for edges, pose in zip(high - low, poses, strict=True)
    ]


SPECS: Mapping[type, Callable[[Any, np.ndarray], list[ShapeSpec]]] = {
    Box: lambda box, T: [ShapeSpec(BOX, box.size, NO_VERTICES, T)],
    Cylinder: lambda c, T: [ShapeSpec(CYLINDER, (c.radius, c.radius, c.height), NO_VERTICES, T)],
    Sphere: lambda sphere, T: [ShapeSpec(SPHERE, (sphere.radius,), NO_VERTICES, T)],
    ConvexMesh: lambda mesh, T: [ShapeSpec(HULL, (), mesh.vertices, T)],
    PointCloud: _boxes,
}
