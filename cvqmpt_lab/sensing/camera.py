"""A pinhole camera without distortion, its depth images of convex solids, and its errors.

The pose of a camera in the robot's base frame is T_world_camera. The camera frame is optical: x
right, y down, z forward. Pixel (0, 0) is the centre of the upper left pixel.

Ray casting gives depth and visible solid of every pixel, without noise. Only outer sides of
surfaces are visible (back-face culling): a ray ignores a solid that contains the camera, or that
the ray enters before the near plane. Therefore the two lower cameras of the published clouds see
the kitchen although they are below the floor.
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

Pixels = Annotated[int, Condition(int, {"minimum": 1, "maximum": 2**14}, f"1 to {2**14} pixels")]


@dataclass(frozen=True, eq=False)
class Intrinsics(Checked):
    """Intrinsics of a pinhole camera, and its range of depths."""

    width: Pixels
    height: Pixels
    fx: Length  # focal length along rows [pixels]
    fy: Length  # focal length along columns [pixels]
    cx: float  # column of the principal point [pixels]
    cy: float  # row of the principal point [pixels]
    near: float = 0.0  # virtual cameras ignore nearer surfaces [m]
    far: float = 1000.0  # virtual cameras do not see farther surfaces [m]

    def _check(self) -> None:
        if not (0.0 <= self.cx < self.width and 0.0 <= self.cy < self.height):
            raise InvalidInputError(
                f"intrinsics: principal point ({self.cx:g}, {self.cy:g}) is outside the image of "
                f"{self.width} x {self.height} pixels; give the intrinsics for this image size"
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
        """Return intrinsics with f = height / (2 tan(fov / 2)) and a centred principal point.

        The defaults are from the published kitchen clouds.

        Args:
            width: number of columns.
            height: number of rows.
            vertical_fov: angle between the upper and lower edge of the image [deg].
            near: smallest depth [m].
            far: largest depth [m].
        """
        if not 0.0 < vertical_fov < 180.0:
            raise InvalidInputError(
                f"intrinsics: vertical_fov {vertical_fov} deg; give one between 0 and 180"
            )
        focal = max(0.5 * height / math.tan(0.5 * math.radians(vertical_fov)), 1e-9)
        return cls(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), near, far)

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return x = (u - cx) / fx (width,), y = (v - cy) / fy (height,) of the rays (x, y, 1)."""
        return _axis(self.width, self.fx, self.cx), _axis(self.height, self.fy, self.cy)


def _axis(count: int, focal: float, principal: float) -> np.ndarray:
    """Return (i - principal) / focal, 0 <= i < count, rounded exactly as in committed results."""
    centred = 0.5 * count / focal * ((np.arange(count) + 0.5) * 2.0 / count - 1.0)
    return centred - (principal - 0.5 * (count - 1)) / focal


KINECT = Intrinsics.from_fov(width=320, height=288, vertical_fov=65.0, near=0.5, far=5.46)
"""Azure Kinect DK, narrow field of view, 2x2 binned: 75 (here 71) x 65 deg, 0.5 to 5.46 m.

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
        """Return rays (height, width, 3) [world] through the pixels' centres, to a depth of 1 m."""
        right, down, ahead = self.T_world_camera[:3, :3].T
        x, y = self.intrinsics.axes()
        return ahead + y[:, None, None] * down + x[:, None] * right


def look_at(
    eye: Sequence[float] | np.ndarray, target: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)
) -> FloatArray:
    """Return T_world_camera (4, 4) of an upright camera at eye (3,) [m] that looks at target."""
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
    """Return a camera for every pair of azimuth and elevation, directed at the centre of a sphere.

    Args:
        intrinsics: intrinsics of all cameras.
        azimuths: angles about the vertical, from x [deg].
        elevations: angles above the horizontal plane [deg].
        radius: distance of the cameras from the centre [m].
        centre: centre of the sphere [m].
    """
    cameras = []
    for elevation in np.radians(elevations):
        for azimuth in np.radians(azimuths):
            flat = math.cos(elevation)
            away = (flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation))
            eye = [float(c + radius * d) for c, d in zip(centre, away, strict=True)]
            cameras.append(Camera(intrinsics, look_at(eye, centre)))
    return tuple(cameras)


