"""What a time-of-flight camera makes of a view: noise, drop-outs, flying pixels, systematic errors.

One quantity drives noise and drop-outs: the light that comes back, s = reflectivity cos(incidence) / depth^2 [1/m^2].
Noise grows with 1 / s, hence with distance, on dark surfaces and at grazing angles, and where s is too small there is
no depth. The two constants follow from Microsoft's "Azure Kinect DK hardware specifications" (narrow field of view,
2x2 binned: surfaces of 15 % reflectivity are measured up to 5.46 m; standard deviation at most 17 mm, systematic error
below 11 mm + 0.1 % of the distance), bounds that Toelgyessy, Dekan, Chovanec and Hubinsky, "Evaluation of the Azure
Kinect and Its Comparison to Kinect V1 and Kinect V2", Sensors 21(2):413, 2021, found kept up to 3.5 m. They describe
flying pixels and dark materials without depth, too. Lateral noise is about what Nguyen, Izadi and Lovell, "Modeling
Kinect Sensor Noise for Improved 3D Reconstruction and Tracking", 3DIMPVT 2012, measured of the first Kinect (0.8
pixels), less because pixels are binned. Where no figure was found a field says "assumed".
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.sensing.render import NOTHING, Solid, View, incidence

WEAKEST = 0.15 / 5.46**2
"""[1/m^2], the light of the specified range's end."""


class Materials(NamedTuple):
    """Of k solids."""

    reflectivity: np.ndarray
    """(k,), in (0, 1], of infrared light, diffuse."""
    gloss: np.ndarray
    """(k,), share of the light that is reflected as by a mirror."""


@dataclass(frozen=True, kw_only=True)
class MaterialShares:
    """How many solids are of which kind; assumed."""

    dark: float = 0.1
    """Of 3 to 10 % reflectivity; other surfaces have 30 to 90 %."""
    shiny: float = 0.1
    """That mirror 60 to 90 % of the light."""

    def drawn(self, count: int, rng: np.random.Generator) -> Materials:
        """Materials of `count` solids."""
        kind, shade, shine = rng.random((3, count))
        reflectivity = np.where(kind < self.dark, 0.03 + 0.07 * shade, 0.3 + 0.6 * shade)
        shiny = (kind >= self.dark) & (kind < self.dark + self.shiny)
        return Materials(reflectivity, np.where(shiny, 0.6 + 0.3 * shine, 0.0))


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """Errors of an Azure-Kinect-class camera."""

    floor: float = 0.0006
    """Standard deviation of depths however bright the surface is [m]; assumed."""
    per_light: float = (0.017 - 0.0006) * WEAKEST
    """The part that grows with 1 / s [m / m^2]: 17 mm at the end of the range."""
    weakest: float = WEAKEST
    """Below this much light there is no depth [1/m^2]."""
    flicker: float = 0.3
    """Standard deviation of the logarithm of the light that a pixel gets; assumed."""
    lateral: float = 0.5
    """Standard deviation of where a pixel looks [pixels]."""
    offset: float = 0.011 / 3.0
    """Standard deviation of an image's systematic error [m]."""
    scale: float = 0.001 / 3.0
    """The same, in proportion to depth."""
    edge_lost: float = 0.3
    """Share of pixels at edges of surfaces that have no depth; assumed."""
    edge_flying: float = 0.3
    """Share of them whose depth lies anywhere between the surfaces'; assumed."""
    multipath: float = 0.02
    """Mean of what mirrored light adds to the depth of a shiny surface [m]; assumed."""
    quantum: float = 0.001
    """Depths are whole multiples of it [m]."""

    def __post_init__(self) -> None:
        for item in fields(self):
            if not getattr(self, item.name) >= 0.0:
                raise InvalidInputError(
                    f"{item.name} of depth noise is {getattr(self, item.name)}; give 0 or more"
                )
        if self.edge_lost + self.edge_flying > 1.0:
            raise InvalidInputError(
                f"edge_lost and edge_flying of depth noise are {self.edge_lost} and {self.edge_flying}; "
                "give shares whose sum is at most 1"
            )

    def times(self, factor: float) -> "DepthNoise":
        """All errors larger by a factor (quantisation aside); edges at most all lost or flying."""
        larger = {item.name: factor * getattr(self, item.name) for item in fields(self)}
        edges = max(1.0, larger["edge_lost"] + larger["edge_flying"])
        for name in ("edge_lost", "edge_flying"):
            larger[name] /= edges
        return replace(self, **(larger | {"quantum": self.quantum}))


