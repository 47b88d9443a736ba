"""Coloured triangles of shapes, scenes, the robot and curves;
viewpoints, and a z-buffer rasteriser in numpy.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.spatial import ConvexHull

from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.hulls import prism_vertices
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.cells import blocks_of
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import (
    Box,
    ConvexMesh,
    Cylinder,
    OccupancyMap,
    PointCloud,
    Shape,
    Sphere,
    shape_vertices,
)

Colour = tuple[float, float, float]

# of scene objects with a word that begins so; the first that fits counts
KIND_COLOURS: Mapping[str, Colour] = {
    "floor": (0.88, 0.87, 0.85),
    "wall": (0.93, 0.92, 0.89),
    "handle": (0.52, 0.54, 0.57),
    "countertop": (0.55, 0.45, 0.37),
    "plate": (0.16, 0.16, 0.18),
    "knob": (0.20, 0.20, 0.22),
    "range": (0.45, 0.47, 0.50),
    "panel": (0.96, 0.95, 0.92),
    "hood": (0.70, 0.72, 0.75),
    "pedestal": (0.36, 0.38, 0.42),
    "cracker": (0.80, 0.45, 0.25),
    "mustard": (0.93, 0.78, 0.22),
    "can": (0.86, 0.24, 0.20),
}
OTHER_COLOUR: Colour = (0.87, 0.77, 0.62)
ROBOT_COLOUR: Colour = (0.90, 0.90, 0.92)
GHOST_COLOUR: Colour = (0.25, 0.50, 0.90)
GOAL_COLOUR: Colour = (0.16, 0.68, 0.38)
LOAD_COLOUR: Colour = (0.86, 0.24, 0.20)
TRACE_COLOUR: Colour = (0.96, 0.55, 0.05)
BEAD_RADIUS, BEAD_SPACING = 0.008, 0.012  # [m] of the hand's trace
CLOUD_BALLS = 4000  # of a cloud that are drawn; of a larger one some, larger
MOST_CORNERS = 300  # of a convex piece that is drawn
# facets of a hull that meet at less than 0.7 rad are shaded as one curved surface
SMOOTH = np.cos(0.7)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, anticlockwise when seen from outside."""

    corners: np.ndarray  # (f, 3, 3) [m]
    normals: np.ndarray  # (f, 3, 3), of the surface at each corner
    colours: np.ndarray  # (f, 3), each channel in [0, 1]
    piece: np.ndarray  # (f,), number of the piece that a triangle belongs to; pieces have outlines

    def placed(self, T: np.ndarray, colour: Colour) -> "Mesh":
        """The same triangles moved by T (4, 4), in one colour."""
        turn = T[:3, :3].T
        return Mesh(
            self.corners @ turn + T[:3, 3],
            self.normals @ turn,
            0 * self.colours + colour,
            self.piece,
        )


def colour_of(name: str) -> Colour:
    """Colour of a scene object, by its name."""
    words = re.split("[^a-z]+", name.lower())
    for kind, colour in KIND_COLOURS.items():
        if any(word.startswith(kind) for word in words):
            return colour
    return OTHER_COLOUR


def is_ground(item: SceneObject) -> bool:
    """Whether an object is a floor: a box that is no obstacle."""
    return isinstance(item.shape, Box) and not item.obstacle