NO_SOLID = -1  # index of pixels that see no solid

# (...,) each: parameters t where rays eye + t ray enter and leave a solid
Interval = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex body: the intersection of half-spaces with a ball or an infinite cylinder.

    It contains the points x of its frame with n x + d <= 0 for unit normal n and offset d of every
    plane, if the norm of their first `round_axes` coordinates is at most `radius`.
    """

    T_world_solid: np.ndarray  # (4, 4) or (3, 4) pose [m]
    corners: np.ndarray  # (n, 3) points whose convex hull contains the solid [m]
    planes: np.ndarray  # (f, 4) n and d [m] of each plane
    radius: float = np.inf  # [m]
    round_axes: int = 0  # 3: ball; 2: cylinder along z; 0: planes only

    def interval(self, eye: np.ndarray, rays: np.ndarray) -> Interval:
        """Return the interval of rays (..., 3) from eye (3,) [m]; a miss: enter > leave or NaN."""
        enter = np.full(rays.shape[:-1], -np.inf)
        leave = np.full(rays.shape[:-1], np.inf)
        if self.round_axes:
            enter, leave = self._within_radius(eye[: self.round_axes], rays[..., : self.round_axes])
        # one plane after another: an array for all planes could exceed the memory
        heights = self.planes[:, :3] @ eye + self.planes[:, 3]
        for normal, height in zip(self.planes[:, :3], heights, strict=True):
            towards = rays @ normal
            cut = -height / towards  # t at which the ray crosses the plane
            np.maximum(enter, cut, out=enter, where=towards < 0.0)
            np.minimum(leave, cut, out=leave, where=towards > 0.0)
            if height > 0.0:
                # rays parallel to the plane, on its outer side
                leave[towards == 0.0] = -np.inf
        return enter, leave

    def _within_radius(self, eye: np.ndarray, rays: np.ndarray) -> Interval:
        """Return the interval of rays (..., d) from eye (d,) in the ball or cylinder.

        |eye + t ray|^2 = radius^2 is a t^2 + 2 b t + c = 0.
        """
        a = np.einsum("...i,...i->...", rays, rays)
        b = rays @ eye
        c = eye @ eye - self.radius * self.radius
        root = np.sqrt(b * b - a * c)  # NaN if the ray misses: comparisons with NaN are False
        # a = 0: the ray is parallel to the cylinder's axis, completely inside (c <= 0) or outside
        parallel = np.where(c <= 0.0, np.inf, np.nan)
        enter = np.where(a > 0.0, (-b - root) / a, -parallel)
        leave = np.where(a > 0.0, (root - b) / a, parallel)
        return enter, leave

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Return the outward unit normals (m, 3) of the solid at points (m, 3) [m] on it."""
        heights = points @ self.planes[:, :3].T + self.planes[:, 3]
        radial = points * (np.arange(3) < self.round_axes)
        away = np.linalg.norm(radial, axis=1, keepdims=True)
        nearest = np.argmax(np.hstack([heights, away - self.radius]), axis=1)
        directions = np.vstack([self.planes[:, :3], np.zeros(3)])[nearest]
        return np.where(
            (nearest == len(self.planes))[:, None], radial / np.maximum(away, 1e-12), directions
        )


def cuboid(T: np.ndarray, half: np.ndarray) -> Solid:
    """Return a box centred at pose T (4, 4); half (3,): half of each edge [m]."""
    planes = np.c_[np.vstack([np.eye(3), -np.eye(3)]), -np.tile(half, 2)]
    return Solid(T, _box_corners(half), planes)


def ball(T: np.ndarray, radius: float) -> Solid:
    """Return a ball centred at pose T (4, 4); radius [m]."""
    return Solid(T, _box_corners(np.full(3, radius)), np.empty((0, 4)), radius, 3)


def cylinder(T: np.ndarray, radius: float, half: float) -> Solid:
    """Return a cylinder along z centred at pose T (4, 4); radius and half of the height [m]."""
    planes = np.array([[0.0, 0.0, 1.0, -half], [0.0, 0.0, -1.0, -half]])
    return Solid(T, _box_corners(np.array([radius, radius, half])), planes, radius, 2)


