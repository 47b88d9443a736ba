"""Robot and scene for the collision kernels: named tuples of arrays and how they are made.

A *piece* is a convex part of a robot geometry. A *body* is a set of geometries on one link that are
checked against the same others; it has one tree of balls. An *item* is an obstacle, or a box around
neighbouring primitives of a cloud.
"""

from collections.abc import Sequence
from itertools import product
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.collision.covers import (
    Cloud,
    Piece,
    cluster_primitives,
    convex_hull,
    cut_into_pieces,
    sphere_trees,
)
from cvqmpt_lab.collision.distance_grid import (
    CENTRE,
    COLUMNS,
    HALF,
    INFLATION,
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
    """Shapes as a struct of arrays, in the order given; of a mesh only the vertices of its hull."""
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
            if count[i] >= MAX_HULL_VERTICES:
                raise InvalidInputError(
                    f"shape {i}: a mesh whose hull has {count[i]} vertices; give at most "
                    f"{MAX_HULL_VERTICES - 1}"
                )
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


class RobotGeometry(NamedTuple):
    """Convex pieces of a robot, its attachments included."""

    pieces: ConvexShapes  # m convex pieces in their link frames
    sphere: Annotated[np.ndarray, "balls 4"]  # Balls of all bodies, see `SphereTrees` [m]
    skip: Annotated[np.ndarray, "int64 balls"]  # See `SphereTrees`
    leaf: Annotated[np.ndarray, "int64 balls"]  # Piece in each ball, or -1
    body_link: Annotated[np.ndarray, "int64 bodies"]  # Pose row of each body
    body_start: Annotated[np.ndarray, "int64 starts"]  # First ball of each body; then their number
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
    trees = sphere_trees(
        [[leaf for g in body for leaf in _cut(specs[g], piece_specs)] for body in bodies]
    )
    rows = np.array([link[members[0]] for members in bodies], dtype=np.int64)
    order = [b for b in np.argsort(-rows, kind="stable") if rows[b] != 0]
    return RobotGeometry(
        pieces=pack_shapes(piece_specs),
        sphere=trees.sphere,
        skip=trees.skip,
        leaf=trees.leaf,
        body_link=rows,
        body_start=trees.start,
        order=np.array(order, dtype=np.int64),
        pairs=np.array(body_pairs, dtype=np.int64).reshape(-1, 2),
        largest=float(trees.sphere[trees.leaf >= 0, 3].max(initial=0.0)),
    )


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
    specs: Sequence[ShapeSpec], clouds: Sequence[Cloud], reach: float, cell: float = CELL
) -> SceneGeometry:
    """Obstacles and clouds with a grid of cells over a cube of half edge `reach` [m].

    Balls outside the grid, or larger than `REACH`, are compared with every item: correct, but slow.
    """
    clusters = [cluster_primitives(cloud, cell) for cloud in clouds if len(cloud.centre)]
    solid, boxes = (
        pack_shapes(specs),
        np.concatenate([np.empty((0, COLUMNS)), *(it.bounds for it in clusters)]),
    )
    none = np.zeros(len(boxes), dtype=np.int64)
    parts = (
        np.full(len(boxes), BOX),
        boxes[:, HALF:INFLATION],
        boxes[:, INFLATION],
        boxes[:, :CENTRE].reshape(-1, 3, 3),
        boxes[:, CENTRE:HALF],
        none,
        none,
    )
    joined = [np.concatenate(pair) for pair in zip(solid[:-1], parts, strict=True)]
    bounds = np.concatenate([_bounds(specs, solid), boxes])
    counts = [np.zeros(len(specs) + 1, dtype=np.int64), *(it.listed for it in clusters)]
    return SceneGeometry(
        shapes=ConvexShapes._make([*joined, solid.vertices]),
        bounds=bounds,
        primitive_start=np.cumsum(np.concatenate(counts)),
        primitives=np.concatenate([np.empty((0, 6)), *(it.primitives for it in clusters)]),
        grid=distance_grid(bounds, reach, cell),
    )


def _bounds(specs: Sequence[ShapeSpec], packed: ConvexShapes) -> np.ndarray:
    """Oriented boxes (n, COLUMNS) around shapes, inflated; exact for boxes and spheres."""
    turns = packed.rotation.reshape(-1, 9)
    bounds = np.column_stack([turns, packed.translation, packed.size, packed.radius])
    for row, spec in zip(bounds, specs, strict=True):
        if spec.kind == HULL:
            low, high = spec.vertices.min(axis=0), spec.vertices.max(axis=0)
            R, t = spec.T_owner_shape[:3, :3], spec.T_owner_shape[:3, 3]
            row[:CENTRE], row[CENTRE:HALF] = R.ravel(), R @ (0.5 * (low + high)) + t
            row[HALF:INFLATION] = 0.5 * (high - low)
    return bounds
