"""Light, shadow and outlines of a still scene, drawn once, and of what moves in it;
where to look from.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cvqmpt_lab.show.meshes import Mesh, Viewpoint, colour_of, joined, rasterise

SKY, STEEP, SUN = 0.58, 0.1, 0.46  # light from everywhere, from above, and from the sun
SUN_DISTANCE = 40.0  # [m] of the viewpoint whose picture is the shadow map
SHADOW_REACH = 2.6  # [m] around a mesh's middle; what lies farther casts no shadow
SHADOW_PIXELS = 1536  # side of the largest shadow map
SHADOW_BIAS = 0.025  # [m] a surface shadows only what lies this far behind it
OUTLINE = 0.55  # what is left of the light on outlines


@dataclass(frozen=True, eq=False)
class Picture:
    """An image with depth."""

    image: np.ndarray  # (rows, columns, 3), each channel in [0, 1]
    depth: np.ndarray  # (rows, columns) [m], inf where nothing solid is
    # the same of each translucent layer over it
    ghosts: list[np.ndarray] = field(default_factory=list)


class Shadow:
    """The shadow of a mesh, as a shadow map."""

    def __init__(self, mesh: Mesh, sun: np.ndarray, side: int) -> None:
        """sun: direction (3,) towards it; side: of the shadow map [pixels]."""
        low, high = mesh.corners.min(axis=(0, 1)), mesh.corners.max(axis=(0, 1))
        middle, reach = (
            0.5 * (low + high),
            min(SHADOW_REACH, 0.5 * float(np.linalg.norm(high - low))),
        )
        angle = 2.0 * float(np.arctan(reach / SUN_DISTANCE))
        self._middle, self._reach = middle, reach
        self._from_sun = Viewpoint(tuple(middle + SUN_DISTANCE * sun), tuple(middle), angle)
        self._shape = (side, side)
        view = rasterise(mesh, self._from_sun, self._shape)
        self._blocked = np.full(self._shape, np.inf)
        self._blocked[view.rows, view.columns] = view.depth + SHADOW_BIAS

    def may_reach(self, across: np.ndarray) -> np.ndarray:
        """Which points may be in the shadow; across: their coordinates (k, 2) [m] along `sun_axes`."""
        middle = self._from_sun.axes[:2] @ self._middle
        return (np.abs(across - middle) < 1.2 * self._reach).all(axis=1)

    def lit(self, points: np.ndarray) -> np.ndarray:
        """Share (k,) of the sunlight that reaches points (k, 3) [m]."""
        column, row, depth = np.moveaxis(self._from_sun.screen(points, self._shape), -1, 0)
        total = np.zeros(len(points))
        for i, j in np.ndindex(3, 3):
            at = tuple(
                np.clip((a + b - 0.5).astype(int), 0, self._shape[0] - 1)
                for a, b in ((row, i), (column, j))
            )
            total += depth < self._blocked[at]
        return total / 9.0


class Stage:
    """A still scene, seen from one viewpoint."""

    def __init__(
        self,
        still: Sequence[Mesh],
        ground: float | None,
        viewpoint: Viewpoint,
        shape: tuple[int, int],
    ) -> None:
        """still: meshes of the scene; ground: height of a floor [m] or None; shape:
        (rows, columns).
        """
        self.viewpoint, self.shape = viewpoint, shape
        self._side = min(SHADOW_PIXELS, 2 * max(shape))
        self._shadows: list[Shadow] = []
        self._colours, self._points = (
            np.ones((*shape, 3), np.float32),
            np.zeros((*shape, 3), np.float32),
        )
        self._sky, self._sun = np.ones(shape, np.float32), np.zeros(shape, np.float32)
        self._white = np.zeros(shape, np.float32)
        self._depth, self._piece = np.full(shape, np.inf), np.full(shape, -1)
        if still:
            mesh = joined(still)
            self._shadows.append(Shadow(mesh, viewpoint.sun, self._side))
            view = rasterise(mesh, viewpoint, shape)
            at = view.rows, view.columns
            self._depth[at], self._piece[at] = view.depth, mesh.piece[view.face]
            self._lay(at, view.depth, mesh.colours[view.face], view.normals)
        if ground is not None:
            self._lay_ground(ground)
        self._sunny = np.nonzero(self._sun)
        self._across = self._points[self._sunny] @ sun_axes(viewpoint).T.astype(np.float32)

    def picture(self, moving: Sequence[Mesh]) -> Picture:
        """The scene with the meshes that move."""
        mesh = joined(moving)
        shadow = Shadow(mesh, self.viewpoint.sun, self._side // 2)
        sun, piece, depth = self._sun.copy(), self._piece.copy(), self._depth.copy()
        near = shadow.may_reach(self._across)
        below = self._sunny[0][near], self._sunny[1][near]
        sun[below] *= shadow.lit(self._points[below])
        image = self._colours * (self._sky + sun)[..., None] + self._white[..., None]
        view = rasterise(mesh, self.viewpoint, self.shape)
        nearer = view.depth < depth[view.rows, view.columns]
        at = view.rows[nearer], view.columns[nearer]
        depth[at], piece[at] = (
            view.depth[nearer],
            mesh.piece[view.face[nearer]] + 1 + self._piece.max(),
        )
        points = self.viewpoint.eye + depth[at][:, None] * self.viewpoint.rays(
            at[0], at[1], self.shape
        )
        lit = np.minimum(self._lit(points), shadow.lit(points))
        sky, sunlight = light(view.normals[nearer], self.viewpoint)
        image[at] = mesh.colours[view.face[nearer]] * (sky + lit * sunlight)[:, None]
        image[_outlines(piece)] *= OUTLINE
        return Picture(image, depth)

    def _lit(self, points: np.ndarray) -> np.ndarray:
        """Share (k,) of the sunlight that the scene lets through to points (k, 3)."""
        return self._shadows[0].lit(points) if self._shadows else np.ones(len(points))

    def _lay(
        self,
        at: tuple[np.ndarray, ...],
        depth: np.ndarray,
        colours: np.ndarray,
        normals: np.ndarray,
    ) -> None:
        """Put a surface of given colours (k, 3) and normals (k, 3) at pixels (rows, columns)."""
        points = self.viewpoint.eye + depth[:, None] * self.viewpoint.rays(at[0], at[1], self.shape)
        sky, sunlight = light(normals, self.viewpoint)
        self._points[at], self._colours[at] = points, colours
        self._sky[at], self._sun[at] = sky, sunlight * self._lit(points)

    def _lay_ground(self, height: float) -> None:
        """Put the plane z = height [m] at empty pixels; it fades into white with distance."""
        rows, columns = np.nonzero(self._piece < 0)
        rays = self.viewpoint.rays(rows, columns, self.shape)
        depth = (height - self.viewpoint.eye[2]) / np.where(rays[:, 2] == 0.0, np.inf, rays[:, 2])
        away = np.linalg.norm(
            self.viewpoint.eye + depth[:, None] * rays - self.viewpoint.target, axis=1
        )
        share = np.clip(1.6 - 0.4 * away, 0.0, 1.0) * (depth > 0.0)
        seen = share > 0.0
        at, share = (rows[seen], columns[seen]), share[seen]
        upwards = np.tile([0.0, 0.0, 1.0], (len(share), 1))
        self._lay(at, depth[seen], np.tile(colour_of("floor"), (len(share), 1)), upwards)
        self._colours[at] *= share[:, None]
        self._white[at] = 1.0 - share


def sun_axes(viewpoint: Viewpoint) -> np.ndarray:
    """Two directions (2, 3) across the sunlight."""
    return Viewpoint(tuple(viewpoint.sun), (0.0, 0.0, 0.0)).axes[:2]


def light(normals: np.ndarray, viewpoint: Viewpoint) -> tuple[np.ndarray, np.ndarray]:
    """Light (k,) on surfaces with normals (k, 3):
    from the sky, and from the sun where nothing shadows it.
    """
    return SKY + STEEP * normals[:, 2], SUN * np.maximum(normals @ viewpoint.sun, 0.0)


def _outlines(piece: np.ndarray) -> np.ndarray:
    """Which pixels (rows, columns) belong to another piece than the one to the left or above."""
    edge = np.zeros(piece.shape, dtype=bool)
    edge[:, 1:] |= piece[:, 1:] != piece[:, :-1]
    edge[1:] |= piece[1:] != piece[:-1]
    return edge


# The viewpoint from which a motion fills the picture and little is in front of it.
AZIMUTHS = (
    -132.0,
    -165.0,
    -95.0,
    160.0,
    125.0,
    -60.0,
    90.0,
    -25.0,
    55.0,
    15.0,
)  # [deg] from the motion to the eye
ENOUGH = 0.8  # share of the motion in sight at which no other direction is tried
ELEVATION = 24.0  # [deg] of the eye above the motion
HEIGHT_ANGLE = 0.64  # [rad]
CONTEXT = 1.3  # distance of the eye, relative to the one at which the motion fills the picture
GAIN = 0.05  # share of the motion that another direction must show more to be taken instead
LOOK_ROWS = 64  # [pixels] of the small pictures in which directions are compared


def clear_viewpoint(
    parts: Sequence[Mesh], scene: Sequence[Mesh], size: tuple[int, int]
) -> Viewpoint:
    """A viewpoint for a picture of (width, height) pixels from which most of each part of a motion
    is seen.
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
    """The viewpoint at an azimuth [deg] whose picture of (width, height) pixels holds points (m, 3)
    [m].
    """
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    turn, rise = math.radians(azimuth), math.radians(ELEVATION)
    towards_eye = np.array(
        [math.cos(rise) * math.cos(turn), math.cos(rise) * math.sin(turn), math.sin(rise)]
    )
    far = Viewpoint(tuple(target + towards_eye), tuple(target), HEIGHT_ANGLE)
    right, down, ahead = far.axes @ (points - target).T
    tall = math.tan(0.5 * HEIGHT_ANGLE)
    distance = np.max(
        np.maximum(np.abs(down) / tall, np.abs(right) * size[1] / (tall * size[0])) - ahead
    )
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
