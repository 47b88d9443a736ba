"""A time-of-flight camera's errors: noise, drop-outs, flying pixels, systematic errors.

Noise and drop-outs depend on the light that comes back, s = reflectivity cos(incidence) / depth^2
[1/m^2]. Noise grows with 1 / s, hence with distance, on dark surfaces and at grazing angles; where
s is too small there is no depth. The two constants follow from Microsoft's "Azure Kinect DK
hardware specifications" (narrow field of view, 2x2 binned: surfaces of 15 % reflectivity are
measured up to 5.46 m; standard deviation at most 17 mm, systematic error below 11 mm + 0.1 % of
the distance). Toelgyessy, Dekan, Chovanec and Hubinsky, "Evaluation of the Azure Kinect and Its
Comparison to Kinect V1 and Kinect V2", Sensors 21(2):413, 2021, confirmed these bounds up to 3.5 m;
they also describe flying pixels and dark materials without depth. Lateral noise is about what
Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise for Improved 3D Reconstruction and
Tracking", 3DIMPVT 2012, measured for the first Kinect (0.8 pixels), less because pixels are binned.
Fields without a source say "assumed".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from cvqmpt_lab.sensing.camera import NOTHING, Solid, View, incidence

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
    """Errors of an Azure-Kinect-class camera; standard deviations unless stated otherwise."""

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
    images = view.depth, np.where(np.isfinite(view.depth), view.depth, -np.inf), view.solid
    # of each pixel and its neighbours (height, width, 3, 3)
    depth, seen, solid = (
        sliding_window_view(np.pad(image, 1, mode="edge"), (3, 3)) for image in images
    )
    near, far = depth.min(axis=(2, 3)), seen.max(axis=(2, 3))
    other = (solid != view.solid[..., None, None]).any(axis=(2, 3))
    return near, far, other & (far > near + least)
