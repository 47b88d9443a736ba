"""Where to take a picture from, so that a motion fills it and little stands in front of it."""

import math
from collections.abc import Sequence

import numpy as np

from cvqmpt_lab.show.meshes import Mesh, joined
from cvqmpt_lab.show.rasteriser import Viewpoint, rasterise

AZIMUTHS = (-132.0, -165.0, -95.0, 160.0, 125.0, -60.0, 90.0, -25.0, 55.0, 15.0)
"""Directions from the motion to the eye [deg], those that suit a robot that faces +x first."""
ENOUGH = 0.8  # share of the motion that must be seen for other directions not to be looked at
ELEVATION = 24.0  # [deg] of the eye above the motion
HEIGHT_ANGLE = 0.64  # [rad]
CONTEXT = 1.3  # the eye stands this much farther off than the motion alone needs
GAIN = 0.05  # share of the motion that another direction must show more to be taken instead
LOOK_ROWS = 64  # [pixels] of the small pictures in which directions are compared


def clear_viewpoint(parts: Sequence[Mesh], scene: Sequence[Mesh], size: tuple[int, int]) -> Viewpoint:
    """A viewpoint for a picture of (width, height) pixels from which most of each part of a motion is seen.

    parts: what is to be seen; one hides those after it.
    """
    scene = [joined(scene)] if scene else []
    shape = (LOOK_ROWS, round(LOOK_ROWS * size[0] / size[1]))
    points = np.concatenate([part.corners.reshape(-1, 3) for part in parts])
    best, best_share = framed(points, AZIMUTHS[0], size), -1.0
    for azimuth in AZIMUTHS:
        viewpoint = framed(points, azimuth, size)
        share = _share_seen(parts, scene, viewpoint, shape)
        if share > best_share + GAIN:
            best, best_share = viewpoint, share
        if share > ENOUGH:
            break
    return best


def framed(points: np.ndarray, azimuth: float, size: tuple[int, int]) -> Viewpoint:
    """The viewpoint at an azimuth [deg] whose picture of (width, height) pixels holds points (m, 3) [m]."""
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    turn, rise = math.radians(azimuth), math.radians(ELEVATION)
    towards_eye = np.array([math.cos(rise) * math.cos(turn), math.cos(rise) * math.sin(turn), math.sin(rise)])
    far = Viewpoint(tuple(target + towards_eye), tuple(target), HEIGHT_ANGLE)
    right, down, ahead = far.axes @ (points - target).T
    tall = math.tan(0.5 * HEIGHT_ANGLE)
    distance = np.max(np.maximum(np.abs(down) / tall, np.abs(right) * size[1] / (tall * size[0])) - ahead)
    return Viewpoint(tuple(target + CONTEXT * distance * towards_eye), tuple(target), HEIGHT_ANGLE)


def _share_seen(
    parts: Sequence[Mesh], scene: Sequence[Mesh], viewpoint: Viewpoint, shape: tuple[int, int]
) -> float:
    """Mean over the parts of the share that is not behind the scene or an earlier part."""
    depth, shares = np.full(shape, np.inf), []
    for mesh in (*scene, *parts):
        view = rasterise(mesh, viewpoint, shape)
        nearer = view.depth < depth[view.rows, view.columns]
        depth[view.rows[nearer], view.columns[nearer]] = view.depth[nearer]
        shares.append(float(nearer.mean()) if len(nearer) else 1.0)
    return float(np.mean(shares[len(scene) :]))