EDGE = 0.02
"""[m] between the depths of neighbouring pixels on different solids that count as an edge."""
GLARE = np.cos(np.radians(5.0))
"""Shiny surfaces that face the camera closer than this (cosine) blind it; assumed."""


def measured(
    view: View, solids: Sequence[Solid], materials: Materials, noise: DepthNoise, rng: np.random.Generator
) -> View:
    """The view as a camera would measure it: other depths, inf where there is none."""
    looked = _looked_aside(view, noise.lateral, rng)
    found = looked.solid != NOTHING
    light = _light(looked, incidence(view, solids)[looked.rows, looked.columns], materials)
    kept = found & (light * np.exp(noise.flicker * rng.standard_normal(light.shape)) > noise.weakest)
    z = _with_errors(np.where(found, looked.depth, 1.0), light, noise, rng)
    z += noise.multipath * _of(materials.gloss, looked.solid) * rng.exponential(size=z.shape)
    near, far, edge = _edges(view)
    fate, between = rng.random((2, *z.shape))
    lost, flying = noise.edge_lost, noise.edge_lost + noise.edge_flying
    flies = edge & (fate >= lost) & (fate < flying)
    z[flies] = near[flies] + between[flies] * (far[flies] - near[flies])
    kept &= ~(edge & (fate < lost))
    if noise.quantum > 0.0:
        z = noise.quantum * np.rint(z / noise.quantum)
    kept &= (z >= view.lens.near) & (z <= view.lens.far)
    return replace(view, depth=np.where(kept, z, np.inf), solid=np.where(kept, looked.solid, NOTHING))


class _Looked(NamedTuple):
    """What each pixel (height, width) looks at, when it looks at one beside it, and which that is."""

    depth: np.ndarray
    solid: np.ndarray
    rows: np.ndarray
    columns: np.ndarray


def _looked_aside(view: View, lateral: float, rng: np.random.Generator) -> _Looked:
    rows, columns = np.indices(view.depth.shape)
    down, right = np.rint(lateral * rng.standard_normal((2, *view.depth.shape))).astype(int)
    rows = np.clip(rows + down, 0, view.lens.height - 1)
    columns = np.clip(columns + right, 0, view.lens.width - 1)
    return _Looked(view.depth[rows, columns], view.solid[rows, columns], rows, columns)


def _light(looked: _Looked, cosine: np.ndarray, materials: Materials) -> np.ndarray:
    """Light (height, width) that comes back to each pixel [1/m^2]; none where a shiny surface blinds it."""
    gloss = _of(materials.gloss, looked.solid)
    light = _of(materials.reflectivity, looked.solid) * (1.0 - gloss) * cosine / looked.depth**2
    return np.where((gloss > 0.0) & (cosine > GLARE), 0.0, light)


def _of(values: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """A value of each pixel's solid; 0 where there is none."""
    return np.append(values, 0.0)[solid]


def _with_errors(
    depth: np.ndarray, light: np.ndarray, noise: DepthNoise, rng: np.random.Generator
) -> np.ndarray:
    """Depths (height, width) [m] with an error of the whole image and one of every pixel."""
    offset, scale = rng.standard_normal(2) * (noise.offset, noise.scale)
    spread = noise.floor + noise.per_light / np.maximum(light, WEAKEST)
    return depth * (1.0 + scale) + offset + spread * rng.standard_normal(depth.shape)


def _edges(view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least and largest depth around each pixel, and whether two solids lie there, one well behind the other."""
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
    return near, far, other & (far > near + EDGE)
