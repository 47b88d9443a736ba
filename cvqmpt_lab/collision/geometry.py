"""Robot and scene for the collision kernels: named tuples of arrays and how they are made.

A *piece* is a convex part of a robot geometry. A *body* is a set of geometries on one link that are
checked against the same others; it has one tree of balls. An *item* is an obstacle, or a box around
neighbouring primitives of a cloud.
"""

import math
from collections.abc import Sequence
from itertools import product
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.collision.covers import (
    Cloud,
    Clusters,
    Piece,
    cluster_primitives,
    convex_hull,
    cut_into_pieces,
    sphere_tree,
)
from cvqmpt_lab.collision.distance_grid import (
    CENTRE,
    COLUMNS,
    HALF,
    INFLATION,
    REACH,
    DistanceGrid,
    distance_grid,
)
from cvqmpt_lab.collision.separation import (
    BOX,
    CYLINDER,
    HULL,
    MAX_HULL_VERTICES,
    SPHERE,
    ConvexShapes,
)
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.kinematics import Kinematics

CELL = 0.04  # [m] of the distance grid


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


def outline(spec: ShapeSpec, sides: int = 16) -> tuple[np.ndarray, float]:
    """Points (k, 3) and a radius [m] whose inflated hull holds the shape, in the owner's frame.

    The owner is a link or the world. A cylinder becomes a prism with so many sides around it.
    """
    if spec.kind == HULL:
        points = spec.vertices
    elif spec.kind == BOX:
        points = 0.5 * np.array(spec.size) * np.array(list(product((-1.0, 1.0), repeat=3)))
    elif spec.kind == CYLINDER:
        turn = 2.0 * np.pi * np.arange(sides) / sides
        radius = spec.size[0] / np.cos(np.pi / sides)
        half = np.full(sides, 0.5 * spec.size[2])
        rim = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), half])
        points = np.concatenate([rim, rim * (1.0, 1.0, -1.0)])
    else:
        points = np.zeros((1, 3))
    inflation = spec.size[0] if spec.kind == SPHERE else spec.inflation
    return points @ spec.T_owner_shape[:3, :3].T + spec.T_owner_shape[:3, 3], inflation


def pack_shapes(specs: Sequence[ShapeSpec]) -> ConvexShapes:
    """Shapes as a struct of arrays, in the order given; of a mesh only the vertices of its hull.

    InvalidInputError: a pose, size or vertex is not finite, or a mesh has no vertices.
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
    """InvalidInputError for shapes that kernels cannot handle."""
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


class RobotGeometry(NamedTuple):
    """Convex pieces of a robot, its attachments included."""

    pieces: ConvexShapes  # m convex pieces in their link frames
    sphere: Annotated[np.ndarray, "balls 4"]  # Balls of all bodies, see `SphereTree` [m]
    skip: Annotated[np.ndarray, "int64 balls"]  # See `SphereTree`
    leaf: Annotated[np.ndarray, "int64 balls"]  # Piece in each ball, or -1
    body_link: Annotated[np.ndarray, "int64 bodies"]  # Pose row of each body
    body_start: Annotated[np.ndarray, "int64 bodies"]  # First ball of each body
    body_end: Annotated[np.ndarray, "int64 bodies"]  # After its last ball
    order: Annotated[np.ndarray, "int64 checked"]  # Bodies to check against obstacles, tip first
    pairs: Annotated[np.ndarray, "int64 pairs 2"]  # Bodies to check against each other
    largest: float  # Radius of the largest ball at a leaf [m]


class SceneGeometry(NamedTuple):
    """Obstacles and clusters of a cloud's primitives, with their grid."""

    shapes: ConvexShapes  # All items
    bounds: Annotated[np.ndarray, "items 16"]  # Oriented boxes around them, see `distance_grid`
    # Of each item's primitives; a shape has none
    primitive_start: Annotated[np.ndarray, "int64 ranges"]
    # Centres and half edges in their items' frames [m]
    primitives: Annotated[np.ndarray, "primitives 6"]
    grid: DistanceGrid  # Distances over the robot's reach
    reach: float  # Largest ball whose neighbours the grid lists [m]


def robot_geometry(
    specs: Sequence[ShapeSpec],
    link: Sequence[int],
    pairs: Sequence[tuple[int, int]],
) -> RobotGeometry:
    """Pieces of a robot and their trees of balls.

    specs: geometries, posed in their links. link: pose row of each; those of link 0, fixed to the
        world, are not checked against obstacles. pairs: geometries to check against each other.
    """
    bodies, body_pairs = _bodies(link, pairs)
    piece_specs: list[ShapeSpec] = []
    trees = [
        sphere_tree([leaf for g in body for leaf in _cut(specs[g], piece_specs)]) for body in bodies
    ]
    end = np.cumsum([len(tree.leaf) for tree in trees], dtype=np.int64)
    start = end - [len(tree.leaf) for tree in trees]
    rows = np.array([link[members[0]] for members in bodies], dtype=np.int64)
    order = [b for b in np.argsort(-rows, kind="stable") if rows[b] != 0]
    sphere = np.concatenate([np.empty((0, 4)), *(tree.sphere for tree in trees)])
    leaf = np.concatenate([np.empty(0, np.int64), *(tree.leaf for tree in trees)])
    skips = [tree.skip + first for tree, first in zip(trees, start, strict=True)]
    return RobotGeometry(
        pieces=pack_shapes(piece_specs),
        sphere=sphere,
        skip=np.concatenate([np.empty(0, np.int64), *skips]),
        leaf=leaf,
        body_link=rows,
        body_start=start.astype(np.int64),
        body_end=end,
        order=np.array(order, dtype=np.int64),
        pairs=np.array(body_pairs, dtype=np.int64).reshape(-1, 2),
        largest=float(sphere[leaf >= 0, 3].max(initial=0.0)),
    )


