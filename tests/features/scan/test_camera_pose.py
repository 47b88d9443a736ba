"""A scan says where its cameras are and look; poses that are written wrongly give a warning."""

import json

import numpy as np
import pytest
from command_line import run_here
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.poses import rigid
from cvqmpt_lab.features.scan.camera_pose import Region, camera_text, pose_doubts
from cvqmpt_lab.scene.cloud_files import Cloud, write_cloud
from cvqmpt_lab.sensing.crop import Crop

CROP = Crop(kind="box", lower=(-0.2, -1.0, -0.2), upper=(1.2, 1.0, 1.0))


def looking(place, target):
    """Pose (4, 4) of a camera at a place (3,) that looks at a target (3,), without roll."""
    z = np.subtract(target, place) / np.linalg.norm(np.subtract(target, place))
    x = np.cross(z, (0.0, 0.0, 1.0))
    x /= np.linalg.norm(x)
    return rigid(np.stack([x, np.cross(z, x), z], axis=1), np.array(place))


def seen_from(T):
    """A table of 0.8 m with a block on it, as a camera at a pose (4, 4) sees it."""
    x, y = np.meshgrid(np.arange(0.2, 1.0, 0.01), np.arange(-0.4, 0.4, 0.01))
    z = np.where((np.abs(x - 0.6) < 0.1) & (np.abs(y) < 0.1), 0.1, 0.0)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return (points - T[:3, 3]) @ T[:3, :3]


def w_first(T):
    """The pose that is read if a quaternion is written w, x, y, z."""
    return rigid(
        Rotation.from_quat(np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)).as_matrix(),
        T[:3, 3],
    )


def test_the_line_on_a_camera_says_where_it_is_and_where_it_looks():
    T = looking((1.2, 0.5, 0.9), (0.6, 0.0, 0.0))
    told = camera_text(Cloud(seen_from(T), 0, T))
    assert told.startswith("0.90 m above the base, 1.20 m in front of it, 0.50 m to its left, ")
    assert "looks 49 deg down towards (0.6" in told and "rolled" not in told
    rolled = T @ rigid(Rotation.from_euler("z", -30, degrees=True).as_matrix(), np.zeros(3))
    assert "down, rolled by 30 deg, towards" in camera_text(Cloud(seen_from(T), 0, rolled))
    below = rigid(np.eye(3), np.array([-0.5, -0.2, -1.0]))
    told = camera_text(Cloud(np.array([[0.0, 0.0, 2.0]]), 0, below))
    assert told.startswith("1.00 m below the base, 0.50 m behind it, 0.20 m to its right, ")
    assert told.endswith("looks 90 deg up towards (-0.50, -0.20, 1.00)")
    assert "no pose given" in camera_text(Cloud(np.ones((3, 3))))
    assert "z must point forward" in camera_text(Cloud(-np.ones((3, 3)), 0, T))


PLACES = [(1.2, 0.5, 0.9), (0.0, -0.8, 0.7), (0.1, 0.0, 0.9), (1.4, 0.0, 0.6), (0.6, 0.9, 0.9)]


@pytest.mark.parametrize("crop", [None, CROP])
@pytest.mark.parametrize("place", PLACES)
def test_a_right_pose_is_not_doubted_and_a_quaternion_with_w_first_is(place, crop):
    """It passed in silence, and a motion in the wrong scene was certified."""
    T = looking(place, (0.6, 0.0, 0.05))
    points, region = seen_from(T), Region(crop, 1.2)
    for quaternion in (False, True):
        assert pose_doubts(Cloud(points, 0, T), region, quaternion) == ""
    told = pose_doubts(Cloud(points, 0, w_first(T)), region, True)
    assert "if its quaternion has w first (w last is read: x, y, z, w), it looks" in told


@pytest.mark.parametrize("place", PLACES[:4])
def test_an_inverted_pose_is_doubted(place):
    T = looking(place, (0.6, 0.0, 0.05))
    told = pose_doubts(Cloud(seen_from(T), 0, np.linalg.inv(T)), Region(CROP, 1.2), False)
    assert "if it is the inverse of the camera's pose, it looks" in told


def test_a_camera_below_or_upwards_or_beside_the_crop_is_doubted():
    up = looking((0.5, 0.0, 0.3), (0.6, 0.0, 1.2))
    ahead = np.array([[0.0, 0.0, 0.5], [0.01, 0.0, 0.5]])
    cases = [(up, None, "looks 84 deg up")]
    cases.append((looking((0.5, 0, -0.4), (0.5, 0.5, -0.5)), None, "0.40 m below the base"))
    cases.append((looking((2.0, 0, 0.5), (3.0, 0.0, 0.2)), CROP, "100% of its points are outside"))
    for T, crop, doubt in cases:
        for quaternion in (False, True):
            told = pose_doubts(Cloud(ahead, 0, T), Region(crop, 5.0), quaternion)
            assert doubt in told and ("order x, y, z, w" in told) == quaternion


def test_the_command_prints_the_camera_and_warns(tmp_path, cvqmpt, caplog):
    T = looking((1.2, 0.5, 0.9), (0.6, 0.0, 0.05))
    write_cloud(tmp_path / "a.ply", seen_from(T))
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    poses = {"right": quaternion, "wrong": [quaternion[3], *quaternion[:3]]}
    for name, numbers in poses.items():
        pose = {"xyz": T[:3, 3].tolist(), "quaternion": numbers}
        (tmp_path / f"{name}.json").write_text(json.dumps(pose))
    told = cvqmpt("scan", tmp_path / "a.ply", "--extrinsics", tmp_path / "right.json")
    assert "camera      0.90 m above the base, 1.20 m in front of it" in told
    assert "quaternion" not in caplog.text
    run_here(["scan", tmp_path / "a.ply", "--extrinsics", tmp_path / "wrong.json"])
    assert f"camera of {tmp_path / 'a.ply'}: " in caplog.text and "has w first" in caplog.text
    told = cvqmpt("scan", tmp_path / "a.ply", tmp_path / "a.ply")
    assert told.count("camera      a.ply: no pose given") == 2
