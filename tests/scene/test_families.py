"""Random environments: shapes, ranges, order of the draws."""

import math

import numpy as np
import pytest

from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.families import random_scene
from cvqmpt_lab.scene.shapes import Box, Sphere


def drawn_by_hand(seed, n_cubes, n_spheres):
    """Cube poses and sphere positions from the generator's raw uniforms, one loop per object."""
    uniforms = iter(np.random.RandomState(seed).random_sample(4 * n_cubes + 3 * n_spheres))

    def centres(count, lift):
        r = [0.4 + 0.8 * next(uniforms) for _ in range(count)]
        elevation = [math.radians(-45.0 + 135.0 * next(uniforms)) for _ in range(count)]
        azimuth = [math.radians(360.0 * next(uniforms)) for _ in range(count)]
        x = np.multiply(r, np.cos(elevation) * np.cos(azimuth))
        y = np.multiply(r, np.cos(elevation) * np.sin(azimuth))
        return np.stack([x, y, np.multiply(r, np.sin(elevation)) + lift], axis=1)

    cubes = centres(n_cubes, 0.5)
    yaws = [2.0 * math.pi * next(uniforms) for _ in range(n_cubes)]
    return [pose(xyz, yaw) for xyz, yaw in zip(cubes, yaws, strict=True)], centres(n_spheres, 0.33)


@pytest.mark.parametrize(
    ("seed", "n_cubes", "n_spheres"), [(0, 8, 8), (2000, 8, 8), (7, 6, 3), (1, 0, 2)]
)
def test_objects_follow_the_documented_draws(seed, n_cubes, n_spheres):
    scene = random_scene(seed, n_cubes, n_spheres)
    cube_poses, sphere_centres = drawn_by_hand(seed, n_cubes, n_spheres)
    assert len(scene.objects) == len(scene.obstacles) == n_cubes + n_spheres
    for i, T in enumerate(cube_poses):
        np.testing.assert_allclose(scene[f"cube_{i}"].T_world_object, T, atol=1e-12)
        assert scene[f"cube_{i}"].shape == Box((0.2, 0.2, 0.2))
    for i, centre in enumerate(sphere_centres):
        np.testing.assert_allclose(scene[f"sphere_{i}"].T_world_object, pose(centre), atol=1e-12)
        assert scene[f"sphere_{i}"].shape == Sphere(0.15)