def swing(kinematics: Kinematics, robot: RobotGeometry) -> np.ndarray:
    """Bounds (n,) on |dx/dq_j| of any point x of the robot [m/rad of hinges, 1 of sliders]."""
    n = len(kinematics.parent)
    extent = np.zeros(n + 1)  # of what hangs on each pose row, from its origin
    for row, first in zip(robot.body_link, robot.body_start, strict=True):
        ball = robot.sphere[first]
        extent[row] = max(extent[row], np.linalg.norm(ball[:3]) + ball[3])
    for j in reversed(range(n)):
        slide = (
            max(abs(kinematics.lower[j]), abs(kinematics.upper[j]))
            if kinematics.prismatic[j]
            else 0.0
        )
        step = np.linalg.norm(kinematics.translation[j]) + slide
        up = kinematics.parent[j]
        extent[up] = max(extent[up], step + extent[j + 1])
    return np.where(kinematics.prismatic, 1.0, extent[1:])


def _bodies(
    link: Sequence[int], pairs: Sequence[tuple[int, int]]
) -> tuple[list[list[int]], list[tuple[int, int]]]:
    """Geometries grouped by link and partners of checks, and the pairs of groups to check."""
    partners: list[set[int]] = [set() for _ in link]
    for a, b in pairs:
        partners[a].add(b)
        partners[b].add(a)
    groups: dict[tuple[int, frozenset[int]], list[int]] = {}
    for g, row in enumerate(link):
        groups.setdefault((row, frozenset(partners[g])), []).append(g)
    bodies = [members for (row, others), members in groups.items() if row != 0 or others]
    body_of = {g: b for b, members in enumerate(bodies) for g in members}
    paired = {(min(body_of[a], body_of[b]), max(body_of[a], body_of[b])) for a, b in pairs}
    return bodies, sorted(paired)


def _cut(spec: ShapeSpec, pieces: list[ShapeSpec]) -> list[Piece]:
    """Append the pieces of one geometry, cylinders and spheres whole; return a tree's leaves."""
    points, inflation = outline(spec)
    parts = [points] if spec.kind == SPHERE else cut_into_pieces(points)
    if spec.kind not in (HULL, BOX) or len(parts) == 1:
        pieces.append(spec)
        return [Piece(part, inflation, len(pieces) - 1) for part in parts]
    leaves = []
    for part in parts:
        pieces.append(ShapeSpec(HULL, (), part, np.eye(4), spec.inflation))
        leaves.append(Piece(part, inflation, len(pieces) - 1))
    return leaves


def scene_geometry(
    specs: Sequence[ShapeSpec],
    lower: np.ndarray,
    upper: np.ndarray,
    cell: float = CELL,
    clouds: Sequence[Cloud] = (),
) -> SceneGeometry:
    """Obstacles and clouds with a grid over the box lower..upper (3,) [m].

    Balls outside the grid, or larger than `REACH`, are compared with every item: correct, but slow.
    InvalidInputError: see `pack_shapes` and `cluster_primitives`.
    """
    solid = pack_shapes(specs)
    clusters = cluster_primitives(clouds, cell)
    turn, count = clusters.rotation.reshape(-1, 9), len(specs)
    boxes = np.column_stack([turn, clusters.centre, clusters.half, clusters.radius])
    bounds = np.concatenate([_bounds(specs), boxes])
    return SceneGeometry(
        shapes=_with_boxes(solid, clusters),
        bounds=bounds,
        primitive_start=np.concatenate([np.zeros(count, np.int64), clusters.start]),
        primitives=clusters.primitives,
        grid=distance_grid(bounds, lower, upper, cell, REACH),
        reach=float(REACH),
    )


def _bounds(specs: Sequence[ShapeSpec]) -> np.ndarray:
    """Oriented boxes (n, COLUMNS) around shapes, inflated; exact for boxes and spheres."""
    rows = np.zeros((len(specs), COLUMNS))
    for row, spec in zip(rows, specs, strict=True):
        R, middle, half = spec.T_owner_shape[:3, :3], np.zeros(3), np.zeros(3)
        row[INFLATION] = spec.inflation
        if spec.kind == HULL:
            low, high = spec.vertices.min(axis=0), spec.vertices.max(axis=0)
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
        elif spec.kind == CYLINDER:
            half[:] = spec.size[0], spec.size[0], 0.5 * spec.size[2]
        elif spec.kind == BOX:
            half = 0.5 * np.array(spec.size)
        else:
            row[INFLATION] = spec.size[0]
        row[:CENTRE], row[CENTRE:HALF] = R.ravel(), R @ middle + spec.T_owner_shape[:3, 3]
        row[HALF:INFLATION] = half
    return rows


def _with_boxes(shapes: ConvexShapes, clusters: Clusters) -> ConvexShapes:
    """Shapes followed by the boxes of clusters."""
    n = len(clusters.half)
    if n == 0:
        return shapes
    none = np.zeros(n, dtype=np.int64)
    return ConvexShapes(
        kind=np.concatenate([shapes.kind, np.full(n, BOX, dtype=np.int64)]),
        size=np.concatenate([shapes.size, clusters.half]),
        radius=np.concatenate([shapes.radius, clusters.radius]),
        rotation=np.concatenate([shapes.rotation, clusters.rotation]),
        translation=np.concatenate([shapes.translation, clusters.centre]),
        vertex_start=np.concatenate([shapes.vertex_start, none]),
        vertex_count=np.concatenate([shapes.vertex_count, none]),
        vertices=shapes.vertices,
    )
