"""A still picture of a solution, drawn by a small z-buffer rasteriser: no display or graphics library needed.

Everything drawn is triangles. The solid layer (scene, robot at the start) gets outlines and shadows; ghosts
of the robot along the path and at the goal, and the hand's trace, are blended over it.
"""

import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.manifold.kinematics import link_poses
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.hulls import prism_vertices
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import SceneObject, pose
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Shape, Sphere, shape_vertices

Colour = tuple[float, float, float]

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
"""Colour of the scene objects whose name contains a word; the first that fits counts."""
OTHER_COLOUR: Colour = (0.87, 0.77, 0.62)
ROBOT_COLOUR: Colour = (0.90, 0.90, 0.92)
GHOST_COLOUR: Colour = (0.25, 0.50, 0.90)
GOAL_COLOUR: Colour = (0.16, 0.68, 0.38)
LOAD_COLOUR: Colour = (0.86, 0.24, 0.20)
TRACE_COLOUR: Colour = (0.96, 0.55, 0.05)

BEAD_RADIUS, BEAD_SPACING = 0.008, 0.012  # [m] of the hand's trace
SMOOTH = np.cos(0.7)  # facets of a hull that meet at less than 0.7 rad are shaded as one curved surface
SUPERSAMPLING = 2
NEAR = 0.05  # [m] triangles closer to the camera than this are left out
LIGHT = np.array([-0.62, -0.42, 0.66])  # direction towards the sun, length 1
SUN_DISTANCE, SUN_ANGLE = 40.0, 0.13  # [m], [rad]: a far camera whose view is the shadow map
SHADOW_PIXELS, SHADOW_BIAS = (
    1536,
    0.025,
)  # largest map; a surface shadows only what lies this far behind it [m]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera at `eye` that looks at `target` [m], z up; height_angle is its vertical view [rad]."""

    eye: tuple[float, float, float] = (-1.7, -2.0, 1.75)
    target: tuple[float, float, float] = (0.4, -0.1, 0.5)
    height_angle: float = 0.64

    @property
    def axes(self) -> np.ndarray:
        """Directions right, down, forward: rows (3, 3)."""
        forward = _unit(np.subtract(self.target, self.eye))
        right = _unit(np.cross(forward, (0.0, 0.0, 1.0)))
        return np.array([right, np.cross(forward, right), forward])

    def screen(self, points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Points (..., 3) [m] as (column, row [pixels], depth [m]) in a picture of (rows, columns)."""
        right, down, depth = np.moveaxis((points - self.eye) @ self.axes.T, -1, 0)
        scale = 0.5 * shape[0] / np.tan(0.5 * self.height_angle) / np.maximum(depth, NEAR)
        return np.stack([scale * right + 0.5 * shape[1], scale * down + 0.5 * shape[0], depth], axis=-1)

    def rays(self, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Directions (k, 3) through pixels; a point at depth d is eye + d * ray."""
        scale = 2.0 * np.tan(0.5 * self.height_angle) / shape[0]
        seen = [scale * (columns - 0.5 * shape[1]), scale * (rows - 0.5 * shape[0]), np.ones(len(rows))]
        return np.stack(seen, axis=1) @ self.axes


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, anticlockwise from outside: corners, normals (f, 3, 3), colours (f, 3), piece (f,)."""

    corners: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    piece: np.ndarray

    def placed(self, T: np.ndarray, colour: Colour) -> "Mesh":
        """The same triangles moved by T (4, 4), in one colour."""
        turn = T[:3, :3].T
        return Mesh(
            self.corners @ turn + T[:3, 3], self.normals @ turn, 0 * self.colours + colour, self.piece
        )


@dataclass(frozen=True, eq=False)
class View:
    """Pixels (k,) where a mesh is seen, and for each: triangle, depth [m], unit normal (k, 3)."""

    rows: np.ndarray
    columns: np.ndarray
    face: np.ndarray
    depth: np.ndarray
    normals: np.ndarray


def draw_solution(
    solution: Solution,
    path: Path,
    size: tuple[int, int] = (1200, 800),
    ghosts: int = 4,
    camera: Camera | None = None,
    hidden: Sequence[str] = ("walls/right",),
) -> None:
    """Write a PNG of scene, robot at the start, ghosts along the path and at the goal, and the hand's trace.

    Parameters
    ----------
    size: width and height [pixels].
    ghosts: number of poses shown between start and goal.
    hidden: names of scene objects left out because they stand in the way.

    Raises
    ------
    InvalidInputError: a size without pixels, or a path that cannot be written.
    """
    if min(size) < 1:
        raise InvalidInputError(f"picture size {size} must be at least 1 x 1 pixels")
    problem, camera = solution.problem, camera or Camera()
    shape = (SUPERSAMPLING * size[1], SUPERSAMPLING * size[0])
    image, depth = _still(problem, problem.start, camera, shape, hidden)
    for mesh, opacity, opacity_behind in _translucent(solution, ghosts):
        view = rasterise(mesh, camera, shape)
        at = view.rows, view.columns
        share = np.where(view.depth < depth[at] - 1e-3, opacity, opacity_behind)[:, None]
        image[at] += share * (_light(mesh.colours[view.face], view.normals) - image[at])
    write_png(Path(path), _eight_bit(image))


def still_image(
    problem: PlanningProblem,
    q: np.ndarray,
    size: tuple[int, int] = (900, 600),
    camera: Camera | None = None,
    hidden: Sequence[str] = ("walls/right",),
) -> np.ndarray:
    """Colours (height, width, 3), 8 bit, of the scene and the robot at q (n,); what figures are drawn over.

    `Camera.screen` says where in it a point is.
    """
    shape = (SUPERSAMPLING * size[1], SUPERSAMPLING * size[0])
    return _eight_bit(_still(problem, q, camera or Camera(), shape, hidden)[0])


def _still(
    problem: PlanningProblem, q: np.ndarray, camera: Camera, shape: tuple[int, int], hidden: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (rows, columns, 3) and depth [m] of scene and robot."""
    solid = joined([*_scene_meshes(problem, hidden), *robot_meshes(problem, q, ROBOT_COLOUR)])
    return _solid_image(solid, _ground_height(problem), camera, shape)


def _eight_bit(image: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] at SUPERSAMPLING times the size as 8-bit colours of the picture."""
    rows, columns = (side // SUPERSAMPLING for side in image.shape[:2])
    smaller = image.reshape(rows, SUPERSAMPLING, columns, SUPERSAMPLING, 3).mean(axis=(1, 3))
    return (255.0 * np.clip(smaller, 0.0, 1.0) + 0.5).astype(np.uint8)


# What is drawn


def colour_of(name: str) -> Colour:
    """Colour of a scene object, by the kind its name tells."""
    return next((colour for word, colour in KIND_COLOURS.items() if word in name), OTHER_COLOUR)


def is_ground(item: SceneObject) -> bool:
    """Whether an object is a floor: a box, not an obstacle, of which only the top is worth showing."""
    return isinstance(item.shape, Box) and not item.obstacle


def poses_along(robot: Robot, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T_world_link (m, n + 1, 4, 4), row 0 the world, and T_world_hand (m, 4, 4) at configurations (m, n)."""
    rotations, translations = link_poses(robot.kinematics, np.ascontiguousarray(states, dtype=float))
    T_world_link = np.zeros((*translations.shape[:2], 4, 4))
    T_world_link[..., :3, :3], T_world_link[..., :3, 3] = rotations, translations
    T_world_link[..., 3, 3] = 1.0
    link, T_link_hand = robot.end_effector_link
    return T_world_link, T_world_link[:, link] @ T_link_hand


def hull_mesh(vertices: np.ndarray) -> Mesh:
    """The convex hull of vertices (n, 3)."""
    hull = ConvexHull(vertices)
    facing, faces = hull.equations[:, :3], hull.simplices
    twice_area = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    inwards = (twice_area * facing).sum(axis=1) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    weight = np.zeros((len(vertices), len(faces)))
    weight[faces, np.arange(len(faces))[:, None]] = np.linalg.norm(twice_area, axis=1)[:, None]
    normals = (weight[faces] * (facing @ facing.T > SMOOTH)[:, None]) @ facing
    return Mesh(vertices[faces], _unit(normals), np.ones((len(faces), 3)), np.zeros(len(faces), dtype=int))


def shape_mesh(shape: Shape) -> Mesh:
    """Triangles of any shape in its own frame; balls and cylinders are faceted."""
    match shape:
        case Cylinder(radius, height):
            return hull_mesh(prism_vertices(radius, 0.5 * height, sides=32))
        case Sphere(radius):
            return hull_mesh(radius * _sphere_points(200))
        case PointCloud(points, radius):
            ball = hull_mesh(radius * _sphere_points(12))
            return joined([ball.placed(pose(point), OTHER_COLOUR) for point in points])
        case Box() | ConvexMesh():
            return hull_mesh(shape_vertices(shape))


def joined(meshes: Iterable[Mesh]) -> Mesh:
    """One mesh of several, each a piece of its own."""
    meshes = list(meshes)
    corners, normals, colours = (
        np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in ("corners", "normals", "colours")
    )
    return Mesh(corners, normals, colours, np.repeat(np.arange(len(meshes)), [len(m.piece) for m in meshes]))


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


def _scene_meshes(problem: PlanningProblem, hidden: Sequence[str]) -> list[Mesh]:
    return [
        shape_mesh(item.shape).placed(item.T_world_object, colour_of(item.name))
        for item in problem.scene
        if item.name not in hidden and not is_ground(item)
    ]


def _ground_height(problem: PlanningProblem) -> float | None:
    """Top of the highest floor [m]; None without one."""
    tops = [
        item.T_world_object[2, 3] + 0.5 * item.shape.size[2]
        for item in problem.scene
        if isinstance(item.shape, Box) and is_ground(item)
    ]
    return max(tops, default=None)


def _translucent(solution: Solution, ghosts: int) -> Iterator[tuple[Mesh, float, float]]:
    """What is blended over the solid layer: (mesh, opacity, opacity behind something solid)."""
    problem = solution.problem
    if solution.simplified is None:
        for goal in problem.goals[:1]:
            yield joined(robot_meshes(problem, goal, GOAL_COLOUR)), 0.5, 0.0
        return
    states = solution.simplified.path.states
    travelled = _travelled(states)
    for k in range(1, ghosts + 1):
        between = states[np.searchsorted(travelled, travelled[-1] * k / (ghosts + 1))]
        yield joined(robot_meshes(problem, between, GHOST_COLOUR)), 0.25, 0.0
    yield joined(robot_meshes(problem, states[-1], GOAL_COLOUR)), 0.55, 0.0
    yield _beads(poses_along(problem.robot, states)[1][:, :3, 3], TRACE_COLOUR), 1.0, 0.45


def _beads(points: np.ndarray, colour: Colour) -> Mesh:
    """Balls at even distances along a curve given by points (m, 3)."""
    travelled = _travelled(points)
    at = np.linspace(0.0, travelled[-1], 1 + int(travelled[-1] / BEAD_SPACING))
    centres = np.stack([np.interp(at, travelled, points[:, axis]) for axis in range(3)], axis=1)
    ball = hull_mesh(BEAD_RADIUS * _sphere_points(24))
    return joined([ball.placed(pose(centre), colour) for centre in centres])


def _travelled(points: np.ndarray) -> np.ndarray:
    """Distance (m,) covered at each of the points (m, d)."""
    return np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]


