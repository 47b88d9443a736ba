"""Triangle meshes of hulls, shapes, curves, rods and cones, of constraint regions and frames."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull

from cvqmpt_lab.base.convex import prism_around
from cvqmpt_lab.base.polyline import distances_along, states_at
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.cells import blocks_of
from cvqmpt_lab.scene.shapes import (
    Box,
    ConvexMesh,
    Cylinder,
    OccupancyMap,
    PointCloud,
    Shape,
    Sphere,
)

Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles whose corners are in anticlockwise order when seen from outside."""

    corners: np.ndarray  # (f, 3, 3) [m]
    normals: np.ndarray  # (f, 3, 3) of the surface at each corner, length 1
    colours: np.ndarray  # (f, 3) red, green, blue in [0, 1]
    piece: np.ndarray  # (f,) index of the piece of each triangle; pieces are drawn with outlines

    @property
    def shared(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points (n, 3), normals (n, 3) and faces (f, 3) whose corners are shared where equal."""
        both = np.concatenate([self.corners, self.normals], axis=2).reshape(-1, 6)
        exact = np.ascontiguousarray(both.round(7) + 0.0).view(f"V{6 * both.itemsize}").reshape(-1)
        _, first, faces = np.unique(exact, return_index=True, return_inverse=True)
        return both[first, :3], both[first, 3:], faces.reshape(-1, 3)

    def placed(self, T: np.ndarray, colour: Colour = (1.0, 1.0, 1.0)) -> "Mesh":
        """The same triangles moved by T (4, 4), in one colour."""
        turn = T[:3, :3].T
        return Mesh(
            self.corners @ turn + T[:3, 3],
            self.normals @ turn,
            0 * self.colours + colour,
            self.piece,
        )


def joined(meshes: Iterable[Mesh]) -> Mesh:
    """Join meshes to one mesh; each is a piece of it."""
    none = np.zeros((0, 3, 3))
    empty = Mesh(none, none, none[:, 0], np.zeros(0, dtype=int))
    meshes = [*meshes, empty]
    corners, normals, colours = (
        np.concatenate([getattr(mesh, name) for mesh in meshes])
        for name in ("corners", "normals", "colours")
    )
    piece = np.repeat(np.arange(len(meshes)), [len(mesh.piece) for mesh in meshes])
    return Mesh(corners, normals, colours, piece)


def hull_mesh(vertices: np.ndarray) -> Mesh:
    """Mesh of the convex hull of vertices (n, 3) [m]."""
    return _hull_mesh(np.ascontiguousarray(vertices, dtype=float).tobytes())


@lru_cache(maxsize=512)  # the same pieces of a robot are drawn again and again
def _hull_mesh(coordinates: bytes, most: int = 300, smooth: float = 0.7) -> Mesh:
    """Mesh of a convex hull.

    If there are more than `most` vertices, only the farthest in each of `most` directions are used.
    Facets that meet at less than `smooth` [rad] are shaded as one curved surface.
    """
    vertices = np.frombuffer(coordinates).reshape(-1, 3)
    if len(vertices) > most:
        # scaled to equal extents, so that flat pieces keep vertices all around
        even = vertices / np.maximum(np.ptp(vertices, axis=0), 1e-9)
        vertices = vertices[np.unique((even @ _sphere_points(most).T).argmax(axis=0))]
    hull = ConvexHull(vertices)
    facing, faces = hull.equations[:, :3], hull.simplices
    twice_area = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    inwards = (twice_area * facing).sum(axis=1) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    weight = np.zeros((len(vertices), len(faces)))
    weight[faces, np.arange(len(faces))[:, None]] = np.linalg.norm(twice_area, axis=1)[:, None]
    normals = (weight[faces] * (facing @ facing.T > np.cos(smooth))[:, None]) @ facing
    count = len(faces)
    return Mesh(vertices[faces], unit(normals), np.ones((count, 3)), np.zeros(count, dtype=int))


def shape_mesh(shape: Shape, most_balls: int = 4000) -> Mesh:
    """Mesh of a shape in its own frame; spheres and cylinders have facets.

    Of a cloud of more than `most_balls` points, every k-th point is drawn, with a larger ball.
    """
    match shape:
        case Cylinder(radius, height):
            return hull_mesh(prism_around(radius, (-0.5 * height, 0.5 * height), sides=32))
        case Sphere(radius):
            return _ball(radius, 200)
        case PointCloud(points, radius):
            every = -(-len(points) // most_balls)
            return _copies(_ball(radius * np.sqrt(every), 12), points[::every])
        case OccupancyMap():
            low, high, _ = blocks_of(shape, np.eye(4))
            cube = hull_mesh(Box((1.0, 1.0, 1.0)).vertices)
            return _copies(cube, 0.5 * (low + high), high - low)
        case Box() | ConvexMesh():
            return hull_mesh(shape.vertices)


def beads(points: np.ndarray, radius: float = 0.008, spacing: float = 0.012) -> Mesh:
    """Mesh of balls at equal distances along a polyline.

    Args:
        points: (m, 3) [m].
        radius: radius of the balls [m].
        spacing: distance between the balls [m].
    """
    travelled = distances_along(points)
    at = np.linspace(0.0, travelled[-1], 1 + int(travelled[-1] / spacing))
    centres = states_at(points, travelled, at)
    return _copies(_ball(radius, 24), centres)


def rod(start: np.ndarray, end: np.ndarray, radius: float) -> Mesh:
    """Mesh of a cylinder between two points (3,) [m], with a radius [m]."""
    z = end - start
    x = unit(np.cross(z, np.eye(3)[np.argmin(np.abs(z))]))
    T = np.eye(4)
    T[:3] = np.stack([x, np.cross(unit(z), x), unit(z), 0.5 * (start + end)], axis=1)
    return shape_mesh(Cylinder(radius, float(np.linalg.norm(z)))).placed(T)


def cone(apex: np.ndarray, axis: np.ndarray, angle: float) -> Mesh:
    """Mesh of a cone with an apex (3,), an axis vector (3,) [m] and a half angle [rad]."""
    x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across = np.tan(max(angle, 0.01)) * np.stack(
        [np.linalg.norm(axis) * unit(x), np.cross(unit(axis), unit(x)) * np.linalg.norm(axis)]
    )
    turn = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    rim = apex + axis + np.stack([np.cos(turn), np.sin(turn)], axis=1) @ across
    return hull_mesh(np.vstack([apex, rim]))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) scaled to length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _copies(mesh: Mesh, centres: np.ndarray, scales: np.ndarray | None = None) -> Mesh:
    """Mesh of k copies of a mesh, scaled by `scales` (k, 3) and moved to `centres` (k, 3) [m]."""
    scaled = mesh.corners if scales is None else scales[:, None, None] * mesh.corners
    corners = (centres[:, None, None] + scaled).reshape(-1, 3, 3)
    normals = np.tile(mesh.normals, (len(centres), 1, 1))
    return Mesh(corners, normals, np.ones((len(corners), 3)), np.zeros(len(corners), dtype=int))


@lru_cache(maxsize=64)  # equal balls are one mesh of a page
def _ball(radius: float, count: int) -> Mesh:
    """Mesh of a ball about the origin with so many vertices, shaded as a smooth surface."""
    mesh = hull_mesh(radius * _sphere_points(count))
    return replace(mesh, normals=unit(mesh.corners))


def _sphere_points(count: int) -> np.ndarray:
    """Points (count, 3) on the unit sphere at almost equal distances (golden spiral)."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn, radius = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count), np.sqrt(1.0 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def constraint_marks(
    problem: PlanningProblem,
    states: np.ndarray,
    margin: float = 0.1,
    length: float = 0.13,
    sheet: float = 0.002,
    radius: float = 0.003,
    widest: float = 1.4,
) -> Iterator[Mesh]:
    """Yield meshes of planes, lines, arcs and cones that show a problem's regions around a path.

    A plane or line shows the allowed positions of the origin of e in w. A cone, at both ends of the
    path, shows the allowed directions of an axis whose tilt is bounded, or about which rotation is
    free. An arc shows the path of a region that is attached to a door, over the door's range. Balls
    show the part of a sphere or cylinder near the path, rods what a distance or bearing is about.

    Args:
        problem: the problem with the regions.
        states: states (m, n) of the path, m >= 1 [rad or m].
        margin: extension of planes and lines beyond the path, as a share of the robot's reach.
        length: length of cones, as a share of the robot's reach.
        sheet: thickness of planes [m].
        radius: radius of lines [m].
        widest: cones with at least this half angle are not drawn [rad].
    """
    robot, reach = problem.robot, problem.robot.reach
    for region in problem.regions:
        yield from _surface_marks(problem.robot, region, states, length * reach, radius)
        if isinstance(region, TaskSpaceRegionChain):
            # one joint: a door; a region attached to the other hand is not drawn
            moved = np.flatnonzero(robot.movers(region.links(robot)[0][0]))
            if len(moved) == 1:
                swept = np.repeat(states[:1], 40, axis=0)
                swept[:, moved] = np.linspace(robot.lower[moved], robot.upper[moved], 40)
                yield beads((region.reference_poses(robot, swept) @ region.Tw_e)[:, :3, 3])
            continue
        # w, displaced as the hand is
        T_world_w = robot.poses(states, region.end_effector) @ np.linalg.inv(region.Tw_e)
        rows = set(region.bounded_rows.tolist())
        fixed = [k for k in range(3) if k in rows]
        free = [k for k in range(3) if k not in rows]
        if len(free) in (1, 2):
            R, t = region.T0_w[:3, :3], region.T0_w[:3, 3]
            at = T_world_w[:, :3, 3] @ R - R.T @ t
            low, high = at.min(axis=0) - margin * reach, at.max(axis=0) + margin * reach
            low[fixed], high[fixed] = region.Bw[fixed].clip(-reach, reach).T
            x, y, z = np.maximum(high - low, sheet if len(free) == 2 else 2.0 * radius).tolist()
            T = region.T0_w.copy()
            T[:3, 3] += R @ (0.5 * (low + high))
            yield shape_mesh(Box((x, y, z))).placed(T)
        turning = [2] if 6 in rows else [k for k in range(3) if k + 3 not in rows]
        leaning = [6] if 6 in rows else [k for k in rows if 2 < k < 6]
        tilt = float(np.abs(region.bounds[leaning]).max(initial=0.0))
        if len(turning) == 1 and tilt < widest:
            for T in T_world_w[[0, -1]]:
                yield cone(T[:3, 3], length * reach * region.T0_w[:3, turning[0]], tilt)
                yield rod(T[:3, 3], T[:3, 3] + length * reach * T[:3, turning[0]], radius)


