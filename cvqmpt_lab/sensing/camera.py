"""A pinhole camera without distortion, what it sees of convex solids, and its errors.

Its pose in the base frame is T_world_camera.

The camera frame is optical: x right, y down, z forward. Pixel (0, 0) is the centre of the upper
left pixel.

Depth images of convex solids are without noise, by ray casting: depth and seen solid of every
pixel. Only outer sides of surfaces are visible, as with back-face culling: a ray ignores a solid
that contains the camera, or that the ray enters before the near plane. So the two lower cameras of
the published set-up see the kitchen although they stand below the floor.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from cvqmpt_lab.base.codec import Checked
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import rigid
from cvqmpt_lab.base.values import Condition, FloatArray, Length

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


NOTHING = -1  # index of pixels that see no solid

# (...,) each: t at which rays eye + t ray enter and leave a solid
Interval = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex body between planes, in a ball or in an endless cylinder, or several of these.

    It holds the points x of its frame with n x + d <= 0 for the unit normal n and offset d of every
    plane, whose first `round_axes` coordinates are within `radius` of the origin.
    """

    T_world_solid: np.ndarray  # (4, 4) or (3, 4), its pose [m]
    corners: np.ndarray  # (n, 3), points whose convex hull contains it [m]
    planes: np.ndarray  # (f, 4), n and d [m] of each
    radius: float = np.inf  # [m]
    round_axes: int = 0  # 3 for a ball, 2 for a cylinder along z, 0: it is not round

    def interval(self, eye: np.ndarray, rays: np.ndarray) -> Interval:
        """Interval of rays (..., 3) from an eye (3,) [m]; those that miss: enter > leave or NaN."""
        enter, leave = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
        if self.round_axes:
            enter, leave = self._within_radius(eye[: self.round_axes], rays[..., : self.round_axes])
        # plane by plane, since an array for all planes at once could exceed the memory
        heights = self.planes[:, :3] @ eye + self.planes[:, 3]
        for normal, height in zip(self.planes[:, :3], heights, strict=True):
            towards = rays @ normal
            cut = -height / towards  # t at which the ray crosses the plane
            np.maximum(enter, cut, out=enter, where=towards < 0.0)
            np.minimum(leave, cut, out=leave, where=towards > 0.0)
            if height > 0.0:
                # these rays are parallel to the plane and stay on its outer side
                leave[towards == 0.0] = -np.inf
        return enter, leave

    def _within_radius(self, eye: np.ndarray, rays: np.ndarray) -> Interval:
        """Interval of rays (..., d) from eye (d,) within the radius.

        |eye + t ray|^2 = radius^2 is a t^2 + 2 b t + c = 0.
        """
        a, b = np.einsum("...i,...i->...", rays, rays), rays @ eye
        c = eye @ eye - self.radius * self.radius
        root = np.sqrt(b * b - a * c)  # NaN for rays that miss: comparisons with NaN are false
        # a = 0: the ray is parallel to a cylinder's axis, all of it inside (c <= 0) or none of it
        parallel = np.where(c <= 0.0, np.inf, np.nan)
        leave = np.where(a > 0.0, (root - b) / a, parallel)
        return np.where(a > 0.0, (-b - root) / a, -parallel), leave

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Outward normals (m, 3), of length 1, of the faces nearest to points (m, 3) [m] on it."""
        heights = points @ self.planes[:, :3].T + self.planes[:, 3]
        radial = points * (np.arange(3) < self.round_axes)
        away = np.linalg.norm(radial, axis=1, keepdims=True)
        nearest = np.argmax(np.hstack([heights, away - self.radius]), axis=1)
        directions = np.vstack([self.planes[:, :3], np.zeros(3)])[nearest]
        return np.where(
            (nearest == len(self.planes))[:, None], radial / np.maximum(away, 1e-12), directions
        )


def cuboid(T: np.ndarray, half: np.ndarray) -> Solid:
    """A box centred at pose T (4, 4); half (3,): half of each edge [m]."""
    planes = np.c_[np.vstack([np.eye(3), -np.eye(3)]), -np.tile(half, 2)]
    return Solid(T, _box_corners(half), planes)


def ball(T: np.ndarray, radius: float) -> Solid:
    """A ball of a radius [m] centred at pose T (4, 4)."""
    return Solid(T, _box_corners(np.full(3, radius)), np.empty((0, 4)), radius, 3)


def cylinder(T: np.ndarray, radius: float, half: float) -> Solid:
    """A cylinder centred at pose T (4, 4), axis along z; its radius and half its height [m]."""
    planes = np.array([[0.0, 0.0, 1.0, -half], [0.0, 0.0, -1.0, -half]])
    return Solid(T, _box_corners(np.array([radius, radius, half])), planes, radius, 2)


@dataclass(frozen=True, eq=False)
class View:
    """A depth image of solids."""

    camera: Camera
    depth: np.ndarray  # (height, width) [m], along the optical axis; inf where no solid is seen
    solid: np.ndarray  # (height, width) int, index of the solid seen, or `NOTHING`

    @property
    def points(self) -> np.ndarray:
        """Points (m, 3) [m, world] of all pixels that see a solid."""
        hit = np.isfinite(self.depth)
        return self.camera.eye + self.depth[hit][:, None] * self.camera.rays()[hit]


def view_of(solids: Sequence[Solid], camera: Camera) -> View:
    """Cast a ray through every pixel; seen is the nearest solid between the near and far plane."""
    rays, lens = camera.rays(), camera.intrinsics
    depth = np.full(rays.shape[:2], np.inf)
    nearest = np.full(rays.shape[:2], NOTHING)
    for index, item in enumerate(solids):
        window = _window(item, camera)
        if window is None:
            continue
        T = item.T_world_solid
        eye = (camera.eye - T[:3, 3]) @ T[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            enter, leave = item.interval(eye, rays[window] @ T[:3, :3])
        seen = (
            (enter <= leave) & (enter >= lens.near) & (enter <= lens.far) & (enter < depth[window])
        )
        depth[window][seen], nearest[window][seen] = enter[seen], index
    return View(camera, depth, nearest)


def incidence(view: View, solids: Sequence[Solid]) -> np.ndarray:
    """Cosine (height, width) between surface normal and direction to the camera; 0: no solid."""
    rays = view.camera.rays()
    cosine = np.zeros(view.depth.shape)
    for index in np.unique(view.solid[view.solid != NOTHING]):
        T, here = solids[index].T_world_solid, view.solid == index
        towards = -rays[here]
        points = view.camera.eye - view.depth[here][:, None] * towards
        normals = solids[index].normals((points - T[:3, 3]) @ T[:3, :3]) @ T[:3, :3].T
        cosine[here] = np.einsum("pi,pi->p", normals, towards) / np.linalg.norm(towards, axis=1)
    return np.clip(cosine, 0.0, 1.0)


def _window(item: Solid, camera: Camera) -> tuple[slice, slice] | None:
    """Rows and columns of the pixels that may see a solid; None if the solid is out of view."""
    T, lens = item.T_world_solid, camera.intrinsics
    corners = item.corners @ T[:3, :3].T + T[:3, 3]
    x, y, z = camera.T_world_camera[:3, :3].T @ (corners - camera.eye).T
    if z.max() < lens.near or z.min() > lens.far:
        return None
    # corners beside or behind the camera have no projection, so all pixels are taken
    if z.min() < 1e-3:
        return slice(0, lens.height), slice(0, lens.width)
    rows = _pixels(lens.cy + lens.fy * y / z, lens.height)
    columns = _pixels(lens.cx + lens.fx * x / z, lens.width)
    return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None


def _pixels(places: np.ndarray, count: int) -> slice:
    """The pixels, of 0 to count - 1, from the least to the greatest of `places` [pixels]."""
    return slice(max(0, math.floor(places.min())), min(count, math.ceil(places.max()) + 1))


def _box_corners(half: np.ndarray) -> np.ndarray:
    signs = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    return signs * half


WEAKEST = 0.15 / 5.46**2  # [1/m^2] the light of the specified range's end


Materials = tuple[np.ndarray, np.ndarray]
"""Reflectivity (k,) of k solids, in (0, 1], of infrared light, diffuse; and their gloss (k,), the
share of the light that is reflected as by a mirror."""


def drawn_materials(
    count: int, rng: np.random.Generator, dark: float = 0.1, shiny: float = 0.1
) -> Materials:
    """Materials of `count` solids.

    Args:
        count: of solids.
        rng: of the draws.
        dark: share of 3 to 10 % reflectivity, assumed; other surfaces have 30 to 90 %.
        shiny: share that mirrors 60 to 90 % of the light, assumed.
    """
    kind, shade, shine = rng.random((3, count))
    reflectivity = np.where(kind < dark, 0.03 + 0.07 * shade, 0.3 + 0.6 * shade)
    mirrors = (kind >= dark) & (kind < dark + shiny)
    return reflectivity, np.where(mirrors, 0.6 + 0.3 * shine, 0.0)


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """Errors of an Azure-Kinect-class camera; standard deviations unless stated otherwise.

    Noise and drop-outs depend on the light that comes back, s = reflectivity cos(incidence) /
    depth^2 [1/m^2]. Noise grows with 1 / s, hence with distance, on dark surfaces and at grazing
    angles; where s is too small there is no depth. The two constants follow from Microsoft's "Azure
    Kinect DK hardware specifications" (narrow field of view, 2x2 binned: surfaces of 15 %
    reflectivity are measured up to 5.46 m; standard deviation at most 17 mm, systematic error below
    11 mm + 0.1 % of the distance). Toelgyessy, Dekan, Chovanec and Hubinsky, "Evaluation of the
    Azure Kinect and Its Comparison to Kinect V1 and Kinect V2", Sensors 21(2):413, 2021, confirmed
    these bounds up to 3.5 m; they also describe flying pixels and dark materials without depth.
    Lateral noise is about what Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise for Improved
    3D Reconstruction and Tracking", 3DIMPVT 2012, measured for the first Kinect (0.8 pixels), less
    because pixels are binned. Fields without a source say "assumed".
    """

    floor: float = 0.0006  # [m] of depths however bright the surface is; assumed
    per_light: float = (0.017 - 0.0006) * WEAKEST  # [m / m^2] of 1 / s; 17 mm at full range
    weakest: float = WEAKEST  # [1/m^2] below this much light there is no depth
    flicker: float = 0.3  # of the logarithm of the light that a pixel gets; assumed
    lateral: float = 0.5  # [pixels] of where a pixel looks
    offset: float = 0.011 / 3.0  # [m] of an image's systematic error
    scale: float = 0.001 / 3.0  # the same, in proportion to depth
    edge_lost: float = 0.3  # share of pixels at edges of surfaces that have no depth; assumed
    edge_flying: float = 0.3  # share of them whose depth lies between the surfaces; assumed
    multipath: float = 0.02  # [m] mean of the depth that mirrored light adds; assumed
    quantum: float = 0.001  # [m] depths are whole multiples of it
    glare: float = 5.0  # [deg] off its normal at which a shiny surface blinds the camera; assumed
    edge: float = 0.02  # [m] depth step between solids at neighbouring pixels of an edge


def measured(
    view: View,
    solids: Sequence[Solid],
    materials: Materials,
    noise: DepthNoise,
    rng: np.random.Generator,
) -> View:
    """The view as a camera would measure it: other depths, inf where there is none."""
    # the pixel that each pixel reads: itself or a neighbour
    shape = view.depth.shape
    rows, columns = np.indices(shape)
    down, right = np.rint(noise.lateral * rng.standard_normal((2, *shape))).astype(int)
    rows, columns = np.clip(rows + down, 0, shape[0] - 1), np.clip(columns + right, 0, shape[1] - 1)
    depth, solid = view.depth[rows, columns], view.solid[rows, columns]
    found = solid != NOTHING
    reflectivity, gloss = (np.append(values, 0.0)[solid] for values in materials)  # 0: nothing
    cosine = incidence(view, solids)[rows, columns]
    light = reflectivity * (1.0 - gloss) * cosine / depth**2  # s [1/m^2]
    light = np.where((gloss > 0.0) & (cosine > np.cos(np.radians(noise.glare))), 0.0, light)
    valid = found & (
        light * np.exp(noise.flicker * rng.standard_normal(light.shape)) > noise.weakest
    )
    # errors of the whole image and of each pixel
    offset, scale = rng.standard_normal(2) * (noise.offset, noise.scale)
    spread = noise.floor + noise.per_light / np.maximum(light, WEAKEST)
    z = np.where(found, depth, 1.0)
    z = z * (1.0 + scale) + offset + spread * rng.standard_normal(shape)
    z += noise.multipath * gloss * rng.exponential(size=z.shape)
    near, far, edge = _edges(view, noise.edge)
    fate, between = rng.random((2, *z.shape))
    lost, flying = noise.edge_lost, noise.edge_lost + noise.edge_flying
    flies = edge & (fate >= lost) & (fate < flying)
    z[flies] = near[flies] + between[flies] * (far[flies] - near[flies])
    valid &= ~(edge & (fate < lost))
    if noise.quantum > 0.0:
        z = noise.quantum * np.rint(z / noise.quantum)
    valid &= (z >= view.camera.intrinsics.near) & (z <= view.camera.intrinsics.far)
    return replace(view, depth=np.where(valid, z, np.inf), solid=np.where(valid, solid, NOTHING))


def _edges(view: View, least: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least and largest depth around each pixel; mask of edges of more than `least` [m]."""
    height, width = view.depth.shape
    depth = np.pad(view.depth, 1, mode="edge")
    near, far = view.depth.copy(), np.where(np.isfinite(view.depth), view.depth, -np.inf)
    other = np.zeros((height, width), dtype=bool)
    solid = np.pad(view.solid, 1, mode="edge")
    for down in range(3):
        for right in range(3):
            around = depth[down : down + height, right : right + width]
            np.minimum(near, around, out=near)
            np.maximum(far, around, out=far, where=np.isfinite(around))
            other |= solid[down : down + height, right : right + width] != view.solid
    return near, far, other & (far > near + least)