def _sphere_points(count: int) -> np.ndarray:
    """Points (count, 3) spread evenly over the unit sphere (golden spiral)."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn, radius = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count), np.sqrt(1.0 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


# How it is drawn


def rasterise(mesh: Mesh, camera: Camera, shape: tuple[int, int]) -> View:
    """What a camera sees of a mesh in a picture of (rows, columns): the nearest outside at each pixel."""
    screen = camera.screen(mesh.corners, shape)
    nearness = 1.0 / np.maximum(screen[..., 2], NEAR)  # linear across a triangle on the screen, unlike depth
    weights, area = _corner_weights(screen[..., :2])
    planes = (nearness[..., None] * weights).sum(axis=1)
    low = np.maximum(np.ceil(screen[..., :2].min(axis=1)), 0).astype(int)
    high = np.minimum(np.floor(screen[..., :2].max(axis=1)) + 1, shape[::-1]).astype(int)
    drawn = (area < 0.0) & (low < high).all(axis=1) & (screen[..., 2] > NEAR).all(axis=1)
    face, nearest = np.full(shape, -1), np.zeros(shape)
    for f in np.flatnonzero(drawn):
        block = slice(low[f, 1], high[f, 1]), slice(low[f, 0], high[f, 0])
        y, x = np.ogrid[block]
        here = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2]
        inside = here > nearest[block]
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
    return View(rows, columns, seen, 1.0 / nearest[rows, columns], _unit(normals))


def _corner_weights(screen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric coordinates of triangles (f, 3, 2): corner k's is [:, k] @ (x, y, 1); signed areas (f,)."""
    (x1, x2), (y1, y2) = ([np.roll(screen[..., axis], -s, axis=1) for s in (1, 2)] for axis in (0, 1))
    rows = np.stack([y1 - y2, x2 - x1, x1 * y2 - x2 * y1], axis=-1)
    area = rows[..., 2].sum(axis=1)
    return rows / np.where(np.abs(area) > 1e-9, area, np.inf)[:, None, None], area


