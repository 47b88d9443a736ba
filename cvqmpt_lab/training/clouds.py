"""Point clouds of shapes, new every epoch: surface points, or by noisy cameras as in evaluation."""

from dataclasses import dataclass, field

import numpy as np

from cvqmpt_lab.sensing.camera import (
    Camera,
    DepthNoise,
    Intrinsics,
    ball,
    cuboid,
    cylinder,
    drawn_materials,
    look_at,
    measured,
    view_of,
)
from cvqmpt_lab.sensing.crop import Crop
from cvqmpt_lab.training.dataset import Shapes
from cvqmpt_lab.vqmpt.config import Size


@dataclass(frozen=True, kw_only=True)
class CloudSettings:
    """How clouds are sampled."""

    points: Size = 1024
    crop: Crop = field(default_factory=Crop)
    noise: float = 0.003  # standard deviation of every coordinate [m]
    occlusion: float = 0.5  # probability that only surfaces facing one of the cameras are seen
    cameras: Size = 4  # random ones, at most
    density: float = 0.3  # standard deviation of the logarithm of each shape's density of points
    measured: float = 0.0  # probability of depth images with the cameras' errors, without `noise`

    def without_augmentation(self) -> "CloudSettings":
        """Uniform by area, no noise, nothing hidden: for validation."""
        return CloudSettings(
            points=self.points, crop=self.crop, noise=0.0, occlusion=0.0, density=0.0
        )


def sample_cloud(shapes: Shapes, settings: CloudSettings, rng: np.random.Generator) -> np.ndarray:
    """Points (settings.points, 3) float32 [m] on surfaces of shapes, outside others, in the crop.

    Few points are repeated; in an empty scene they lie below the robot, at the crop's lower end.
    """
    by_cameras = settings.measured > 0.0 and rng.random() < settings.measured
    if by_cameras:
        places, target = _camera_positions(settings, rng), np.array(settings.crop.centre)
        points = measured_points(shapes, places, target, rng)
        points = points[settings.crop.contains(points)][: settings.points]
    else:
        points = _drawn(shapes, settings, rng)
    if len(points) == 0:
        (x, y, z), crop = settings.crop.centre, settings.crop
        lowest = (x, y, z - crop.radius) if crop.kind == "ball" else (0.0, 0.0, crop.lower[2])
        points = np.array([lowest], dtype=np.float32)
    if len(points) < settings.points:
        points = points[np.arange(settings.points) % len(points)]
    if settings.noise > 0.0 and not by_cameras:
        points = points + np.float32(settings.noise) * rng.standard_normal(
            points.shape, dtype=np.float32
        )
    return points


def _drawn(shapes: Shapes, settings: CloudSettings, rng: np.random.Generator) -> np.ndarray:
    """Points (k, 3) drawn on surfaces: settings.points, or as many as can be found."""
    found = [np.empty((0, 3), dtype=np.float32)]
    missing = settings.points
    if len(shapes.kind):
        density = np.exp(settings.density * rng.standard_normal(len(shapes.kind)))
        weights = _areas(shapes) * density
        hides = rng.random() < settings.occlusion
        # drawn in any case
        places = _camera_positions(settings, rng)
        cameras, chance = (places, 0.5) if hides else (None, 0.7)
        for _ in range(6):
            draw = min(int(missing / chance * 1.15) + 16, 20 * settings.points)
            seen = _visible_points(shapes, weights, cameras, settings.crop, draw, rng)
            found.append(seen[:missing])
            missing -= len(found[-1])
            if missing == 0:
                break
            chance = max(0.05, len(seen) / draw)
    return np.concatenate(found)