def poses_along(robot: Robot, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T_world_link (m, n + 1, 4, 4), row 0 the world, and T_world_hand (m, 4, 4) at configurations
    (m, n).
    """
    rotations, translations = link_poses(
        robot.kinematics, np.ascontiguousarray(states, dtype=float)
    )
    T_world_link = np.zeros((*translations.shape[:2], 4, 4))
    T_world_link[..., :3, :3], T_world_link[..., :3, 3] = rotations, translations
    T_world_link[..., 3, 3] = 1.0
    link, T_link_hand = robot.end_effector_link
    return T_world_link, T_world_link[:, link] @ T_link_hand


def hull_mesh(vertices: np.ndarray) -> Mesh:
    """The convex hull of vertices (n, 3);
    of more than MOST_CORNERS, those that lie farthest in as many directions.
    """
    return _hull_mesh(np.ascontiguousarray(vertices, dtype=float).tobytes())


@lru_cache(maxsize=512)  # a robot's pieces are asked for in every pose
def _hull_mesh(coordinates: bytes) -> Mesh:
    vertices = np.frombuffer(coordinates).reshape(-1, 3)
    if len(vertices) > MOST_CORNERS:
        # flat pieces need corners all round, too
        even = vertices / np.maximum(np.ptp(vertices, axis=0), 1e-9)
        vertices = vertices[np.unique((even @ _sphere_points(MOST_CORNERS).T).argmax(axis=0))]
    hull = ConvexHull(vertices)
    facing, faces = hull.equations[:, :3], hull.simplices
    twice_area = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    inwards = (twice_area * facing).sum(axis=1) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    weight = np.zeros((len(vertices), len(faces)))
    weight[faces, np.arange(len(faces))[:, None]] = np.linalg.norm(twice_area, axis=1)[:, None]
    normals = (weight[faces] * (facing @ facing.T > SMOOTH)[:, None]) @ facing
    return Mesh(
        vertices[faces], unit(normals), np.ones((len(faces), 3)), np.zeros(len(faces), dtype=int)
    )


def shape_mesh(shape: Shape) -> Mesh:
    """Triangles of a shape in its own frame; balls and cylinders have facets."""
    match shape:
        case Cylinder(radius, height):
            return hull_mesh(prism_vertices(radius, 0.5 * height, sides=32))
        case Sphere(radius):
            return hull_mesh(radius * _sphere_points(200))
        case PointCloud(points, radius):
            every = -(-len(points) // CLOUD_BALLS)
            return _copies(hull_mesh(radius * np.sqrt(every) * _sphere_points(12)), points[::every])
        case OccupancyMap():
            return _copies(hull_mesh(shape_vertices(Box((1.0, 1.0, 1.0)))), *map_boxes(shape))
        case Box() | ConvexMesh():
            return hull_mesh(shape_vertices(shape))


def map_boxes(shape: OccupancyMap) -> tuple[np.ndarray, np.ndarray]:
    """Centres and edges, (b, 3) each [m], of boxes that together are the map's cells without their
    padding.
    """
    low, high, _ = blocks_of(shape, np.eye(4))
    return 0.5 * (low + high), high - low


def joined(meshes: Iterable[Mesh]) -> Mesh:
    """One mesh of several, each a piece of its own."""
    meshes = list(meshes)
    corners, normals, colours = (
        np.concatenate([getattr(mesh, name) for mesh in meshes])
        for name in ("corners", "normals", "colours")
    )
    return Mesh(
        corners, normals, colours, np.repeat(np.arange(len(meshes)), [len(m.piece) for m in meshes])
    )


def robot_meshes(problem: PlanningProblem, q: np.ndarray, colour: Colour) -> list[Mesh]:
    """The robot's hulls and what it carries, posed at q (n,)."""
    (T_world_link,), (T_world_hand,) = poses_along(problem.robot, q[None])
    links = [
        hull_mesh(part.vertices).placed(T_world_link[part.link] @ part.T_link_geometry, colour)
        for part in problem.robot.links
    ]
    loads = [
        shape_mesh(item.shape).placed(T_world_hand @ item.T_hand_object, LOAD_COLOUR)
        for item in problem.attachments
    ]
    return links + loads


def scene_meshes(scene: Scene, hidden: Sequence[str]) -> list[Mesh]:
    """The scene's objects but floors and those named in `hidden`."""
    return [
        shape_mesh(item.shape).placed(item.T_world_object, colour_of(item.name))
        for item in scene
        if item.name not in hidden and not is_ground(item)
    ]


def ground_height(scene: Scene) -> float | None:
    """Top of the highest floor [m]; None without one."""
    tops = [
        item.T_world_object[2, 3] + 0.5 * item.shape.size[2]
        for item in scene
        if isinstance(item.shape, Box) and is_ground(item)
    ]
    return max(tops, default=None)


def beads(points: np.ndarray, colour: Colour) -> Mesh:
    """Balls at even distances along a curve given by points (m, 3)."""
    travelled = travelled_along(points)
    at = np.linspace(0.0, travelled[-1], 1 + int(travelled[-1] / BEAD_SPACING))
    centres = np.stack([np.interp(at, travelled, points[:, axis]) for axis in range(3)], axis=1)
    return _copies(hull_mesh(BEAD_RADIUS * _sphere_points(24)), centres).placed(np.eye(4), colour)


def _copies(mesh: Mesh, centres: np.ndarray, scales: np.ndarray | None = None) -> Mesh:
    """One mesh of copies of another, moved to centres (k, 3) [m], stretched by scales (k, 3) along
    the axes.
    """
    scaled = mesh.corners if scales is None else scales[:, None, None] * mesh.corners
    corners = (centres[:, None, None] + scaled).reshape(-1, 3, 3)
    normals = np.tile(mesh.normals, (len(centres), 1, 1))
    return Mesh(corners, normals, np.ones((len(corners), 3)), np.zeros(len(corners), dtype=int))


def travelled_along(points: np.ndarray) -> np.ndarray:
    """Distance (m,) covered at each of the points (m, d)."""
    return np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]