def _solid_image(
    mesh: Mesh, ground: float | None, camera: Camera, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (rows, columns, 3) and depth [m] of the mesh with shadows and outlines, over the ground."""
    lit = _shadows(mesh, min(SHADOW_PIXELS, 2 * max(shape)))
    view = rasterise(mesh, camera, shape)
    at = view.rows, view.columns
    image, depth, piece = np.ones((*shape, 3)), np.full(shape, np.inf), np.full(shape, -1)
    depth[at], piece[at] = view.depth, mesh.piece[view.face]
    points = camera.eye + view.depth[:, None] * camera.rays(*at, shape)
    image[at] = _light(mesh.colours[view.face], view.normals, lit(points))
    if ground is not None:
        _fill_ground(image, np.nonzero(piece < 0), ground, camera, lit)
    outline = np.zeros(shape, dtype=bool)
    outline[:, 1:] |= piece[:, 1:] != piece[:, :-1]
    outline[1:] |= piece[1:] != piece[:-1]
    image[outline] *= 0.55
    return image, depth


def _fill_ground(
    image: np.ndarray,
    empty: tuple[np.ndarray, ...],
    ground: float,
    camera: Camera,
    lit: Callable[[np.ndarray], np.ndarray],
) -> None:
    """Paint the plane z = ground [m] at empty pixels (rows, columns); it fades into white with distance."""
    rows, columns = empty
    rays = camera.rays(rows, columns, image.shape[:2])
    distance = (ground - camera.eye[2]) / np.where(rays[:, 2] == 0.0, np.inf, rays[:, 2])
    points = camera.eye + distance[:, None] * rays
    share = np.clip(1.6 - 0.4 * np.linalg.norm(points - camera.target, axis=1), 0.0, 1.0) * (distance > 0.0)
    colours = _light(np.array([colour_of("floor")]), np.array([[0.0, 0.0, 1.0]]), lit(points))
    image[rows, columns] += share[:, None] * (colours - 1.0)


def _shadows(mesh: Mesh, side: int) -> Callable[[np.ndarray], np.ndarray]:
    """A function from points (k, 3) to the share (k,) of sunlight that a mesh lets through; side: map size."""
    middle = 0.5 * (mesh.corners.min(axis=(0, 1)) + mesh.corners.max(axis=(0, 1)))
    sun = Camera(tuple(middle + SUN_DISTANCE * LIGHT), tuple(middle), SUN_ANGLE)
    shape = (side, side)
    view = rasterise(mesh, sun, shape)
    blocked = np.full(shape, np.inf)
    blocked[view.rows, view.columns] = view.depth + SHADOW_BIAS

    def lit(points: np.ndarray) -> np.ndarray:
        column, row, depth = np.moveaxis(sun.screen(points, shape), -1, 0)
        total = np.zeros(len(points))
        for i, j in np.ndindex(3, 3):
            at = tuple(np.clip((a + b - 0.5).astype(int), 0, side - 1) for a, b in ((row, i), (column, j)))
            total += depth < blocked[at]
        return total / 9.0

    return lit


def _light(colours: np.ndarray, normals: np.ndarray, lit: np.ndarray | float = 1.0) -> np.ndarray:
    """Colours (k, 3) under light from the sky and, to the share lit (k,), from the sun."""
    strength = 0.58 + 0.1 * normals[:, 2] + 0.46 * lit * np.maximum(normals @ LIGHT, 0.0)
    return colours * strength[:, None]


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) scaled to length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write 8-bit colours (rows, columns, 3)."""
    height, width, _ = image.shape
    change = np.diff(image, axis=0, prepend=np.uint8(0))  # PNG filter 2: less the row above, modulo 256
    lines = np.concatenate([np.full((height, 1), 2, np.uint8), change.reshape(height, -1)], axis=1)
    data = b"\x89PNG\r\n\x1a\n"
    for kind, body in (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(lines.tobytes(), 9)),
        (b"IEND", b""),
    ):
        data += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    temporary = path.with_name(path.name + ".tmp")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise InvalidInputError(
            f"cannot write picture {path}: {error.strerror}; name a file in a folder that exists"
        ) from error
