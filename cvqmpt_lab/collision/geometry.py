"""Robot and scene for the collision kernels, as named tuples of arrays.

A *piece* is a convex part of a robot geometry. A *body* is a set of geometries on one link that are
checked against the same others; it has one tree of balls. An *item* is an obstacle, or a box around
neighbouring primitives of a cloud.
"""

from collections.abc import Collection, Sequence
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.convex import box_corners, convex_hull, prism_around
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.collision.covers import (
    Cloud,
    Piece,
    cluster_primitives,
    cut_into_pieces,
    sphere_trees,
)
from cvqmpt_lab.collision.distance_grid import (
    BOUNDS_CENTRE,
    BOUNDS_COLUMNS,
    BOUNDS_HALF,
    BOUNDS_INFLATION,
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


class ShapeSpec(NamedTuple):
    """Convex shape in plain numbers, in the frame of its owner: a link or the world."""

    kind: int  # HULL, BOX, CYLINDER or SPHERE
    T_owner_shape: np.ndarray  # (4, 4) pose [m]
    # half edges of a box, (radius, radius, half height) of a cylinder [m]
    half: np.ndarray = np.zeros(3)
    vertices: np.ndarray = np.empty((0, 3))  # of a hull [m]
    inflation: float = 0.0  # to all sides [m]; a sphere is an inflated point


def outline(spec: ShapeSpec, sides: int = 16) -> np.ndarray:
    """Points (k, 3) whose inflated hull contains the shape, in the owner's frame [m].

    sides: of the prism around a cylinder.
    """
    half = spec.half
    if spec.kind == HULL:
        points = spec.vertices
    elif spec.kind == BOX:
        points = box_corners(-half, half)
    elif spec.kind == CYLINDER:
        points = prism_around(half[0], (half[2], -half[2]), sides)
    else:
        points = np.zeros((1, 3))
    return points @ spec.T_owner_shape[:3, :3].T + spec.T_owner_shape[:3, 3]


def pack_shapes(specs: Sequence[ShapeSpec]) -> ConvexShapes:
    """Pack shapes into arrays, in the order given; of a mesh only the vertices of its hull."""
    n = len(specs)
    size = np.array([spec.half for spec in specs]).reshape(n, 3)
    radius = np.array([spec.inflation for spec in specs], dtype=float)
    rotation, translation = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    count = np.zeros(n, dtype=np.int64)
    corners: list[np.ndarray] = [np.empty((0, 3))]
    for i, spec in enumerate(specs):
        if spec.kind == HULL:
            corners.append(convex_hull(outline(spec)).corners)
            count[i] = len(corners[-1])
            if count[i] >= MAX_HULL_VERTICES:
                raise InvalidInputError(
                    f"shape {i}: a mesh whose hull has {count[i]} vertices; give at most "
                    f"{MAX_HULL_VERTICES - 1}"
                )
            size[i] = np.abs(corners[-1]).max(axis=0)
        else:
            rotation[i], translation[i] = spec.T_owner_shape[:3, :3], spec.T_owner_shape[:3, 3]
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
    body_start: Annotated[
        np.ndarray, "int64 starts"
    ]  # First ball of each body; last: number of balls
    order: Annotated[np.ndarray, "int64 checked"]  # Bodies to check against obstacles, tip first
    pairs: Annotated[np.ndarray, "int64 pairs 2"]  # Bodies to check against each other
    # When joint j moves by dq_j, no point of a body moves more than body_swing[body, j] |dq_j|, and
    # no point of a pair of bodies more than pair_swing[pair, j] |dq_j| in the other one's frame
    body_swing: Annotated[np.ndarray, "bodies n"]  # [m/rad of hinges, 1 of sliders]
    pair_swing: Annotated[np.ndarray, "pairs n"]


class SceneGeometry(NamedTuple):
    """Obstacles and clusters of a cloud's primitives, with their grid."""

    shapes: ConvexShapes  # All items
    bounds: Annotated[np.ndarray, "items 16"]  # Oriented boxes around them, see `distance_grid`
    # Index in `primitives` of each item's first primitive (items + 1,); obstacles have none
    primitive_start: Annotated[np.ndarray, "int64 ranges"]
    # Centres and half edges in their items' frames [m]
    primitives: Annotated[np.ndarray, "primitives 6"]
    grid: DistanceGrid  # Distances over the robot's reach


def robot_geometry(
    specs: Sequence[ShapeSpec],
    link: Sequence[int],
    pairs: Sequence[tuple[int, int]],
    whole: Collection[int] = (),
    self_only: Collection[int] = (),
) -> RobotGeometry:
    """Cut a robot into pieces and make their trees of balls; swings are left empty.

    Args:
        specs: geometries, posed in their links.
        link: pose row of each; geometries of link 0, which is fixed to the world, are not checked
            against obstacles.
        pairs: geometries to check against each other.
        whole: geometries that are not cut: one ball around each, which is checked exactly more
            often, instead of thousands.
        self_only: geometries that are not checked against obstacles.
    """
    bodies, body_pairs = _bodies(link, pairs, self_only)
    piece_specs: list[ShapeSpec] = []
    trees = sphere_trees(
        [
            [leaf for g in body for leaf in _cut(specs[g], piece_specs, g in whole)]
            for body in bodies
        ]
    )
    rows = np.array([link[members[0]] for members in bodies], dtype=np.int64)
    seen = [members[0] not in self_only for members in bodies]
    order = [b for b in np.argsort(-rows, kind="stable") if rows[b] != 0 and seen[b]]
    return RobotGeometry(
        pieces=pack_shapes(piece_specs),
        sphere=trees.sphere,
        skip=trees.skip,
        leaf=trees.leaf,
        body_link=rows,
        body_start=trees.start,
        order=np.array(order, dtype=np.int64),
        pairs=np.array(body_pairs, dtype=np.int64).reshape(-1, 2),
        body_swing=np.zeros((len(bodies), 0)),
        pair_swing=np.zeros((len(body_pairs), 0)),
    )


def _bodies(
    link: Sequence[int], pairs: Sequence[tuple[int, int]], self_only: Collection[int]
) -> tuple[list[list[int]], list[tuple[int, int]]]:
    """Group geometries by link and by their check partners.

    Returns:
        Geometries of each group, and the pairs of groups to check.
    """
    partners: list[set[int]] = [set() for _ in link]
    for a, b in pairs:
        partners[a].add(b)
        partners[b].add(a)
    groups: dict[tuple[int, frozenset[int], bool], list[int]] = {}
    for g, row in enumerate(link):
        groups.setdefault((row, frozenset(partners[g]), g in self_only), []).append(g)
    bodies = [members for (row, others, _), members in groups.items() if row != 0 or others]
    body_of = {g: b for b, members in enumerate(bodies) for g in members}
    paired = {(min(body_of[a], body_of[b]), max(body_of[a], body_of[b])) for a, b in pairs}
    return bodies, sorted(paired)


def _cut(spec: ShapeSpec, pieces: list[ShapeSpec], whole: bool) -> list[Piece]:
    """Append the convex pieces of a geometry (cylinders, spheres uncut); return its leaves."""
    points = outline(spec)
    parts = [points] if whole or spec.kind == SPHERE else cut_into_pieces(points)
    if spec.kind not in (HULL, BOX) or len(parts) == 1:
        pieces.append(spec)
        return [Piece(part, spec.inflation, len(pieces) - 1) for part in parts]
    leaves = []
    for part in parts:
        pieces.append(ShapeSpec(HULL, np.eye(4), vertices=part, inflation=spec.inflation))
        leaves.append(Piece(part, spec.inflation, len(pieces) - 1))
    return leaves


def scene_geometry(
    specs: Sequence[ShapeSpec], clouds: Sequence[Cloud], reach: float, cell: float
) -> SceneGeometry:
    """Pack obstacles and clouds, and make their distance grid.

    Balls outside the grid, or larger than `GRID_REACH_M`, are compared with every item: correct,
    but slow.

    Args:
        specs: obstacles, posed in the world.
        clouds: points or cells.
        reach: half edge of the grid's cube [m].
        cell: edge of the grid's cells [m].
    """
    clusters = [cluster_primitives(cloud, cell) for cloud in clouds if len(cloud.centre)]
    solid = pack_shapes(specs)
    boxes = np.concatenate([np.empty((0, BOUNDS_COLUMNS)), *(it.bounds for it in clusters)])
    none = np.zeros(len(boxes), dtype=np.int64)
    parts = (
        np.full(len(boxes), BOX),
        boxes[:, BOUNDS_HALF:BOUNDS_INFLATION],
        boxes[:, BOUNDS_INFLATION],
        boxes[:, :BOUNDS_CENTRE].reshape(-1, 3, 3),
        boxes[:, BOUNDS_CENTRE:BOUNDS_HALF],
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
    """Oriented inflated boxes (n, BOUNDS_COLUMNS) around shapes; equal to boxes and spheres."""
    turns = packed.rotation.reshape(-1, 9)
    bounds = np.column_stack([turns, packed.translation, packed.size, packed.radius])
    for row, spec in zip(bounds, specs, strict=True):
        if spec.kind == HULL:
            low, high = spec.vertices.min(axis=0), spec.vertices.max(axis=0)
            R, t = spec.T_owner_shape[:3, :3], spec.T_owner_shape[:3, 3]
            row[:BOUNDS_CENTRE] = R.ravel()
            row[BOUNDS_CENTRE:BOUNDS_HALF] = R @ (0.5 * (low + high)) + t
            row[BOUNDS_HALF:BOUNDS_INFLATION] = 0.5 * (high - low)
    return bounds
