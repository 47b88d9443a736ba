"""Views of virtual cameras: rays against ray marching, culling, facing, points of images."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Sphere
from cvqmpt_lab.sensing.camera import (
    KINECT,
    Camera,
    Intrinsics,
    cameras_on_sphere,
    look_at,
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
    """Every kind of shape, turned, in a row; one half outside the image, one far too close."""
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
    """Whether points (m, 3) lie in an object, without code of the rays."""
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
    """Depth at a pixel by ray marching; camera at eye, looks at the origin, 45 deg high."""
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
def test_depths_are_those_of_a_walk_along_the_rays(mixed, eye):
    camera = camera_at(eye, width=40, height=30, near=0.5, far=4.0)
    depth = depth_image(mixed, camera)
    assert depth.shape == (30, 40)
    rng = np.random.default_rng(0)
    pixels = [(int(row), int(column)) for row, column in rng.integers(0, (30, 40), (150, 2))]
    expected = np.array([marched(mixed, eye, camera.intrinsics, *pixel) for pixel in pixels])
    found = np.array([depth[pixel] for pixel in pixels])
    with np.errstate(invalid="ignore"):
        grazing = (expected != found) & ~(np.abs(expected - found) <= 0.002)
    assert grazing.sum() <= 2  # rays that touch an edge for less than the walk's step
    assert len(np.unique(np.round(expected, 1))) > 5


def test_a_camera_looks_through_what_it_stands_in():
    ground = SceneObject("ground", Box((9.0, 9.0, 2.0)), pose((0.0, 0.0, -1.5)), obstacle=False)
    ball = SceneObject("ball", Sphere(0.2), pose((0.0, 0.0, 0.0)))
    below, above = cameras_on_sphere(Intrinsics.from_fov(50, 50), (0.0,), (-60.0, 60.0))
    scene = Scene("s", (ground, ball))
    assert np.isfinite(depth_image(scene, above)).all()
    only_ball = depth_image(Scene("b", (ball,)), below)
    np.testing.assert_array_equal(depth_image(scene, below), only_ball)
    assert only_ball.min() == pytest.approx(1.8, abs=2e-3)  # the ball's pole


def test_points_lie_where_a_pinhole_camera_puts_them(mixed):
    camera = Camera(KINECT, look_at((-1.4, 0.8, 0.9), (0.1, 0.0, 0.2)))
    view = view_of(solids_of(mixed.objects), camera)
    rows, columns = np.nonzero(np.isfinite(view.depth))
    z, focal = view.depth[rows, columns], 0.5 * 288 / np.tan(np.radians(0.5 * 65.0))
    seen = np.stack([(columns - 159.5) * z / focal, (rows - 143.5) * z / focal, z], axis=1)
    T = camera.T_world_camera
    np.testing.assert_allclose(seen @ T[:3, :3].T + T[:3, 3], view.points, atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0) and len(z) > 50_000
