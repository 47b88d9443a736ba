"""A camera's pose is found from the arm that it sees, or doubted:
`cvqmpt bench calibration` counts over many scans.
"""

import json

import numpy as np
import pytest

from cli.main import main
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.poses import pose
from cvqmpt_lab.sensing.calibration import calibrate
from cvqmpt_lab.sensing.filters import near_robot
from cvqmpt_lab.sensing.icp import arm_surface, point_to_plane_icp, small_motions
from cvqmpt_lab.sensing.scan import Arm
from experiments.bench.perception import PROMISED, arm_scan, pose_error

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
CLEAR = 1017
"""Seed of a scan in which much of the arm is in view."""


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
