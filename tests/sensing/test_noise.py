"""Errors of depth cameras: growth, missing depth, flying pixels, repeatability."""

from dataclasses import fields, replace

import numpy as np
import pytest

from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.sensing.camera import KINECT, Camera, look_at, view_of
from cvqmpt_lab.sensing.noise import DepthNoise, measured
from cvqmpt_lab.sensing.observation import solids_of

CAMERA = Camera(KINECT, look_at((-1.0, 0.0, 0.0)))
OTHERS = ("lateral", "offset", "scale", "multipath", "edge_lost", "edge_flying", "quantum")
NONE = DepthNoise(**{item.name: 0.0 for item in fields(DepthNoise)})
AXIAL = DepthNoise(**dict.fromkeys(OTHERS, 0.0))


def plate(distance, turn=0.0, size=9.0):
    """A thin plate `distance` [m] before the camera, turned [rad] from facing it."""
    T = pose((distance - 1.0, 0.0, 0.0)) @ pose((0.0, 0.0, 0.0), turn) @ pose((5e-4, 0.0, 0.0))
    return solids_of([SceneObject("plate", Box((1e-3, size, size)), T)])


def of_one(reflectivity, gloss=0.0):
    return np.array([reflectivity]), np.array([gloss])


def seen(solids, material, noise=AXIAL, seed=0):
    """The middle of the picture, with its true depths and those measured."""
    view = view_of(solids, CAMERA)
    found = measured(view, solids, material, noise, np.random.default_rng(seed))
    middle = slice(134, 154), slice(140, 180)
    return view.depth[middle], found.depth[middle]


def spread(*args, **kwargs):
    """Standard deviation of the depths measured [m]."""
    true, found = seen(*args, **kwargs)
    return np.std((found - true)[np.isfinite(found)])


def test_noise_grows_with_distance_darkness_and_angle_and_keeps_the_makers_bound():
    near, middle, far = (spread(plate(z), of_one(0.8)) for z in (0.8, 1.5, 3.0))
    assert 0.0005 < near < middle < far < 0.003
    assert middle < spread(plate(1.5), of_one(0.2))
    assert middle < spread(plate(1.5, turn=1.3), of_one(0.8))
    assert spread(plate(5.4), of_one(0.16)) < 0.0175


@pytest.mark.parametrize(
    ("solids", "material", "share"),
    [
        (plate(1.5), of_one(0.8), (1.0, 1.0)),
        (plate(5.0), of_one(0.15), (0.6, 0.95)),  # the light of single pixels flickers
        (plate(3.0), of_one(0.03), (0.0, 0.2)),
        (plate(1.5, turn=1.565), of_one(0.8), (0.0, 0.7)),
        (plate(1.5), of_one(0.8, gloss=0.7), (0.0, 0.2)),  # blinded where it faces the camera
        (plate(1.5, turn=0.4), of_one(0.8, gloss=0.7), (0.99, 1.0)),
    ],
    ids=["white", "end of the range", "dark and far", "grazing", "shiny", "shiny, turned"],
)
def test_what_sends_little_light_back_has_no_depth(solids, material, share):
    true, found = seen(solids, material)
    assert share[0] <= np.isfinite(found).sum() / np.isfinite(true).sum() <= share[1]


def test_flying_pixels_lie_between_the_surfaces_and_only_at_edges():
    front, back = plate(1.0, size=0.3)[0], plate(2.0)[0]
    solids, material = [front, back], (np.full(2, 0.8), np.zeros(2))
    view = view_of(solids, CAMERA)
    found = measured(view, solids, material, DepthNoise(quantum=0.0), np.random.default_rng(0))
    between = (found.depth > 1.1) & (found.depth < 1.9)
    lost = np.isinf(found.depth)
    edge = np.zeros_like(between)
    rows, columns = np.nonzero(view.solid == 0)
    edge[rows.min() - 1 : rows.max() + 2, columns.min() - 1 : columns.max() + 2] = True
    edge[rows.min() + 1 : rows.max(), columns.min() + 1 : columns.max()] = False
    assert between.sum() > 0.15 * edge.sum() and lost.sum() > 0.2 * edge.sum()
    assert not (between | lost)[~edge].any()


def test_without_errors_the_view_comes_back_and_depths_are_whole_units():
    solids = plate(1.5, turn=0.3)
    true, found = seen(solids, of_one(0.8, 0.7), NONE)
    seen_at_all = np.isfinite(found)
    np.testing.assert_array_equal(found[seen_at_all], true[seen_at_all])
    _, found = seen(solids, of_one(0.8), DepthNoise())
    np.testing.assert_allclose(found, np.rint(found / 0.001) * 0.001, atol=1e-12)


def test_errors_depend_on_the_seed_alone_and_offsets_are_the_images():
    one, same, other = (seen(plate(1.5), of_one(0.8), DepthNoise(), seed)[1] for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()
    offset = replace(NONE, offset=0.0037)
    pairs = (seen(plate(1.5), of_one(0.8), offset, seed) for seed in range(25))
    means = [np.mean(true - found) for true, found in pairs]
    assert np.std(means) == pytest.approx(0.0037, rel=0.4)
