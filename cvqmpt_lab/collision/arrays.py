"""The arrays of the compiled collision checker, from a problem's robot, attachments and scene.

A robot's are kept in the user's cache: cutting its hulls into pieces takes a quarter of a second.
"""

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from cvqmpt_lab.base.caches import cached_arrays
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.jit import SOURCES
from cvqmpt_lab.base.values import frozen
from cvqmpt_lab.collision.carried import carried_pairs, reach_with
from cvqmpt_lab.collision.covers import ANY_RADIUS, Cloud
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
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.cells import blocks_of
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Measured, Shape, Sphere


@lru_cache(maxsize=8)
def robot_arrays(robot: Robot, attachments: tuple[Attachment, ...] = ()) -> RobotGeometry:
    """Convex pieces of robot and attachments, kept in the user's cache.

    InvalidInputError before cutting ones too large.
    """
    reach_with(robot, attachments)
    specs = [ShapeSpec(HULL, (), piece.vertices, piece.T_link_geometry) for piece in robot.links]
    for spec, piece in zip(specs, robot.links, strict=True):
        _require_few_pieces(f"link geometry {piece.name!r}", spec)
    links = [piece.link for piece in robot.links]
    rows = []
    for item in attachments:
        hand, T_link_hand = robot.hand(item.end_effector)
        carried = shape_specs(item.shape, T_link_hand @ item.T_hand_object)
        for spec in carried:
            _require_few_pieces(f"attachment {item.name!r}", spec)
        rows.append(range(len(specs), len(specs) + len(carried)))
        specs.extend(carried)
        links.extend([hand] * len(carried))
    pairs = [(i, row) for i, k in carried_pairs(robot, attachments) for row in rows[k]]
    pairs = [*robot.self_collision_pairs, *pairs]
    made_of = [f"{SOURCES} {links} {pairs}".encode()]
    for spec in specs:
        made_of.append(f"{spec.kind} {spec.size} {spec.inflation} {spec.vertices.shape}".encode())
        made_of += (spec.vertices.tobytes(), spec.T_owner_shape.tobytes())

    def arrays() -> dict[str, np.ndarray]:
        made = robot_geometry(specs, links, pairs)._asdict()
        return made.pop("pieces")._asdict() | made

    found = cached_arrays("robot_geometry", b"".join(made_of), arrays)
    pieces = ConvexShapes(*(found.pop(name) for name in ConvexShapes._fields))
    return frozen(RobotGeometry(pieces=pieces, largest=float(found.pop("largest")), **found))


def _require_few_pieces(name: str, spec: ShapeSpec, most: int = 2000) -> None:
    """InvalidInputError for a shape that would be cut into more than `most` pieces."""
    points, _ = outline(spec._replace(T_owner_shape=np.eye(4)))
    size = np.ptp(points, axis=0)
    # 2000 pieces are a cube of 1.2 m; cutting more takes seconds, and soon minutes
    if spec.kind != SPHERE and np.prod(np.maximum(size / ANY_RADIUS, 1.0)) > most:
        raise InvalidInputError(
            f"{name} is {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} m large, too large to plan "
            "with: give sizes in metres"
        )


@lru_cache(maxsize=8)
def robot_swing(robot: Robot, attachments: tuple[Attachment, ...] = ()) -> np.ndarray:
    """Bounds (n,) on |dx/dq_j| of any point x of the robot [m/rad of hinges, 1 of sliders]."""
    kinematics, pieces = robot.kinematics, robot_arrays(robot, attachments)
    extent = np.zeros(robot.dof + 1)  # of what hangs on each pose row, from its origin
    for row, first in zip(pieces.body_link, pieces.body_start[:-1], strict=True):
        ball = pieces.sphere[first]
        extent[row] = max(extent[row], np.linalg.norm(ball[:3]) + ball[3])
    slides = np.maximum(np.abs(kinematics.lower), np.abs(kinematics.upper)) * kinematics.prismatic
    for j in reversed(range(robot.dof)):
        step = np.linalg.norm(kinematics.translation[j]) + slides[j]
        up = kinematics.parent[j]
        extent[up] = max(extent[up], step + extent[j + 1])
    return frozen(np.where(kinematics.prismatic, 1.0, extent[1:]))


@lru_cache(maxsize=8)
def scene_arrays(
    scene: Scene, reach: float, clearance: float = 0.0, most_cells: int = 256
) -> SceneGeometry:
    """Obstacles of a scene, with their distance grid over a cube about the base.

    Args:
        scene: the scene.
        reach: half edge of the cube [m].
        clearance: by which every obstacle is inflated [m].
        most_cells: of the grid along an edge; a long reach has coarser cells, not more memory.
    """
    clouds, specs = [], []
    for item in scene.obstacles:
        shape, T = item.shape, item.T_world_object
        if isinstance(shape, Measured):
            low, high, padding = blocks_of(shape, T, reach + clearance)
            clouds.append(Cloud(0.5 * (low + high), 0.5 * (high - low), padding + clearance, T))
            continue
        for spec in shape_specs(shape, T):
            if spec.kind == SPHERE:
                specs.append(spec._replace(size=(spec.size[0] + clearance,)))
            else:
                specs.append(spec._replace(inflation=spec.inflation + clearance))
    cell = max(CELL, 2.0 * reach / most_cells)
    return frozen(scene_geometry(specs, clouds, reach, cell))


# kind, size and vertices of `ShapeSpec`
SOLIDS: Mapping[type, Callable[[Any], tuple[int, tuple[float, ...], np.ndarray | None]]] = {
    Box: lambda box: (BOX, box.size, None),
    Cylinder: lambda it: (CYLINDER, (it.radius, it.radius, it.height), None),
    Sphere: lambda ball: (SPHERE, (ball.radius,), None),
    ConvexMesh: lambda mesh: (HULL, (), mesh.vertices),
}


def shape_specs(shape: Shape, T: np.ndarray) -> list[ShapeSpec]:
    """A shape at pose T (4, 4) [m] as convex shapes; a cloud as the exact checker's boxes."""
    none = np.empty((0, 3))
    if not isinstance(shape, Measured):
        kind, size, vertices = SOLIDS[type(shape)](shape)
        return [ShapeSpec(kind, size, none if vertices is None else vertices, T)]
    low, high, radius = blocks_of(shape, T)
    poses = np.tile(T, (len(low), 1, 1))
    poses[:, :3, 3] += 0.5 * (low + high) @ T[:3, :3].T
    return [
        ShapeSpec(BOX, tuple(edges), none, pose, radius)
        if edges.any()
        else ShapeSpec(SPHERE, (radius,), none, pose)
        for edges, pose in zip(high - low, poses, strict=True)
    ]