@dataclass(frozen=True, eq=False)
class View:
    """A depth image of solids."""

    camera: Camera
    depth: np.ndarray  # (height, width) along the optical axis [m]; inf: no solid
    solid: np.ndarray  # (height, width) int index of the visible solid, or `NO_SOLID`

    @property
    def points(self) -> np.ndarray:
        """Points (m, 3) [m, world] of all pixels that see a solid."""
        hit = np.isfinite(self.depth)
        return self.camera.eye + self.depth[hit][:, None] * self.camera.rays()[hit]


def view_of(solids: Sequence[Solid], camera: Camera) -> View:
    """Cast a ray through every pixel to the nearest solid between the near and far plane."""
    rays, lens = camera.rays(), camera.intrinsics
    depth = np.full(rays.shape[:2], np.inf)
    nearest = np.full(rays.shape[:2], NO_SOLID)
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
        depth[window][seen] = enter[seen]
        nearest[window][seen] = index
    return View(camera, depth, nearest)


def incidence(view: View, solids: Sequence[Solid]) -> np.ndarray:
    """Return the cosine (height, width) of surface normal and direction to the camera, or 0."""
    rays = view.camera.rays()
    cosine = np.zeros(view.depth.shape)
    for index in np.unique(view.solid[view.solid != NO_SOLID]):
        T = solids[index].T_world_solid
        here = view.solid == index
        towards = -rays[here]
        points = view.camera.eye - view.depth[here][:, None] * towards
        normals = solids[index].normals((points - T[:3, 3]) @ T[:3, :3]) @ T[:3, :3].T
        cosine[here] = np.einsum("pi,pi->p", normals, towards) / np.linalg.norm(towards, axis=1)
    return np.clip(cosine, 0.0, 1.0)


def _window(item: Solid, camera: Camera) -> tuple[slice, slice] | None:
    """Return rows and columns of the pixels that may see a solid; None: it is out of view."""
    T, lens = item.T_world_solid, camera.intrinsics
    corners = item.corners @ T[:3, :3].T + T[:3, 3]
    x, y, z = camera.T_world_camera[:3, :3].T @ (corners - camera.eye).T
    if z.max() < lens.near or z.min() > lens.far:
        return None
    # corners behind the image plane have no projection: all pixels may see the solid
    if z.min() < 1e-3:
        return slice(0, lens.height), slice(0, lens.width)
    rows = _pixels(lens.cy + lens.fy * y / z, lens.height)
    columns = _pixels(lens.cx + lens.fx * x / z, lens.width)
    return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None


def _pixels(places: np.ndarray, count: int) -> slice:
    """Return the range of pixels, in 0 to count - 1, that contains all `places` [pixels]."""
    return slice(max(0, math.floor(places.min())), min(count, math.ceil(places.max()) + 1))


def _box_corners(half: np.ndarray) -> np.ndarray:
    signs = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    return signs * half


WEAKEST_LIGHT = 0.15 / 5.46**2  # light s at the end of the specified range [1/m^2]


Materials = tuple[np.ndarray, np.ndarray]
"""Diffuse reflectivity (k,), in (0, 1], of k solids for infrared light, and their gloss (k,): the
share of light that is reflected as by a mirror."""


