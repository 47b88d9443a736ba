"""The arrays of the compiled collision checker, from a problem's robot, attachments and scene.

A robot's are kept in the user's cache: cutting its hulls into pieces takes a quarter of a second.
"""

from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np

from cvqmpt_lab.base import convex
from cvqmpt_lab.base.caches import cached_arrays, sources_digest
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.jit import KERNELS_DIGEST
from cvqmpt_lab.base.values import frozen
from cvqmpt_lab.collision import geometry
from cvqmpt_lab.collision.carried import carried_pairs, pairs_of_carried, reach_with
from cvqmpt_lab.collision.covers import PIECE_RADIUS_M, Cloud
from cvqmpt_lab.collision.geometry import (
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
    """Convex pieces of a robot and its attachments, kept in the user's cache.

    Raises InvalidInputError for shapes that are too large to cut.
    """
    reach_with(robot, attachments)
    specs = [
        ShapeSpec(HULL, piece.T_link_geometry, vertices=piece.vertices) for piece in robot.links
    ]
    # large ones that stand still, or that sliders alone move, as a gantry's, stay in one piece
    whole = list[int]()
    turned = ~robot.kinematics.prismatic @ robot.kinematics.moves
    for k, (spec, piece) in enumerate(zip(specs, robot.links, strict=True)):
        if turned[piece.link]:
            _require_few_pieces(f"link geometry {piece.name!r}", spec)
        elif _too_many_pieces(spec):
            whole.append(k)
    links = [piece.link for piece in robot.links]
    self_only = [k for k, piece in enumerate(robot.links) if piece.self_only]
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
    for k, m in pairs_of_carried(robot, attachments):
        pairs += product(rows[k], rows[m])
    pairs = [*robot.self_collision_pairs, *pairs]
    sources = sources_digest(Path(geometry.__file__), Path(convex.__file__))
    made_of = [f"{KERNELS_DIGEST} {sources} {links} {pairs} {self_only}".encode()]
    for spec in specs:
        made_of.append(f"{spec.kind} {spec.inflation} {spec.vertices.shape}".encode())
        made_of += (spec.half.tobytes(), spec.vertices.tobytes(), spec.T_owner_shape.tobytes())

    def arrays() -> dict[str, np.ndarray]:
        made = robot_geometry(specs, links, pairs, whole, self_only)._asdict()
        return made.pop("pieces")._asdict() | made

    found = cached_arrays("robot_geometry", b"".join(made_of), arrays)
    pieces = ConvexShapes(*(found.pop(name) for name in ConvexShapes._fields))
    made = RobotGeometry(pieces=pieces, **found)
    swing, relative = _swings(robot, made)
    return frozen(made._replace(body_swing=swing, pair_swing=relative))


def _swings(robot: Robot, made: RobotGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Return `body_swing` and `pair_swing` of a robot's pieces."""
    extent = np.full((len(robot.kinematics.parent) + 1, len(made.body_link)), -np.inf)
    roots = made.sphere[made.body_start[:-1]]
    farthest = np.linalg.norm(roots[:, :3], axis=1) + roots[:, 3]
    extent[made.body_link, np.arange(len(roots))] = farthest
    speeds = robot.joint_speeds_from(extent)
    first, second = speeds[made.pairs.T]
    # a joint that moves both bodies does not move one against the other
    apart = np.where((first > 0.0) & (second > 0.0), 0.0, first + second)
    summed = robot.kinematics.summed
    return np.ascontiguousarray(summed(speeds)), np.ascontiguousarray(summed(apart))


def _too_many_pieces(spec: ShapeSpec, most: int = 2000) -> bool:
    """Return whether a shape would be cut into more than `most` pieces.

    2000 pieces are a cube of 1.2 m; cutting more takes seconds, and soon minutes.
    """
    size = np.ptp(outline(spec._replace(T_owner_shape=np.eye(4))), axis=0)
    return bool(spec.kind != SPHERE and np.prod(np.maximum(size / PIECE_RADIUS_M, 1.0)) > most)


def _require_few_pieces(name: str, spec: ShapeSpec) -> None:
    """Refuse a moving shape that would be cut into too many pieces."""
    if _too_many_pieces(spec):
        size = np.ptp(outline(spec._replace(T_owner_shape=np.eye(4))), axis=0)
        raise InvalidInputError(
            f"{name} is {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} m large, too large to plan "
            "with: give sizes in metres"
        )


@lru_cache(maxsize=8)
def robot_swing(robot: Robot, attachments: tuple[Attachment, ...] = ()) -> np.ndarray:
    """Bounds (n,) on |dx/dq_j| of any point x of the robot [m/rad of hinges, 1 of sliders]."""
    pieces = robot_arrays(robot, attachments)
    extent = np.zeros(len(robot.kinematics.parent) + 1)
    for row, first in zip(pieces.body_link, pieces.body_start[:-1], strict=True):
        ball = pieces.sphere[first]
        extent[row] = max(extent[row], np.linalg.norm(ball[:3]) + ball[3])
    return frozen(robot.speeds_from(extent))


@lru_cache(maxsize=8)
def scene_arrays(
    scene: Scene,
    reach: float,
    clearance: float = 0.0,
    cell: float = 0.04,
    most_cells: int = 256,
) -> SceneGeometry:
    """Obstacles of a scene, with their distance grid over a cube about the base.

    Args:
        scene: the scene.
        reach: half edge of the cube [m].
        clearance: inflation of every obstacle [m].
        cell: edge of the grid's cells [m].
        most_cells: largest number of cells along the cube's edge; else cells are larger.
    """
    clouds, specs = [], []
    for item in scene.obstacles:
        shape, T = item.shape, item.T_world_object
        if isinstance(shape, Measured):
            low, high, padding = blocks_of(shape, T, reach + clearance)
            clouds.append(Cloud(0.5 * (low + high), 0.5 * (high - low), padding + clearance, T))
            continue
        for spec in shape_specs(shape, T):
            specs.append(spec._replace(inflation=spec.inflation + clearance))
    return frozen(scene_geometry(specs, clouds, reach, max(cell, 2.0 * reach / most_cells)))


def shape_specs(shape: Shape, T: np.ndarray) -> list[ShapeSpec]:
    """Convex shapes of a shape at pose T (4, 4) [m]; a cloud as the exact checker's boxes."""
    match shape:
        case Box():
            return [ShapeSpec(BOX, T, shape.half)]
        case Cylinder():
            return [ShapeSpec(CYLINDER, T, shape.half)]
        case Sphere():
            return [ShapeSpec(SPHERE, T, inflation=shape.radius)]
        case ConvexMesh():
            return [ShapeSpec(HULL, T, vertices=shape.vertices)]
    blocks = blocks_of(shape, T)
    half = 0.5 * (blocks.high - blocks.low)
    return [
        ShapeSpec(BOX if edges.any() else SPHERE, pose, edges, inflation=blocks.padding)
        for edges, pose in zip(half, blocks.poses(T), strict=True)
    ]
