"""Where a depth camera stands and what its optics take in."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cvqmpt_lab.errors import InvalidInputError


@dataclass(frozen=True)
class DepthCamera:
    """A virtual depth camera, upright."""

    eye: tuple[float, float, float]
    """Where it stands [m]."""
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What it looks at [m]; another point than `eye`."""

    def __post_init__(self) -> None:
        if not np.isfinite([*self.eye, *self.target]).all() or np.allclose(self.eye, self.target):
            raise InvalidInputError(f"camera at {self.eye} cannot look at {self.target}; give two points")

    @cached_property
    def axes(self) -> np.ndarray:
        """(3, 3), rows: to the right, up, ahead."""
        ahead = np.subtract(self.target, self.eye)
        ahead = ahead / np.linalg.norm(ahead)
        upright = (0.0, 0.0, 1.0) if abs(ahead[2]) < 1.0 - 1e-9 else (1.0, 0.0, 0.0)
        right = np.cross(ahead, upright)
        right /= np.linalg.norm(right)
        return np.array([right, np.cross(right, ahead), ahead])

    @property
    def T_world_camera(self) -> np.ndarray:
        """(4, 4), pose of the frame in which images are given: x to the right, y down, z ahead [m]."""
        right, up, ahead = self.axes
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.stack([right, -up, ahead], axis=1), self.eye
        return T


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Size, angle and range of a camera's images; by default of those that published kitchen clouds were made of."""

    width: int = 224
    """Of each image [pixels]."""
    height: int = 224
    """Of each image [pixels]."""
    vertical_fov: float = 45.0
    """Angle of view from the bottom to the top of an image [deg]."""
    near: float = 1.0
    """Nearer surfaces are looked through [m]."""
    far: float = 5.1
    """Farther surfaces are not seen [m]."""

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 1 or not 0.0 < self.vertical_fov < 180.0:
            raise InvalidInputError(
                f"image of {self.width} x {self.height} pixels, {self.vertical_fov} deg: give 1 or more pixels, "
                "an angle between 0 and 180"
            )
        if not 0.0 < self.near < self.far:
            raise InvalidInputError(f"camera depths {self.near} to {self.far} m: give 0 < near < far")

    @property
    def extent(self) -> tuple[float, float]:
        """Half the width and half the height of the image, at a depth of 1 m [m]."""
        tall = math.tan(0.5 * math.radians(self.vertical_fov))
        return tall * self.width / self.height, tall

    def rays(self, camera: DepthCamera) -> np.ndarray:
        """Rays (height, width, 3) through the pixels' centres, of depth 1 m."""
        wide, tall = self.extent
        x = wide * ((np.arange(self.width) + 0.5) * 2.0 / self.width - 1.0)
        y = tall * (1.0 - (np.arange(self.height) + 0.5) * 2.0 / self.height)
        right, up, ahead = camera.axes
        return ahead + y[:, None, None] * up + x[:, None] * right


KINECT = Lens(width=320, height=288, vertical_fov=65.0, near=0.5, far=5.46)
"""Azure Kinect DK, narrow field of view, 2x2 binned: 75 x 65 deg (here 71), 0.5 to 5.46 m.

Source: Microsoft, "Azure Kinect DK hardware specifications"."""


def cameras_on_sphere(
    azimuths: tuple[float, ...],
    elevations: tuple[float, ...],
    radius: float = 2.0,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[DepthCamera, ...]:
    """Cameras at every pair of azimuth and elevation [deg], `radius` [m] from the point they look at."""
    cameras = []
    for elevation in np.radians(elevations):
        for azimuth in np.radians(azimuths):
            direction = (
                math.cos(elevation) * math.cos(azimuth),
                math.cos(elevation) * math.sin(azimuth),
                math.sin(elevation),
            )
            x, y, z = (float(c + radius * d) for c, d in zip(centre, direction, strict=True))
            cameras.append(DepthCamera((x, y, z), centre))
    return tuple(cameras)
