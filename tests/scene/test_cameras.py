"""Depth cameras: rays against a search along them, what is culled, the published set-up, training's clouds."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.cameras import (
    BallCrop,
    BoxCrop,
    CameraSettings,
    DepthCamera,
    camera_cloud,
    cameras_on_sphere,
    depth_image,
    visible_points,
    voxel_means,
)
from cvqmpt_lab.scene.families import FAMILIES, family_scene
from cvqmpt_lab.scene.objects import CAN
from cvqmpt_lab.scene.random_scenes import random_scene
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Sphere
from cvqmpt_lab.training.paths import Shapes
from cvqmpt_lab.training.point_clouds import CloudSettings, CropSettings, sample_cloud
from experiments.labelled_scenes import SHAPES

OCTAHEDRON = ConvexMesh(
    0.2 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
)


def tilted(xyz, yaw, roll):
    T = pose(xyz, yaw)
    c, s = np.cos(roll), np.sin(roll)
    T[:3, :3] = T[:3, :3] @ [[1, 0, 0], [0, c, -s], [0, s, c]]
    return T


@pytest.fixture(scope="module")
def mixed():
    """Every kind of shape, turned, one behind the other, one half outside the picture, one far too close."""
    shapes = {
        "box": (Box((0.3, 0.5, 0.2)), tilted((0.1, 0.2, 0.1), 0.4, 0.7)),
        "cylinder": (Cylinder(0.15, 0.5), tilted((-0.2, -0.1, 0.3), 1.0, 1.1)),
        "flat": (Cylinder(0.3, 0.02), tilted((0.2, -0.4, -0.2), 0.0, 0.2)),
        "sphere": (Sphere(0.2), tilted((0.4, -0.2, 0.4), 0.0, 0.0)),
        "mesh": (OCTAHEDRON, tilted((0.3, 0.5, -0.2), 0.3, 0.5)),
        "wall": (Box((0.1, 3.0, 3.0)), tilted((1.2, 0.0, 0.0), 0.0, 0.0)),
        "rim": (Box((0.2, 0.2, 0.2)), tilted((0.0, 0.9, 0.0), 0.2, 0.0)),
        "close": (Sphere(0.1), tilted((-1.7, 0.1, 0.15), 0.0, 0.0)),
        "ground": (Box((50.0, 50.0, 9.0)), tilted((0.0, 0.0, -5.2), 0.0, 0.0)),
    }
    return Scene("mixed", tuple(SceneObject(name, *parts) for name, parts in shapes.items()))


def holds(item, points):
    """Whether points (m, 3) lie in an object; written apart from the rays."""
    T = item.T_world_object
    local = (points - T[:3, 3]) @ T[:3, :3]
    match item.shape:
        case Box(size):
            return (np.abs(local) <= np.divide(size, 2)).all(1)
        case Sphere(radius):
            return np.linalg.norm(local, axis=1) <= radius
        case Cylinder(radius, height):
            return (np.linalg.norm(local[:, :2], axis=1) <= radius) & (np.abs(local[:, 2]) <= height / 2)
    return np.abs(local).sum(1) <= 0.2  # the octahedron


def marched(scene, camera, settings, row, column, step=0.0005):
    """Depth at one pixel, by walking along its ray."""
    tall = np.tan(np.radians(settings.vertical_fov) / 2)
    x = ((column + 0.5) / settings.width * 2 - 1) * tall * settings.width / settings.height
    y = (1 - (row + 0.5) / settings.height * 2) * tall
    eye, ahead = np.array(camera.eye), np.subtract(camera.target, camera.eye)
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    t = np.arange(0.0, settings.far, step)
    points = eye + t[:, None] * (ahead + x * right + y * np.cross(right, ahead))
    entries = []
    for item in scene:
        inside = holds(item, points)
        first = np.flatnonzero(inside)
        if len(first) and first[0] > 0 and t[first[0]] >= settings.near:
            entries.append(t[first[0]])
    return min(entries, default=np.inf)


@pytest.mark.parametrize("eye", [(-2.0, 0.3, 0.4), (-0.6, -1.5, 1.2), (-1.0, 0.4, -1.3)], ids=str)
def test_depths_are_those_of_a_walk_along_the_rays(mixed, eye):
    camera, settings = DepthCamera(eye), CameraSettings(width=40, height=30, near=0.5, far=4.0)
    depth = depth_image(mixed, camera, settings)
    assert depth.shape == (30, 40)
    rng = np.random.default_rng(0)
    pixels = [
        (int(r), int(c)) for r, c in zip(rng.integers(0, 30, 150), rng.integers(0, 40, 150), strict=True)
    ]
    expected = np.array([marched(mixed, camera, settings, *pixel) for pixel in pixels])
    found = np.array([depth[pixel] for pixel in pixels])
    grazing = np.isfinite(expected) != np.isfinite(found)
    grazing |= (
        np.abs(np.where(np.isfinite(expected), expected, 0) - np.where(np.isfinite(found), found, 0)) > 0.002
    )
    assert grazing.sum() <= 2  # rays that touch an edge for less than the walk's step
    assert len(np.unique(np.round(expected, 1))) > 5


def test_every_object_is_seen_alone_as_among_others(mixed):
    """The nearest of single pictures, each culled to its own rectangle, is the picture of all."""
    camera, settings = DepthCamera((-2.0, 0.3, 0.4)), CameraSettings(width=60, height=60, near=0.2)
    alone = [depth_image(Scene("one", (item,)), camera, settings) for item in mixed]
    np.testing.assert_array_equal(np.min(alone, axis=0), depth_image(mixed, camera, settings))
    seen = {item.name for item, depth in zip(mixed, alone, strict=True) if np.isfinite(depth).any()}
    assert seen == {*mixed.names}
    farther = depth_image(mixed, camera, CameraSettings(width=60, height=60, near=0.5))
    assert (farther >= depth_image(mixed, camera, settings)).all()


def test_a_camera_looks_through_what_it_stands_in():
    ground = SceneObject("ground", Box((9.0, 9.0, 2.0)), pose((0.0, 0.0, -1.5)), obstacle=False)
    ball = SceneObject("ball", Sphere(0.2), pose((0.0, 0.0, 0.0)))
    below, above = cameras_on_sphere((0.0,), (-60.0, 60.0))
    settings = CameraSettings(width=50, height=50)
    scene = Scene("s", (ground, ball))
    assert np.isfinite(depth_image(scene, above, settings)).all()
    only_ball = depth_image(Scene("b", (ball,)), below, settings)
    np.testing.assert_array_equal(depth_image(scene, below, settings), only_ball)
    assert only_ball.min() == pytest.approx(
        1.8, abs=2e-3
    )  # the ball's pole, next to the middle of the picture
    hidden = CameraSettings(width=50, height=50, obstacles_only=True)
    np.testing.assert_array_equal(
        np.isfinite(depth_image(scene, above, hidden)),
        np.isfinite(depth_image(Scene("b", (ball,)), above, hidden)),
    )


def test_the_published_kitchen_cloud(open_kitchen):
    """About 79 800 points in the crop and 8 500 voxels were counted with another renderer."""
    scene = open_kitchen.with_objects(CAN.at_com("can", (0.5646, 0.1152, 0.271)))
    settings = CameraSettings()
    eyes = np.array([camera.eye for camera in settings.cameras])
    np.testing.assert_allclose(np.abs(eyes), [[1.0834, 1.0834, 1.2856]] * 4, atol=1e-4)
    points = visible_points(scene, settings)
    assert 79_000 < len(points) < 80_600
    assert BoxCrop().contains(points).all() and len(np.unique(points[:, 2] < 0)) == 2
    cloud = camera_cloud(scene, settings, np.random.default_rng(0))
    assert 8_000 < len(cloud) < 9_200
    can = np.linalg.norm(cloud[:, :2] - scene["can"].T_world_object[:2, 3], axis=1) < 0.05
    assert (can & (cloud[:, 2] > 0.2)).sum() > 50
    on_surface = np.zeros(len(points), dtype=bool)
    for item in scene:
        outer, inner = (
            holds(SceneObject("x", grown(item.shape, d), item.T_world_object), points) for d in (1e-6, -1e-6)
        )
        on_surface |= outer & ~inner
    assert on_surface.all()


def grown(shape, d):
    if isinstance(shape, Box):
        return Box(tuple(np.add(shape.size, 2 * d)))
    return Cylinder(shape.radius + d, shape.height + 2 * d)


def test_voxels_keep_means_and_cells():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (5000, 3))
    means = voxel_means(points, 0.25)
    low = points.min(0) - 0.125
    cells = {}
    for point in points:
        cells.setdefault(tuple(np.floor((point - low) / 0.25).astype(int)), []).append(point)
    np.testing.assert_allclose(means, [np.mean(cells[key], axis=0) for key in sorted(cells)], atol=1e-12)
    assert voxel_means(np.empty((0, 3)), 0.1).shape == (0, 3)


def test_clouds_depend_on_the_seed_alone_and_have_the_points_asked_for():
    scene = random_scene(5)
    settings = CameraSettings.like_training()
    one, same, other = (camera_cloud(scene, settings, np.random.default_rng(s)) for s in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert one.shape == other.shape == (1024, 3) and (one != other).any()
    small = Scene("dot", (SceneObject("dot", Sphere(0.05), pose((0.3, 0.0, 0.3))),))
    repeated = camera_cloud(small, CameraSettings(points=700), np.random.default_rng(0))
    assert repeated.shape == (700, 3) and 5 < len(np.unique(repeated, axis=0)) < 100
    assert camera_cloud(Scene("empty", ()), settings, np.random.default_rng(0)).shape == (0, 3)


def test_points_come_in_random_order():
    """Models take the neighbours of lowest index: an order by place would bias them."""
    cloud = camera_cloud(random_scene(5), CameraSettings(), np.random.default_rng(0))
    steps = np.linalg.norm(np.diff(cloud, axis=0), axis=1)
    assert np.median(steps) > 0.4


def training_cloud(scene, settings, seed):
    kinds, sizes, poses = [], [], []
    for item in scene.obstacles:
        kind, size = SHAPES[type(item.shape)](item.shape)
        kinds.append(kind), sizes.append(size), poses.append(item.T_world_object[:3])
    arrays = np.array(kinds, np.uint8), np.array(sizes, np.float32), np.array(poses, np.float32)
    return sample_cloud(Shapes(*arrays), settings, np.random.default_rng(seed))


def gap(a, b):
    """Mean distance from points a to the nearest of b [m]."""
    return cKDTree(b).query(a)[0].mean()


@pytest.mark.parametrize("family", FAMILIES)
def test_clouds_are_like_those_of_training(family):
    scene, plain = family_scene(family, 1), CloudSettings().without_augmentation()
    trained, again = (training_cloud(scene, plain, seed) for seed in (0, 1))
    ours = camera_cloud(scene, CameraSettings.like_training(), np.random.default_rng(0))
    published = camera_cloud(scene, CameraSettings(points=1024), np.random.default_rng(0))
    usual = gap(trained, again)
    assert gap(ours, trained) < 1.25 * usual  # no surface that training would not show
    inside = 1.7 if family == "kitchen-like" else 1.2  # cabinets are closed
    assert gap(trained, ours) < inside * usual
    assert gap(trained, ours) < gap(trained, published)
    crop = CropSettings()
    assert BallCrop() == BallCrop(crop.centre, crop.radius) and len(ours) == CloudSettings().points


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DepthCamera((1.0, 0.0, 0.0), (1.0, 0.0, 0.0)), "cannot look at"),
        (lambda: CameraSettings(width=0), "image of 0 x 224 pixels"),
        (lambda: CameraSettings(vertical_fov=180.0), "an angle between 0 and 180"),
        (lambda: CameraSettings(near=2.0, far=1.0), "give 0 < near < far"),
        (lambda: CameraSettings(voxel=0.0), "voxel of 0.0 m"),
        (lambda: CameraSettings(points=0), "cloud of 0 points"),
        (lambda: CameraSettings(noise=-0.1), "noise of -0.1 m"),
    ],
)
def test_settings_are_checked(make, message):
    with pytest.raises(InvalidInputError, match=message):
        make()


def test_an_object_that_is_a_cloud_already_is_refused():
    cloud = SceneObject("scan", PointCloud(np.eye(3), 0.01), np.eye(4))
    with pytest.raises(InvalidInputError, match="cannot see object 'scan', a PointCloud: use its points"):
        camera_cloud(Scene("s", (cloud,)), CameraSettings(), np.random.default_rng(0))


def test_a_camera_may_look_straight_down():
    scene = Scene("s", (SceneObject("box", Box((0.4, 0.4, 0.4)), np.eye(4)),))
    depth = depth_image(scene, DepthCamera((0.0, 0.0, 2.0)), CameraSettings(width=9, height=9))
    assert depth[4, 4] == pytest.approx(1.8)