def measured_points(
    shapes: Shapes, places: np.ndarray, target: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Points that depth cameras measure, in random order.

    Args:
        shapes: of the scene.
        places: (c, 3) [m], where cameras stand.
        target: (3,) [m], what they look at.
        rng: draws materials and noise.

    Returns:
        (k, 3) float32 [m].
    """
    described = zip(shapes.kind, shapes.size.astype(float), shapes.pose.astype(float), strict=True)
    solid_of = (  # by the kind of a shape
        lambda T, size: cuboid(T, 0.5 * size),
        lambda T, size: cylinder(T, size[0], 0.5 * size[2]),
        lambda T, size: ball(T, size[0]),
    )
    solids = [solid_of[kind](T, size) for kind, size, T in described]
    # the evaluation camera's range, a sixteenth of its pixels: still more than a cloud's points
    small = Intrinsics.from_fov(width=80, height=72, vertical_fov=75.0, near=0.5, far=5.46)
    materials = drawn_materials(len(solids), rng)
    views = [view_of(solids, Camera(small, look_at(place, target))) for place in places]
    points = np.concatenate(
        [measured(v, solids, materials, DepthNoise(), rng).points for v in views]
    )
    return points[rng.permutation(len(points))].astype(np.float32)


def _areas(shapes: Shapes) -> np.ndarray:
    """Surface area of each shape (m,) [m^2]."""
    x, y, z = shapes.size.T.astype(np.float64)
    box = 2.0 * (x * y + y * z + z * x)
    cylinder = 2.0 * np.pi * x * (x + z)
    sphere = 4.0 * np.pi * x * x
    return np.choose(shapes.kind, (box, cylinder, sphere))


def _camera_positions(settings: CloudSettings, rng: np.random.Generator) -> np.ndarray:
    """Camera positions (c, 3) [m]: 2 m from the crop's centre, not below it."""
    directions = rng.standard_normal((int(rng.integers(1, settings.cameras + 1)), 3))
    directions[:, 2] = np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return (np.array(settings.crop.centre) + 2.0 * directions).astype(np.float32)


def _visible_points(
    shapes: Shapes,
    weights: np.ndarray,
    cameras: np.ndarray | None,
    crop: Crop,
    draw: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """The visible ones of `draw` surface points, (k, 3) float32."""
    cumulated = np.cumsum(weights)
    shape = np.searchsorted(cumulated, rng.random(draw) * cumulated[-1], side="right")
    shape = np.minimum(shape, len(shapes.kind) - 1)
    local, normal = _surface(shapes.kind.take(shape), shapes.size.take(shape, axis=0), rng)
    of_point = shapes.pose.reshape(-1, 12).take(shape, axis=0).reshape(-1, 3, 4)
    rotation = of_point[:, :, :3]
    points = np.einsum("pij,pj->pi", rotation, local) + of_point[:, :, 3]
    kept = np.flatnonzero(crop.contains(points))
    points, shape = points[kept], shape[kept]
    if cameras is not None:
        normals = np.einsum("pij,pj->pi", rotation[kept], normal[kept])
        towards = normals @ cameras.T - (normals * points).sum(1)[:, None]
        faces = (towards > 0.0).any(1)
        points, shape = points[faces], shape[faces]
    return points[~_inside_others(points, shape, shapes)]


def _surface(
    kind: np.ndarray, size: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Uniform points on surfaces of shapes (p,), in their frames, and outward normals, float32."""
    local, normal = np.zeros((2, len(kind), 3), dtype=np.float32)
    for number, sampler in enumerate((_on_boxes, _on_cylinders, _on_spheres)):
        rows = np.flatnonzero(kind == number)
        if len(rows):
            local[rows], normal[rows] = sampler(size[rows], rng)
    return local, normal


def _on_boxes(size: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    rows = np.arange(len(size))
    x, y, z = size.T
    yz, zx = y * z, z * x
    threshold = rng.random(len(size), dtype=np.float32) * (yz + zx + x * y)
    axis = (threshold >= yz).astype(np.int64) + (threshold >= yz + zx)
    sign = rng.integers(0, 2, len(size)).astype(np.float32) * 2.0 - 1.0
    local = (rng.random((len(size), 3), dtype=np.float32) - 0.5) * size
    local[rows, axis] = 0.5 * sign * size[rows, axis]
    normal = np.zeros_like(local)
    normal[rows, axis] = sign
    return local, normal


def _on_cylinders(size: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    radius, height = size[:, 0], size[:, 2]
    angle = 2.0 * np.pi * rng.random(len(size), dtype=np.float32)
    # caps against side, over 2 pi r
    place = rng.random(len(size), dtype=np.float32) * (radius + height)
    on_cap = place < radius
    sign = rng.integers(0, 2, len(size)).astype(np.float32) * 2.0 - 1.0
    share = rng.random(len(size), dtype=np.float32)
    distance = radius * np.where(on_cap, np.sqrt(share), 1.0)
    z = np.where(on_cap, 0.5 * sign, share - 0.5) * height
    cosine, sine = np.cos(angle), np.sin(angle)
    local = np.stack((distance * cosine, distance * sine, z), axis=1)
    flat = np.stack((np.zeros_like(z), np.zeros_like(z), sign), axis=1)
    round_ = np.stack((cosine, sine, np.zeros_like(z)), axis=1)
    return local, np.where(on_cap[:, None], flat, round_)


def _on_spheres(size: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    normal = rng.standard_normal((len(size), 3), dtype=np.float32)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    return normal * size[:, :1], normal


def _inside_others(
    points: np.ndarray, own: np.ndarray, shapes: Shapes, margin: float = 1e-4
) -> np.ndarray:
    """Whether each point (p, 3) of shape `own` (p,) lies deeper than `margin` in another shape."""
    rotation = shapes.pose[:, :, :3]
    # local = R^T (x - t), all shapes at once
    origin = np.einsum("mij,mi->mj", rotation, shapes.pose[:, :, 3])
    inverse = np.ascontiguousarray(rotation.transpose(0, 2, 1)).reshape(-1, 3)
    local = (inverse @ np.ascontiguousarray(points.T)).reshape(len(rotation), 3, -1)
    local -= origin[:, :, None]
    half = 0.5 * shapes.size[:, :, None] - np.float32(margin)
    within = np.abs(local) < half
    squares = local * local
    disc = squares[:, 0] + squares[:, 1]
    radius = np.maximum(shapes.size[:, :1] - np.float32(margin), 0.0) ** 2
    box, cylinder = within.all(axis=1), (disc < radius) & within[:, 2]
    inside = np.choose(shapes.kind[:, None], (box, cylinder, disc + squares[:, 2] < radius))
    inside[own, np.arange(len(points))] = False
    return np.any(inside, axis=0)