def _surface_marks(
    robot: Robot, region: TaskSpaceRegion, states: np.ndarray, near: float, radius: float
) -> Iterator[Mesh]:
    """Yield meshes of a region's distance, radius and bearing around a path.

    Args:
        robot: the robot.
        region: the region.
        states: states (m, n) of the path [rad or m].
        near: largest distance of balls from the path [m].
        radius: radius of balls and rods [m].
    """
    rows = set(region.bounded_rows.tolist())
    if not rows & {7, 8, 9}:
        return
    T_world_w = region.reference_poses(robot, states)
    places = (robot.poses(states, region.end_effector) @ np.linalg.inv(region.Tw_e))[:, :3, 3]
    low, high = region.bounds[8 if 8 in rows else 7]
    points = np.empty((0, 3))
    if len(T_world_w) == 1 and high - low < 0.02:  # a surface that stands still [m]
        points = _sphere_points(6000)
        if 8 in rows:
            along = (places - T_world_w[0, :3, 3]) @ T_world_w[0, :3, 2]
            points /= np.linalg.norm(points[:, :2], axis=1, keepdims=True)
            heights = np.linspace(along.min() - near, along.max() + near, len(points))
            points[:, 2] = np.random.default_rng(0).permutation(heights) / high
        points = high * points @ T_world_w[0, :3, :3].T + T_world_w[0, :3, 3]
        away = np.linalg.norm(points[:, None] - places[:: 1 + len(places) // 50], axis=2)
        points = points[away.min(axis=1) < near]
    if len(points):
        yield _copies(_ball(1.5 * radius, 12), points)
    if rows & {7, 9}:
        for k in (0, -1):
            yield rod(places[k], T_world_w[min(k, len(T_world_w) - 1), :3, 3], radius)


def axes_marks(
    reach: float, length: float = 0.08, radius: float = 0.004
) -> Iterator[tuple[str, Colour, Mesh]]:
    """Yield name, colour and mesh of each axis of a frame.

    Args:
        reach: reach of the robot [m].
        length: length of the axes, as a share of the reach.
        radius: radius of the axes, as a share of the reach.
    """
    colours = (0.85, 0.15, 0.15), (0.15, 0.60, 0.15), (0.15, 0.30, 0.85)  # red, green, blue
    for name, colour, end in zip("xyz", colours, length * reach * np.eye(3), strict=True):
        yield name, colour, rod(np.zeros(3), end, radius * reach)
