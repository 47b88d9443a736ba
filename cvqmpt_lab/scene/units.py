"""Units of users' scenes: refuse what cannot be metres, report a scene out of the arm's reach."""

import logging
import math

import numpy as np

from cvqmpt_lab.errors import InvalidInputError, at
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder, Measured, Sphere, bounding_radius

FARTHEST = 100.0  # [m] of a pose or an obstacle from the arm
LARGEST = 250.0  # [m] of an obstacle; floors of 200 m are drawn
_log = logging.getLogger("cvqmpt")


def refuse_far_poses(poses: dict[str, np.ndarray]) -> None:
    """Refuse a pose (4, 4) over FARTHEST from the world's origin, by its place in the file."""
    for where, T in poses.items():
        if (off := float(np.abs(T[:3, 3]).max())) > FARTHEST:
            raise InvalidInputError(
                f"{where} is {off:.4g} m off, more than {FARTHEST:g}: no metres? Give metres"
            )


def refuse_far(scene: Scene, where: str = "scene") -> None:
    """Refuse an obstacle larger than LARGEST, or more than FARTHEST off the world's origin."""
    for k, item in enumerate(scene.objects):
        if not item.obstacle or isinstance(item.shape, Measured):
            continue
        match item.shape:
            case Box(size):
                lengths: tuple[float, ...] = size
            case Cylinder(radius, height):
                lengths = radius, height
            case Sphere(radius):
                lengths = (radius,)
            case _:
                lengths = ()
        name = at(where, f"objects[{k}], {item.name!r},")
        if (most := max(lengths, default=0.0)) > LARGEST:
            raise InvalidInputError(
                f"{name} is {most:.4g} m large, more than {LARGEST:g}: no metres? Give metres"
            )
        if (off := distance(item)) > FARTHEST:
            raise InvalidInputError(
                f"{name} is {off:.4g} m off, more than {FARTHEST:g}: no metres? Give metres"
            )


def distance(item: SceneObject) -> float:
    """Distance [m] of an obstacle from the world's origin; exact for a box, else a lower bound."""
    if isinstance(item.shape, Box):
        T = item.T_world_object
        origin = (T[:3, 3] @ T[:3, :3]).tolist()  # of the world, mirrored, in the box's frame
        return math.hypot(
            *(
                max(abs(x) - 0.5 * size, 0.0)
                for x, size in zip(origin, item.shape.size, strict=True)
            )
        )
    return max(
        math.dist(item.T_world_object[:3, 3], (0.0, 0.0, 0.0)) - bounding_radius(item.shape), 0.0
    )


def report_out_of_reach(scene: Scene, reach: float) -> None:
    """Log a warning if a scene has obstacles and the arm of `reach` [m] can touch none of them."""
    gaps = {item.name: distance(item) for item in scene.obstacles}
    if gaps and min(gaps.values()) > reach:
        name = min(gaps, key=lambda name: gaps[name])
        _log.warning(
            "scene %r: the arm can touch nothing of it: %r is nearest, %.3g m off, and the arm "
            "reaches %.3g m; no metres, or in another frame than the robot's base?",
            scene.name,
            name,
            gaps[name],
            reach,
        )
