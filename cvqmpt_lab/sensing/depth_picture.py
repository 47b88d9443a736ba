"""A cloud as its camera saw it, in coarse pixels: which of some surface it confirms, hides, or looks through."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.sensing.arm_surface import Surface

PIXEL = 0.01
"""Edge of a pixel [tangent]: a few measured points in each."""
WIDEST = 0.2
"""Cosine of the angle from the middle of the cloud beyond which points are left out."""
FACING = 0.3
"""Least cosine between a sample's normal and its ray; others lie near outlines, where a pixel shows something else."""
OWN = 0.02
"""[m] samples this much behind others of the same surface in their pixel are hidden by them."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """What a picture says of k samples of a surface that could be seen if nothing hid them."""

    seen: np.ndarray
    """(k,) bool, towards the camera, where it measured something."""
    excess: FloatArray
    """(k,) [m], measured depth over that of the sample; positive where the camera looked through it."""


@dataclass(frozen=True, eq=False)
class DepthPicture:
    """Depths of a cloud around its middle."""

    turn: FloatArray
    """(3, 3), from the camera's frame to one whose z points to the middle of the cloud."""
    first: FloatArray
    """(2,), corner of the picture [tangents]."""
    depth: FloatArray
    """(rows, columns) [m] along rays, median of the points in each pixel; nan where there are none."""

    @classmethod
    def of(cls, points: FloatArray) -> "DepthPicture":
        """The picture of points (m, 3), m >= 1 [m, camera frame], of which some are not at the origin."""
        far = np.linalg.norm(points, axis=1)
        towards = points[far > 0.0] / far[far > 0.0, None]
        middle = towards.mean(axis=0)
        turn = np.linalg.svd(middle[None])[2][[1, 2, 0]]
        turn[2] = middle / np.linalg.norm(middle)
        ahead = towards @ turn.T
        wide = ahead[:, 2] > WIDEST
        tangents, depth = ahead[wide, :2] / ahead[wide, 2:], far[far > 0.0][wide]
        first = tangents.min(axis=0)
        row, column = np.floor((tangents - first) / PIXEL).astype(np.int64).T
        picture = np.full((row.max() + 1, column.max() + 1), np.nan)
        pixel = row * picture.shape[1] + column
        order = np.lexsort((depth, pixel))
        taken, start, count = np.unique(pixel[order], return_index=True, return_counts=True)
        picture.ravel()[taken] = depth[order][start + count // 2]
        return cls(turn, first, picture)

    def compare(self, surface: Surface, T_camera_world: np.ndarray) -> Agreement:
        """How samples agree at poses (..., 4, 4) of the world in the camera's frame; arrays are (..., s)."""
        turn = self.turn @ T_camera_world[..., :3, :3]
        shift = T_camera_world[..., :3, 3] @ self.turn.T
        at = np.einsum("...ij,sj->...si", turn, surface.points) + shift[..., None, :]
        outwards = np.einsum("...ij,sj->...si", turn, surface.normals)
        far = np.linalg.norm(at, axis=-1)
        facing = (np.einsum("...i,...i->...", outwards, at) < -FACING * far) & (at[..., 2] > 0.0)
        pixel = np.floor((at[..., :2] / np.where(at[..., 2:] > 0.0, at[..., 2:], 1.0) - self.first) / PIXEL)
        inside = facing & ((pixel >= 0.0) & (pixel < self.depth.shape)).all(axis=-1)
        row, column = (
            np.where(inside[..., None], pixel, 0.0).astype(np.int64).transpose(-1, *range(at.ndim - 1))
        )
        measured = np.where(inside, self.depth[row, column], np.nan)
        return Agreement(inside & np.isfinite(measured), measured - far)

    def in_front(self, surface: Surface, T_camera_world: np.ndarray) -> np.ndarray:
        """Which samples (s,) no other sample hides, at one pose (4, 4)."""
        at = surface.points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        far = np.linalg.norm(at, axis=1)
        ahead = at @ self.turn.T
        tangents = ahead[:, :2] / np.where(ahead[:, 2:] > 0.0, ahead[:, 2:], np.nan)
        place = np.nan_to_num(np.floor((tangents - np.nanmin(tangents, axis=0)) / PIXEL)).astype(np.int64)
        pixel = place[:, 0] * (place[:, 1].max() + 1) + place[:, 1]
        nearest = np.full(pixel.max() + 1, np.inf)
        np.minimum.at(nearest, pixel, far)
        return far <= nearest[pixel] + OWN