def _sphere_points(count: int) -> np.ndarray:
    """Points (count, 3) spread evenly over the unit sphere (golden spiral)."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn, radius = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count), np.sqrt(1.0 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) scaled to length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


# Triangles to pixels.
# sides of squares [pixels] in which small triangles are drawn many at a time
SMALL = (0, 4, 8, 16, 32)
AT_ONCE = 1_000_000  # pixels of such squares
NEAR = 0.05  # [m] triangles closer to the camera than this are left out
# [rad] of the sun seen from the target, to the left of the eye
SUN_LEFT, SUN_ELEVATION = 0.14, 0.722


@dataclass(frozen=True)
class Viewpoint:
    """Where a picture is taken from: a pinhole, z up."""

    eye: tuple[float, float, float] = (-1.7, -2.0, 1.75)  # [m]
    target: tuple[float, float, float] = (0.4, -0.1, 0.5)  # In the middle of the picture [m]
    height_angle: float = 0.64  # Angle of view from the bottom to the top of the picture [rad]

    @property
    def axes(self) -> np.ndarray:
        """Directions right, down, forward: rows (3, 3)."""
        forward = unit(np.subtract(self.target, self.eye))
        right = unit(np.cross(forward, (0.0, 0.0, 1.0)))
        return np.array([right, np.cross(forward, right), forward])

    @property
    def sun(self) -> np.ndarray:
        """Direction (3,) towards the sun, which is behind the viewer."""
        azimuth = np.arctan2(self.eye[1] - self.target[1], self.eye[0] - self.target[0]) - SUN_LEFT
        across = np.cos(SUN_ELEVATION)
        return np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(SUN_ELEVATION)])

    def screen(self, points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Points (..., 3) [m] as (column, row [pixels], depth [m]) in a picture of (rows, columns)."""
        right, down, depth = np.moveaxis((points - self.eye) @ self.axes.T, -1, 0)
        scale = 0.5 * shape[0] / np.tan(0.5 * self.height_angle) / np.maximum(depth, NEAR)
        return np.stack(
            [scale * right + 0.5 * shape[1], scale * down + 0.5 * shape[0], depth], axis=-1
        )

    def rays(self, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Directions (k, 3) through pixels; a point at depth d is eye + d * ray."""
        scale = 2.0 * np.tan(0.5 * self.height_angle) / shape[0]
        seen = [
            scale * (columns - 0.5 * shape[1]),
            scale * (rows - 0.5 * shape[0]),
            np.ones(len(rows)),
        ]
        return np.stack(seen, axis=1) @ self.axes


@dataclass(frozen=True, eq=False)
class View:
    """The pixels in which a mesh is seen."""

    rows: np.ndarray  # (k,)
    columns: np.ndarray  # (k,)
    face: np.ndarray  # (k,), the triangle seen
    depth: np.ndarray  # (k,) [m] along the picture's axis
    normals: np.ndarray  # (k, 3), length 1


def rasterise(mesh: Mesh, viewpoint: Viewpoint, shape: tuple[int, int]) -> View:
    """The pixels of a picture of (rows, columns) in which a mesh is seen;
    the nearest triangle counts.
    """
    screen = viewpoint.screen(mesh.corners, shape)
    # linear across a triangle on the screen, unlike depth
    nearness = 1.0 / np.maximum(screen[..., 2], NEAR)
    weights, area = _corner_weights(screen[..., :2])
    planes = (nearness[..., None] * weights).sum(axis=1)
    low = np.maximum(np.ceil(screen[..., :2].min(axis=1)), 0).astype(int)
    high = np.minimum(np.floor(screen[..., :2].max(axis=1)) + 1, shape[::-1]).astype(int)
    drawn = (area < 0.0) & (low < high).all(axis=1) & (screen[..., 2] > NEAR).all(axis=1)
    face, nearest = np.full(shape, -1), np.zeros(shape)
    edges, width = np.concatenate([planes[:, None], weights], axis=1), (high - low).max(axis=1)
    for least, most in pairwise(SMALL):
        faces = np.flatnonzero(drawn & (least < width) & (width <= most))
        for part in np.array_split(faces, 1 + len(faces) * most**2 // AT_ONCE):
            _fill_small(face, nearest, part, edges[part], low[part], high[part], most)
    row, column = np.arange(shape[0])[:, None], np.arange(shape[1])
    for f in np.flatnonzero(drawn & (width > SMALL[-1])):
        block = slice(low[f, 1], high[f, 1]), slice(low[f, 0], high[f, 0])
        y, x = row[block[0]], column[block[1]]
        here = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2]
        inside = (here > nearest[block]) | ((here == nearest[block]) & (f < face[block]))
        for a, b, c in weights[f]:
            inside &= a * x + b * y + c >= 0.0
        nearest[block][inside] = here[inside]
        face[block][inside] = f
    rows, columns = np.nonzero(face >= 0)
    seen = face[rows, columns]
    pixel = np.stack([columns, rows, np.ones(len(rows))], axis=1)
    normals = np.zeros_like(pixel)
    for k in range(3):
        normals += (weights[seen, k] * pixel).sum(axis=1, keepdims=True) * mesh.normals[seen, k]
    return View(rows, columns, seen, 1.0 / nearest[rows, columns], unit(normals))


def _fill_small(
    face: np.ndarray,
    nearest: np.ndarray,
    faces: np.ndarray,
    edges: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    side: int,
) -> None:
    """Draw many small triangles at once, as `rasterise` draws one; of equally near ones the first
    counts.

    face, nearest: (rows, columns), changed. faces: their numbers (k,). edges: (k, 4, 3), nearness
        and corner weights of a pixel (x, y, 1). low, high: (k, 2), first pixel of each and the one
        after its last, at most side away.
    """
    x, y = low[:, 0, None, None] + np.arange(side), low[:, 1, None, None] + np.arange(side)[:, None]
    a, b, c = (edges[..., k, None, None] for k in range(3))
    seen = (x < high[:, 0, None, None]) & (y < high[:, 1, None, None])
    for k in range(1, edges.shape[1]):
        seen &= a[:, k] * x + b[:, k] * y + c[:, k] >= 0.0
    here = (a[:, 0] * x + b[:, 0] * y + c[:, 0])[seen]
    pixel, f = (y * face.shape[1] + x)[seen], faces[np.nonzero(seen)[0]]
    flat_face, flat_nearest = face.reshape(-1), nearest.reshape(-1)
    before = flat_nearest[pixel]
    np.maximum.at(flat_nearest, pixel, here)
    wins = (here == flat_nearest[pixel]) & ((here > before) | (f < flat_face[pixel]))
    flat_face[pixel[wins][::-1]] = f[wins][::-1]  # of what is assigned twice the last stays


def _corner_weights(screen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric coordinates of triangles (f, 3, 2): corner k's is [:, k] @ (x, y, 1);
    signed areas (f,).
    """
    (x1, x2), (y1, y2) = (
        [np.roll(screen[..., axis], -s, axis=1) for s in (1, 2)] for axis in (0, 1)
    )
    rows = np.stack([y1 - y2, x2 - x1, x1 * y2 - x2 * y1], axis=-1)
    area = rows[..., 2].sum(axis=1)
    return rows / np.where(np.abs(area) > 1e-9, area, np.inf)[:, None, None], area
