"""Units of users' scenes: refuse what cannot be metres, report a scene out of the arm's reach."""

import logging
import math

import numpy as np

from cvqmpt_lab.errors import InvalidInputError, at
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Measured, bounding_radius

_log = logging.getLogger("cvqmpt")


def refuse_far_poses(poses: dict[str, np.ndarray], farthest: float = 100.0) -> None:
    """Refuse a pose (4, 4) over `farthest` [m] from the world's origin, by its place in a file."""
    for where, T in poses.items():
        _refuse_above(farthest, float(np.abs(T[:3, 3]).max()), f"{where} is", "off")


def _refuse_above(most: float, length: float, what: str, how: str) -> None:
    if length > most:
        raise InvalidInputError(
            f"{what} {length:.4g} m {how}, more than {most:g}: no metres? Give metres"
        )


def refuse_far(
    scene: Scene, where: str = "scene", farthest: float = 100.0, largest: float = 250.0
) -> None:
    """Refuse an obstacle larger than `largest`, or more than `farthest` off the origin [m].

    Floors of 200 m are drawn.
    """
    for k, item in enumerate(scene.objects):
        if not item.obstacle or isinstance(item.shape, Measured):
            continue
        lengths: tuple[float, ...] = ()
        if not isinstance(item.shape, ConvexMesh):
            lengths = tuple(np.ravel([*vars(item.shape).values()]).tolist())
        name = f"{at(where, f'objects[{k}], {item.name!r},')} is"
        _refuse_above(largest, max(lengths, default=0.0), name, "large")
        _refuse_above(farthest, distance(item), name, "off")


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
