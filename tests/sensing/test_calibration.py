"""A camera's pose is found from the arm that it sees, or doubted."""

import json
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cli.main import main
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.poses import pose
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.sensing.calibration import Calibration, calibrate
from cvqmpt_lab.sensing.camera import KINECT, Camera, look_at
from cvqmpt_lab.sensing.filters import near_robot
from cvqmpt_lab.sensing.icp import arm_surface, point_to_plane_icp, small_motions
from cvqmpt_lab.sensing.noise import DepthNoise
from cvqmpt_lab.sensing.scan import Arm
from cvqmpt_lab.sensing.virtual import CameraSettings, arm_objects, views_of

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
CLEAR = 1017
"""Seed of a scan in which much of the arm is in view."""


GUESS = 0.1, 10.0  # [m], [deg] that guesses are wrong at most
PROMISED = 5.0, 0.5  # [mm], [deg]
CLUTTER = 12  # boxes on the floor


class ArmScan(NamedTuple):
    """What one noisy camera saw of an arm among boxes."""

    points: np.ndarray  # (m, 3) [m, camera frame]
    T_world_camera: np.ndarray  # (4, 4), the truth [m]
    T_world_guess: np.ndarray  # (4, 4), `GUESS` from it at most [m]
    arm: Arm


def arm_scan(robot: Robot, seed: int) -> ArmScan:
    """A scan with random boxes, configuration, camera, materials and noise."""
    rng = np.random.default_rng(seed)
    objects = [SceneObject("floor", Box((4.0, 4.0, 0.1)), pose((0.0, 0.0, -0.06)), obstacle=False)]
    for k in range(CLUTTER):
        azimuth, away = rng.uniform(-np.pi, np.pi), rng.uniform(0.35, 0.9)
        wide, deep, tall = rng.uniform((0.05, 0.05, 0.08), (0.2, 0.2, 0.4)).tolist()
        place = (away * np.cos(azimuth), away * np.sin(azimuth), 0.5 * tall)
        objects.append(
            SceneObject(f"box{k}", Box((wide, deep, tall)), pose(place, rng.uniform(0.0, 3.0)))
        )
    checker = CollisionChecker(robot, Scene("boxes", tuple(objects)))
    q = robot.random_configurations(rng, 1)[0]
    while checker.in_collision(q) or robot.pose(q)[2, 3] < 0.1:
        q = robot.random_configurations(rng, 1)[0]
    target = (0.0, 0.0, 0.4) + rng.normal(0.0, 0.1, 3)
    azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(np.radians(15.0), np.radians(60.0))
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    towards = np.cos(elevation) * level + (0.0, 0.0, np.sin(elevation))
    T = look_at(target + rng.uniform(1.2, 2.0) * towards, target)
    settings = CameraSettings(cameras=(Camera(KINECT, T),), errors=DepthNoise())
    (view,) = views_of(Scene("scan", (*objects, *arm_objects(robot, q))), settings, rng)
    wrong = np.concatenate([_in_ball(rng, np.radians(GUESS[1])), _in_ball(rng, GUESS[0])])
    points = (view.points - T[:3, 3]) @ T[:3, :3]
    return ArmScan(points, T, T @ small_motions(wrong[None])[0], Arm(robot, q))


def _in_ball(rng: np.random.Generator, radius: float) -> np.ndarray:
    """A vector (3,), uniform in a ball."""
    direction = rng.normal(size=3)
    return radius * rng.random() ** (1.0 / 3.0) * direction / np.linalg.norm(direction)


def pose_error(scan: ArmScan, found: Calibration) -> tuple[float, float]:
    """How wrong a calibration is [mm, deg]."""
    way = np.linalg.inv(scan.T_world_camera) @ found.T_world_camera
    turn = Rotation.from_matrix(way[:3, :3]).magnitude()
    return 1e3 * float(np.linalg.norm(way[:3, 3])), float(np.degrees(turn))


@pytest.fixture(scope="module")
def scan(panda):
    return arm_scan(panda, CLEAR)


def test_points_of_the_surface_are_aligned_with_it(panda):
    """Without noise the pose is exact."""
    rng = np.random.default_rng(1)
    surface = arm_surface(Arm(panda, HOME), 20_000, rng)
    T = pose((1.2, 0.4, 0.6), 2.0)
    ahead = np.einsum("si,si->s", surface.normals, T[:3, 3] - surface.points) > 0.0
    points = (surface.points[ahead] - T[:3, 3]) @ T[:3, :3]
    start = T @ small_motions(np.array([[0.02, -0.01, 0.02, 0.01, 0.01, -0.02]]))[0]
    found = point_to_plane_icp(points, surface, start, rng)
    assert np.abs(found.T_world_camera - T).max() < 1e-5 and found.residual < 1e-5


def test_a_pose_that_is_trusted_is_right(scan):
    found = calibrate(scan.points, scan.T_world_guess, scan.arm, np.random.default_rng(0))
    assert found.doubts == () and np.less(pose_error(scan, found), PROMISED).all()
    assert found.residual < 0.004 and found.confirmed > 0.9


@pytest.mark.parametrize("joint", [None, 1, 3])
def test_a_wrong_configuration_is_refused(scan, joint):
    rng = np.random.default_rng(0)
    robot = scan.arm.robot
    q = (
        robot.random_configurations(rng, 1)[0]
        if joint is None
        else scan.arm.q + 0.3 * np.eye(7)[joint]
    )
    assert calibrate(scan.points, scan.T_world_guess, Arm(robot, q), rng).doubts


def test_an_arm_that_is_not_in_the_picture_is_refused(scan):
    away = scan.T_world_camera @ small_motions(np.array([[0.0, 0.6, 0.0, 0.0, 0.0, 0.0]]))[0]
    turned = scan.points @ scan.T_world_camera[:3, :3].T
    beside = turned @ away[:3, :3]
    gone = near_robot(turned + scan.T_world_camera[:3, 3], *scan.arm, margin=0.05)
    found = calibrate(beside[~gone], away, scan.arm, np.random.default_rng(0))
    assert any(
        "too little of the arm" in doubt or "configuration" in doubt for doubt in found.doubts
    )


def test_a_camera_that_saw_nothing_is_an_error(scan):
    with pytest.raises(InvalidInputError, match="saw nothing"):
        calibrate(np.zeros((5, 3)), scan.T_world_guess, scan.arm, np.random.default_rng(0))


def test_the_command_writes_a_pose_only_if_it_is_trusted(scan, tmp_path, capsys):
    np.save(tmp_path / "scan.npy", scan.points)
    (tmp_path / "rough.json").write_text(
        json.dumps({"T_world_camera": scan.T_world_guess.tolist()})
    )
    for q, code in ((scan.arm.q, 0), (scan.arm.q + 0.3 * np.eye(7)[1], 1)):
        out = tmp_path / f"cam{code}.json"
        words = ["calibrate", str(tmp_path / "scan.npy"), "--guess", str(tmp_path / "rough.json")]
        assert main([*words, "--arm-at=" + ",".join(map(str, q)), "--out", str(out)]) == code
        assert out.exists() == (code == 0) and ("not trusted" in capsys.readouterr().out) == (
            code == 1
        )
