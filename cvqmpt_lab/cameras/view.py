"""What a camera sees of solids, without any error: depths, and which solid at every pixel.

Surfaces are seen from outside only. What a camera stands in, and what lies nearer than its near plane, it looks
through, as a renderer that leaves out back faces does: the two lower cameras of the published set-up stand
below the floor and see the kitchen all the same.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.cameras.camera import DepthCamera, Lens
from cvqmpt_lab.cameras.solids import Solid

NOTHING = -1
"""In the place of a solid's index."""
_AHEAD = 1e-3
"""Corners must lie this far ahead of a camera for their rectangle in the image to be known [m]."""


@dataclass(frozen=True, eq=False)
class View:
    """A picture of solids."""

    camera: DepthCamera
    """From where."""
    lens: Lens
    """With what optics."""
    depth: np.ndarray
    """(height, width) [m], along the camera's axis at the centre of each pixel; inf where it sees nothing."""
    solid: np.ndarray
    """(height, width) int, index of the solid that is seen; `NOTHING` where none is."""

    @property
    def points(self) -> np.ndarray:
        """(m, 3), of all pixels that see something [m]."""
        return points_of(self.depth, self.camera, self.lens)


def points_of(depth: np.ndarray, camera: DepthCamera, lens: Lens) -> np.ndarray:
    """Points (m, 3) [m, world] of the pixels of a depth image (height, width) [m] that see something."""
    hit = np.isfinite(depth)
    return np.array(camera.eye) + depth[hit][:, None] * lens.rays(camera)[hit]


def view_of(solids: Sequence[Solid], camera: DepthCamera, lens: Lens) -> View:
    """Cast a ray through every pixel."""
    rays = lens.rays(camera)
    depth = np.full(rays.shape[:2], np.inf)
    nearest = np.full(rays.shape[:2], NOTHING)
    for index, item in enumerate(solids):
        T = item.T_world_solid
        for window in _windows(item, camera, lens):
            eye = (np.array(camera.eye) - T[:3, 3]) @ T[:3, :3]
            with np.errstate(divide="ignore", invalid="ignore"):
                enter, leave = item.interval(eye, rays[window] @ T[:3, :3])
            seen = (enter <= leave) & (enter >= lens.near) & (enter <= lens.far) & (enter < depth[window])
            depth[window][seen], nearest[window][seen] = enter[seen], index
    return View(camera, lens, depth, nearest)


def incidence(view: View, solids: Sequence[Solid]) -> np.ndarray:
    """Cosine (height, width) of the angle between each pixel's ray and the surface's normal; 0 where nothing is."""
    rays = view.lens.rays(view.camera)
    cosine = np.zeros(view.depth.shape)
    for index in np.unique(view.solid[view.solid != NOTHING]):
        T, here = solids[index].T_world_solid, view.solid == index
        towards = -rays[here]
        points = view.camera.eye - view.depth[here][:, None] * towards
        normals = solids[index].normals((points - T[:3, 3]) @ T[:3, :3]) @ T[:3, :3].T
        cosine[here] = np.einsum("pi,pi->p", normals, towards) / np.linalg.norm(towards, axis=1)
    return np.clip(cosine, 0.0, 1.0)


def _windows(item: Solid, camera: DepthCamera, lens: Lens) -> Iterator[tuple[slice, slice]]:
    """The rectangle of the image that a solid can be seen in, or none."""
    T = item.T_world_solid
    corners = item.corners @ T[:3, :3].T + T[:3, 3]
    right, up, ahead = camera.axes @ (corners - camera.eye).T
    if ahead.max() < lens.near or ahead.min() > lens.far:
        return
    if ahead.min() < _AHEAD:
        yield slice(0, lens.height), slice(0, lens.width)
        return
    wide, tall = lens.extent
    columns = 0.5 * lens.width * (1.0 + right / ahead / wide)
    rows = 0.5 * lens.height * (1.0 - up / ahead / tall)
    window = _pixels(rows, lens.height), _pixels(columns, lens.width)
    if all(span.start < span.stop for span in window):
        yield window


def _pixels(places: np.ndarray, count: int) -> slice:
    """Pixels of `count` in a row whose centres may lie between the least and the largest of some places."""
    return slice(max(0, math.floor(places.min() - 0.5)), min(count, math.ceil(places.max() + 0.5)))
