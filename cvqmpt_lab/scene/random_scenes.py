"""Random cubes and spheres around the robot: the environments of the training data.

As in the published experiment code, an environment is nothing but its number: the number seeds
numpy's legacy generator, whose stream is frozen, so environment n is the same everywhere and always.
"""

import math
from numbers import Integral

import numpy as np

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Sphere

CUBE_EDGE = 0.2
"""Edge of the cubes [m]."""
SPHERE_RADIUS = 0.15
"""Radius of the spheres [m]."""
CUBE_LIFT = 0.5
"""Height [m] of the point around which cubes are scattered."""
SPHERE_LIFT = 0.33
"""Height [m] of the point around which spheres are scattered."""


def random_scene(seed: int, n_cubes: int = 8, n_spheres: int = 8) -> Scene:
    """Return environment number `seed`: cubes with random yaw and spheres, without floor or pedestal.

    Order of the draws: cube distances, elevations, azimuths, yaws; sphere distances, elevations,
    azimuths. The older 6-joint data used 6 cubes and 6 spheres.

    Parameters
    ----------
    seed : int
        Environment number, 0 to 2**32 - 1.
    n_cubes, n_spheres : int
        How many of each, 0 or more.

    Raises
    ------
    InvalidInputError
        If a number is negative or no integer.
    """
    for what, value in (("seed", seed), ("n_cubes", n_cubes), ("n_spheres", n_spheres)):
        if not isinstance(value, Integral) or isinstance(value, bool) or not 0 <= value < 2**32:
            raise InvalidInputError(f"{what} must be an integer from 0 to 2**32 - 1, got {value!r}")
    rng = np.random.RandomState(seed)
    cube_centres = _scattered(rng, n_cubes, CUBE_LIFT)
    yaws = rng.uniform(0.0, 2.0 * math.pi, n_cubes)
    sphere_centres = _scattered(rng, n_spheres, SPHERE_LIFT)
    cubes = [
        SceneObject(f"cube_{i}", Box((CUBE_EDGE,) * 3), pose(centre, yaw))
        for i, (centre, yaw) in enumerate(zip(cube_centres, yaws, strict=True))
    ]
    spheres = [
        SceneObject(f"sphere_{i}", Sphere(SPHERE_RADIUS), pose(centre))
        for i, centre in enumerate(sphere_centres)
    ]
    return Scene(f"random_{seed:06d}", (*cubes, *spheres))


def _scattered(rng: np.random.RandomState, count: int, lift: float) -> FloatArray:
    """Return (count, 3) points [m] on a spherical shell around the point `lift` above the robot base."""
    distance = rng.uniform(0.4, 1.2, count)
    elevation = rng.uniform(-0.25 * math.pi, 0.5 * math.pi, count)
    azimuth = rng.uniform(0.0, 2.0 * math.pi, count)
    horizontal = distance * np.cos(elevation)
    return np.stack(
        [horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), distance * np.sin(elevation) + lift],
        axis=1,
    )