def drawn_materials(
    count: int, rng: np.random.Generator, dark: float = 0.1, shiny: float = 0.1
) -> Materials:
    """Draw materials of `count` solids.

    Args:
        count: number of solids.
        rng: random numbers.
        dark: share of solids with 3 to 10 % reflectivity (assumed); others have 30 to 90 %.
        shiny: share of solids that mirror 60 to 90 % of the light (assumed).
    """
    kind, shade, shine = rng.random((3, count))
    reflectivity = np.where(kind < dark, 0.03 + 0.07 * shade, 0.3 + 0.6 * shade)
    mirrors = (kind >= dark) & (kind < dark + shiny)
    return reflectivity, np.where(mirrors, 0.6 + 0.3 * shine, 0.0)


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """Errors of a depth camera like the Azure Kinect; standard deviations unless stated otherwise.

    Noise and drop-outs depend on the returned light s = reflectivity cos(incidence) / depth^2
    [1/m^2]. Noise grows with 1 / s: with distance, on dark surfaces and at grazing angles; if s is
    too small, there is no depth. The two constants follow from Microsoft's "Azure
    Kinect DK hardware specifications" (narrow field of view, 2x2 binned: surfaces of 15 %
    reflectivity are measured up to 5.46 m; standard deviation at most 17 mm, systematic error below
    11 mm + 0.1 % of the distance). Toelgyessy, Dekan, Chovanec and Hubinsky, "Evaluation of the
    Azure Kinect and Its Comparison to Kinect V1 and Kinect V2", Sensors 21(2):413, 2021, confirmed
    these bounds up to 3.5 m; they also describe flying pixels and dark materials without depth.
    Lateral noise is about what Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise for Improved
    3D Reconstruction and Tracking", 3DIMPVT 2012, measured for the first Kinect (0.8 pixels), less
    because pixels are binned. Fields without a source say "assumed".
    """

    floor: float = 0.0006  # standard deviation of depths on the brightest surface [m]; assumed
    per_light: float = (0.017 - 0.0006) * WEAKEST_LIGHT  # per 1 / s [m / m^2]; 17 mm at full range
    weakest: float = WEAKEST_LIGHT  # no depth below this s [1/m^2]
    flicker: float = 0.3  # standard deviation of the logarithm of a pixel's light; assumed
    lateral: float = 0.5  # standard deviation of the direction of a pixel [pixels]
    offset: float = 0.011 / 3.0  # constant part of an image's systematic error [m]
    scale: float = 0.001 / 3.0  # part of an image's systematic error in proportion to depth
    edge_lost: float = 0.3  # share of pixels without depth at edges of surfaces; assumed
    edge_flying: float = 0.3  # share of pixels with a depth between both surfaces; assumed
    multipath: float = 0.02  # mean depth that mirrored light adds [m]; assumed
    quantum: float = 0.001  # depths are multiples of it [m]
    glare: float = 5.0  # a shiny surface blinds the camera up to this incidence [deg]; assumed
    edge: float = 0.02  # least depth step between the solids of an edge [m]


def measured(
    view: View,
    solids: Sequence[Solid],
    materials: Materials,
    noise: DepthNoise,
    rng: np.random.Generator,
) -> View:
    """Return the view with measurement errors: other depths, and inf where depth is lost.

    Args:
        view: exact depth image.
        solids: solids of the view.
        materials: reflectivity and gloss of each solid.
        noise: size of the errors.
        rng: random numbers.
    """
    # index of the pixel whose depth each pixel measures: itself or a neighbour
    shape = view.depth.shape
    rows, columns = np.indices(shape)
    down, right = np.rint(noise.lateral * rng.standard_normal((2, *shape))).astype(int)
    rows = np.clip(rows + down, 0, shape[0] - 1)
    columns = np.clip(columns + right, 0, shape[1] - 1)
    depth, solid = view.depth[rows, columns], view.solid[rows, columns]
    found = solid != NO_SOLID
    reflectivity, gloss = (np.append(values, 0.0)[solid] for values in materials)  # 0: no solid
    cosine = incidence(view, solids)[rows, columns]
    light = reflectivity * (1.0 - gloss) * cosine / depth**2  # s [1/m^2]
    light = np.where((gloss > 0.0) & (cosine > np.cos(np.radians(noise.glare))), 0.0, light)
    valid = found & (
        light * np.exp(noise.flicker * rng.standard_normal(light.shape)) > noise.weakest
    )
    # errors of the whole image and of each pixel
    offset, scale = rng.standard_normal(2) * (noise.offset, noise.scale)
    spread = noise.floor + noise.per_light / np.maximum(light, WEAKEST_LIGHT)
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
    return replace(view, depth=np.where(valid, z, np.inf), solid=np.where(valid, solid, NO_SOLID))


def _edges(view: View, least: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return least and largest depth around each pixel, and a mask of edges over `least` [m]."""
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
