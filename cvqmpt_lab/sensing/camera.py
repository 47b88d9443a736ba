"""A pinhole camera without distortion: intrinsics and its pose T_world_camera in the base frame.

The camera frame is optical: x right, y down, z forward. Pixel (0, 0) is the centre of the upper
left pixel.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from cvqmpt_lab.codec import Checked
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.poses import rigid
from cvqmpt_lab.values import Condition, FloatArray, Length

Pixels = Annotated[int, Condition(int, lambda n: 1 <= n <= 2**14, f"1 to {2**14} pixels")]


@dataclass(frozen=True, eq=False)
class Intrinsics(Checked):
    """Intrinsics of a pinhole camera, and the range of depths that it measures."""

    width: Pixels
    height: Pixels
    fx: Length  # focal length along rows [pixels]
    fy: Length  # focal length along columns [pixels]
    cx: float  # column of the principal point [pixels]
    cy: float  # row of the principal point [pixels]
    near: float = 0.0  # [m] virtual cameras look through nearer surfaces
    far: float = 1000.0  # [m] and do not see farther ones

    def _check(self) -> None:
        if not (0.0 <= self.cx < self.width and 0.0 <= self.cy < self.height):
            raise InvalidInputError(
                f"intrinsics: principal point ({self.cx:g}, {self.cy:g}) is outside the image of "
                f"{self.width} x {self.height} pixels; give those of this image's size"
            )
        if not 0.0 <= self.near < self.far:
            raise InvalidInputError(
                f"intrinsics: depths {self.near:g} to {self.far:g} m; give 0 <= near < far"
            )

    @classmethod
    def from_fov(
        cls,
        width: int = 224,
        height: int = 224,
        vertical_fov: float = 45.0,
        near: float = 1.0,
        far: float = 5.1,
    ) -> "Intrinsics":
        """Square centred pixels, f = height / (2 tan(fov / 2)), fov [deg]; default: kitchen's."""
        if not 0.0 < vertical_fov < 180.0:
            raise InvalidInputError(
                f"intrinsics: vertical_fov {vertical_fov} deg; give one between 0 and 180"
            )
        focal = max(0.5 * height / math.tan(0.5 * math.radians(vertical_fov)), 1e-9)
        return cls(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), near, far)

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Rays (x, y, 1): x = (u - cx) / fx (width,) and y = (v - cy) / fy (height,)."""
        return _axis(self.width, self.fx, self.cx), _axis(self.height, self.fy, self.cy)


def _axis(count: int, focal: float, principal: float) -> np.ndarray:
    """(i - principal) / focal, 0 <= i < count; the operations' order keeps committed rows."""
    centred = 0.5 * count / focal * ((np.arange(count) + 0.5) * 2.0 / count - 1.0)
    return centred - (principal - 0.5 * (count - 1)) / focal


KINECT = Intrinsics.from_fov(width=320, height=288, vertical_fov=65.0, near=0.5, far=5.46)
"""Azure Kinect DK, narrow field of view, 2x2 binned: 75 x 65 deg (here 71), 0.5 to 5.46 m.

Source: Microsoft, "Azure Kinect DK hardware specifications"."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A depth camera at a pose."""

    intrinsics: Intrinsics
    T_world_camera: FloatArray  # (4, 4) [m]

    @property
    def eye(self) -> FloatArray:
        """Position of the camera (3,) [m, world]."""
        return self.T_world_camera[:3, 3]

    def rays(self) -> FloatArray:
        """Rays (height, width, 3) [world] through the pixels' centres, to a depth of 1 m."""
        right, down, ahead = self.T_world_camera[:3, :3].T
        x, y = self.intrinsics.axes()
        return ahead + y[:, None, None] * down + x[:, None] * right


def look_at(
    eye: Sequence[float] | np.ndarray, target: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)
) -> FloatArray:
    """T_world_camera (4, 4) of an upright camera at eye (3,) [m] that looks at target (3,) [m]."""
    if not np.isfinite([*eye, *target]).all() or np.allclose(eye, target):
        raise InvalidInputError(f"camera at {eye} cannot look at {target}; give two points")
    ahead = np.subtract(target, eye)
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0) if abs(ahead[2]) < 1.0 - 1e-9 else (1.0, 0.0, 0.0))
    right /= np.linalg.norm(right)
    return rigid(np.stack([right, np.cross(ahead, right), ahead], axis=1), eye)


def cameras_on_sphere(
    intrinsics: Intrinsics,
    azimuths: Sequence[float],
    elevations: Sequence[float],
    radius: float = 2.0,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[Camera, ...]:
    """Cameras at every pair of azimuth and elevation [deg], all `radius` [m] from their target."""
    cameras = []
    for elevation in np.radians(elevations):
        for azimuth in np.radians(azimuths):
            flat = math.cos(elevation)
            away = (flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation))
            eye = [float(c + radius * d) for c, d in zip(centre, away, strict=True)]
            cameras.append(Camera(intrinsics, look_at(eye, centre)))
    return tuple(cameras)
