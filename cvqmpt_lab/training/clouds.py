"""Random point clouds of scenes: points on surfaces, or measured by cameras as in evaluation."""

from dataclasses import dataclass, field

import numpy as np

from cvqmpt_lab.sensing.camera import (
    Camera,
    DepthNoise,
    Intrinsics,
    Solid,
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
from cvqmpt_lab.vqmpt.config import NotNegative, Share, Size


@dataclass(frozen=True, kw_only=True)
class CloudSettings:
    """Settings for sampling clouds."""

    points: Size = 1024
    crop: Crop = field(default_factory=Crop)
    noise: NotNegative = 0.003  # standard deviation of every coordinate [m]
    occlusion: Share = 0.5  # probability that only surfaces facing a camera have points
    cameras: Size = 4  # maximum number of cameras at random places
    density: NotNegative = 0.3  # standard deviation of the logarithm of each shape's density
    measured: Share = 0.0  # probability that the cloud comes from depth images instead

    def without_augmentation(self) -> "CloudSettings":
        """Return settings for validation: uniform by area, without noise and hidden surfaces."""
        return CloudSettings(
            points=self.points, crop=self.crop, noise=0.0, occlusion=0.0, density=0.0
        )


def sample_cloud(shapes: Shapes, settings: CloudSettings, rng: np.random.Generator) -> np.ndarray:
    """Sample points (settings.points, 3) float32 [m] on surfaces of shapes, inside the crop.

    If there are too few points, they repeat. In an empty scene all points are the lowest point of
    the crop, below the robot.
    """
    crop = settings.crop
    by_cameras = settings.measured > 0.0 and rng.random() < settings.measured
    if by_cameras:
        positions = _camera_positions(settings, rng)
        points = measured_points(shapes, positions, np.array(crop.centre), rng)
        points = points[crop.contains(points)][: settings.points]
    else:
        points = _surface_points(shapes, settings, rng)
    if len(points) == 0:
        lowest = (0.0, 0.0, crop.lower[2])
        if crop.kind == "ball":
            x, y, z = crop.centre
            lowest = (x, y, z - crop.radius)
        points = np.array([lowest], dtype=np.float32)
    if len(points) < settings.points:
        points = points[np.arange(settings.points) % len(points)]
    if settings.noise > 0.0 and not by_cameras:
        points = points + np.float32(settings.noise) * rng.standard_normal(
            points.shape, dtype=np.float32
        )
    return points


def _surface_points(
    shapes: Shapes, settings: CloudSettings, rng: np.random.Generator
) -> np.ndarray:
    """Sample points on surfaces (k, 3); k is settings.points, or fewer if most are hidden."""
    found = [np.empty((0, 3), dtype=np.float32)]
    missing = settings.points
    if len(shapes.kind):
        density = np.exp(settings.density * rng.standard_normal(len(shapes.kind)))
        weights = _areas(shapes) * density
        hidden = rng.random() < settings.occlusion
        # positions are drawn in both cases, so that later random numbers are the same
        positions = _camera_positions(settings, rng)
        cameras, visible_share = (positions, 0.5) if hidden else (None, 0.7)
        for _ in range(6):
            draw = min(int(missing / visible_share * 1.15) + 16, 20 * settings.points)
            visible = _visible_points(shapes, weights, cameras, settings.crop, draw, rng)
            found.append(visible[:missing])
            missing -= len(found[-1])
            if missing == 0:
                break
            visible_share = max(0.05, len(visible) / draw)
    return np.concatenate(found)


def measured_points(
    shapes: Shapes, positions: np.ndarray, target: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Simulate the points that depth cameras measure, in random order.

    Args:
        shapes: shapes of the scene.
        positions: (c, 3) [m], positions of the cameras.
        target: (3,) [m], the point that all cameras face.
        rng: random numbers for materials and noise.

    Returns:
        (k, 3) float32 [m].
    """
    solids = [
        _solid(kind, size, T)
        for kind, size, T in zip(
            shapes.kind, shapes.size.astype(float), shapes.pose.astype(float), strict=True
        )
    ]
    # the evaluation camera with a sixteenth of its pixels, still more than a cloud's points
    small = Intrinsics.from_fov(width=80, height=72, vertical_fov=75.0, near=0.5, far=5.46)
    materials = drawn_materials(len(solids), rng)
    views = [view_of(solids, Camera(small, look_at(place, target))) for place in positions]
    points = np.concatenate(
        [measured(view, solids, materials, DepthNoise(), rng).points for view in views]
    )
    return points[rng.permutation(len(points))].astype(np.float32)


def _solid(kind: int, size: np.ndarray, T: np.ndarray) -> Solid:
    """Return the solid that cameras see, of a shape as in `Shapes`."""
    if kind == 0:
        return cuboid(T, 0.5 * size)
    if kind == 1:
        return cylinder(T, size[0], 0.5 * size[2])
    return ball(T, size[0])


def _areas(shapes: Shapes) -> np.ndarray:
    """Surface area of each shape (m,) [m^2]."""
    x, y, z = shapes.size.T.astype(np.float64)
    box = 2.0 * (x * y + y * z + z * x)
    cylinder = 2.0 * np.pi * x * (x + z)
    sphere = 4.0 * np.pi * x * x
    return np.choose(shapes.kind, (box, cylinder, sphere))


def _camera_positions(settings: CloudSettings, rng: np.random.Generator) -> np.ndarray:
    """Draw camera positions (c, 3) [m], 2 m from the crop's centre and not below it."""
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
    """Draw surface points and return the visible ones.

    Args:
        shapes: shapes of the scene.
        weights: (m,), share of the points on each shape, not normalised.
        cameras: (c, 3) [m]; points must lie on a surface that faces one of them; None for any.
        crop: points must lie inside this region.
        draw: number of points to draw.
        rng: random numbers.

    Returns:
        (k, 3) float32 [m].
    """
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
    """Draw a point on the surface of each shape (p,), uniform by area.

    Returns:
        Points (p, 3) [m] in the shapes' frames, and outward normals (p, 3), float32.
    """
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
    # areas of both caps and of the side, divided by 2 pi r, are r and h
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
    # local = R^T (x - t) for all shapes at once
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
