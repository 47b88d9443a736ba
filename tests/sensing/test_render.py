"""Depth images of virtual cameras: against ray marching; culling; errors of depth cameras."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Sphere
from cvqmpt_lab.sensing.camera import (
    KINECT,
    Camera,
    DepthNoise,
    Intrinsics,
    cameras_on_sphere,
    look_at,
    measured,
    view_of,
)
from cvqmpt_lab.sensing.observation import solids_of

OCTAHEDRON = ConvexMesh(0.2 * np.concatenate([np.eye(3), -np.eye(3)]))


def tilted(xyz, yaw=0.0, roll=0.0):
    T = pose(xyz, yaw)
    T[:3, :3] @= Rotation.from_euler("x", roll).as_matrix()
    return T


@pytest.fixture(scope="module")
def mixed():
    """Scene with every kind of shape, rotated; one partly outside the image, one too near."""
    shapes = {
        "box": (Box((0.3, 0.5, 0.2)), tilted((0.1, 0.2, 0.1), 0.4, 0.7)),
        "cylinder": (Cylinder(0.15, 0.5), tilted((-0.2, -0.1, 0.3), 1.0, 1.1)),
        "flat": (Cylinder(0.3, 0.02), tilted((0.2, -0.4, -0.2), 0.0, 0.2)),
        "sphere": (Sphere(0.2), tilted((0.4, -0.2, 0.4))),
        "mesh": (OCTAHEDRON, tilted((0.3, 0.5, -0.2), 0.3, 0.5)),
        "wall": (Box((0.1, 3.0, 3.0)), tilted((1.2, 0.0, 0.0))),
        "rim": (Box((0.2, 0.2, 0.2)), tilted((0.0, 0.9, 0.0), 0.2, 0.0)),
        "close": (Sphere(0.1), tilted((-1.7, 0.1, 0.15))),
        "ground": (Box((50.0, 50.0, 9.0)), tilted((0.0, 0.0, -5.2))),
    }
    return Scene("mixed", tuple(SceneObject(name, *parts) for name, parts in shapes.items()))


def holds(item, points):
    """Return which points (m, 3) are in an object, without the code for rays."""
    T = item.T_world_object
    local = (points - T[:3, 3]) @ T[:3, :3]
    match item.shape:
        case Box(size):
            return (np.abs(local) <= np.divide(size, 2)).all(1)
        case Sphere(radius):
            return np.linalg.norm(local, axis=1) <= radius
        case Cylinder(radius, height):
            round_axis = np.linalg.norm(local[:, :2], axis=1) <= radius
            return round_axis & (np.abs(local[:, 2]) <= height / 2)
    return np.abs(local).sum(1) <= 0.2  # the octahedron


def camera_at(eye, target=(0.0, 0.0, 0.0), **lens):
    return Camera(Intrinsics.from_fov(**lens), look_at(eye, target))


def depth_image(scene, camera):
    return view_of(solids_of(scene.objects), camera).depth


def marched(scene, eye, lens, row, column, step=0.0005):
    """Return the depth at a pixel by ray marching from eye towards the origin, 45 deg high."""
    tall = np.tan(np.radians(22.5))
    x = ((column + 0.5) / lens.width * 2 - 1) * tall * lens.width / lens.height
    y = (1 - (row + 0.5) / lens.height * 2) * tall
    ahead = -np.array(eye) / np.linalg.norm(eye)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    t = np.arange(0.0, lens.far, step)
    points = eye + t[:, None] * (ahead + x * right + y * np.cross(right, ahead))
    entries = []
    for item in scene:
        inside = holds(item, points)
        first = np.flatnonzero(inside)
        if len(first) and first[0] > 0 and t[first[0]] >= lens.near:
            entries.append(t[first[0]])
    return min(entries, default=np.inf)


@pytest.mark.parametrize("eye", [(-2.0, 0.3, 0.4), (-0.6, -1.5, 1.2), (-1.0, 0.4, -1.3)], ids=str)
def test_depths_equal_those_of_ray_marching(mixed, eye):
    camera = camera_at(eye, width=40, height=30, near=0.5, far=4.0)
    depth = depth_image(mixed, camera)
    assert depth.shape == (30, 40)
    rng = np.random.default_rng(0)
    pixels = [(int(row), int(column)) for row, column in rng.integers(0, (30, 40), (150, 2))]
    expected = np.array([marched(mixed, eye, camera.intrinsics, *pixel) for pixel in pixels])
    found = np.array([depth[pixel] for pixel in pixels])
    with np.errstate(invalid="ignore"):
        grazing = (expected != found) & ~(np.abs(expected - found) <= 0.002)
    assert grazing.sum() <= 2  # rays that touch an edge for less than a step
    assert len(np.unique(np.round(expected, 1))) > 5


def test_a_camera_ignores_a_solid_that_contains_it():
    ground = SceneObject("ground", Box((9.0, 9.0, 2.0)), pose((0.0, 0.0, -1.5)), obstacle=False)
    ball = SceneObject("ball", Sphere(0.2), pose((0.0, 0.0, 0.0)))
    below, above = cameras_on_sphere(Intrinsics.from_fov(50, 50), (0.0,), (-60.0, 60.0))
    scene = Scene("s", (ground, ball))
    assert np.isfinite(depth_image(scene, above)).all()
    only_ball = depth_image(Scene("b", (ball,)), below)
    np.testing.assert_array_equal(depth_image(scene, below), only_ball)
    assert only_ball.min() == pytest.approx(1.8, abs=2e-3)  # the ball's pole


CAMERA = Camera(KINECT, look_at((-1.0, 0.0, 0.0)))
OTHERS = ("lateral", "offset", "scale", "multipath", "edge_lost", "edge_flying", "quantum")
NONE = DepthNoise(**{item.name: 0.0 for item in fields(DepthNoise)})
AXIAL = DepthNoise(**dict.fromkeys(OTHERS, 0.0))


def plate(distance, turn=0.0, size=9.0):
    """A thin plate `distance` [m] in front of the camera, rotated by `turn` [rad]."""
    T = pose((distance - 1.0, 0.0, 0.0)) @ pose((0.0, 0.0, 0.0), turn) @ pose((5e-4, 0.0, 0.0))
    return solids_of([SceneObject("plate", Box((1e-3, size, size)), T)])


def of_one(reflectivity, gloss=0.0):
    return np.array([reflectivity]), np.array([gloss])


def seen(solids, material, noise=AXIAL, seed=0):
    """Return true and measured depths in the middle of the picture."""
    view = view_of(solids, CAMERA)
    found = measured(view, solids, material, noise, np.random.default_rng(seed))
    middle = slice(134, 154), slice(140, 180)
    return view.depth[middle], found.depth[middle]


def spread(*args, **kwargs):
    """Return the standard deviation of the measured depths [m]."""
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
        (plate(1.5), of_one(0.8, gloss=0.7), (0.0, 0.2)),  # the mirrored light blinds the camera
        (plate(1.5, turn=0.4), of_one(0.8, gloss=0.7), (0.99, 1.0)),
    ],
    ids=["white", "end of the range", "dark and far", "grazing", "shiny", "shiny, turned"],
)
def test_a_surface_that_returns_little_light_has_no_depth(solids, material, share):
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


def test_without_errors_the_view_is_unchanged_and_depths_are_whole_units():
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
