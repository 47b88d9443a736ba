"""Regions by name: their bounds and errors."""

import re

import numpy as np
import pytest
from constraints.test_task_space_region import displacement
from refusals import refused
from scipy.spatial.transform import Rotation

from cvqmpt_lab.codec import from_plain, to_plain
from cvqmpt_lab.constraints.named import Region
from cvqmpt_lab.constraints.task_space_region import upright
from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.poses import pose


def region(data):
    return from_plain(Region, data, "constraint")


def inside(data, T_world_e):
    """Whether an end-effector pose (4, 4) satisfies a region, by its definition."""
    r = region(data)
    x = displacement(r, T_world_e)
    return bool(((x >= r.Bw[:, 0] - 1e-9) & (x <= r.Bw[:, 1] + 1e-9)).all())


def turned(xyz, rotvec):
    T = pose(xyz)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    return T


def test_the_short_upright_is_the_papers_constraint():
    in_full = {"upright": {"tilt": 0.1, "axis": "x"}}
    assert region({"upright": 0.1}) == region(in_full) == upright(0.1)
    assert region(to_plain(upright(0.2), Region)) == upright(0.2)
    np.testing.assert_array_equal(upright(0.2).Bw[4:], [[-0.2, 0.2]] * 2)


@pytest.mark.parametrize("axis", ["x", "-x", "y", "-y", "z", "-z"])
def test_upright_keeps_any_axis_of_the_hand_up_and_leaves_yaw_free(axis):
    rng, data = np.random.default_rng(0), {"upright": {"tilt": 0.2, "axis": axis}}
    direction = np.eye(3)["xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1)
    for _ in range(50):
        up = Rotation.align_vectors([[0, 0, 1]], [direction])[0]
        about = np.append(np.eye(2)[rng.integers(2)], 0.0)
        tilt = Rotation.from_rotvec(rng.uniform(0.0, 0.4) * about)
        rotation = tilt * Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]) * up
        T = pose(rng.uniform(-1, 1, 3))
        T[:3, :3] = rotation.as_matrix()
        angle = np.arccos(np.clip((rotation.as_matrix() @ direction)[2], -1, 1))
        assert angle < 0.2 * np.sqrt(2) + 0.1 if inside(data, T) else angle > 0.1


def test_a_fixed_orientation_leaves_the_position_free():
    data = {"fixed-orientation": {"rpy": [0.1, 0.2, 0.3], "tolerance": 0.05}}
    there = Rotation.from_euler("xyz", [0.1, 0.2, 0.3])
    assert inside(data, turned((3.0, -2.0, 1.0), there.as_rotvec()))
    off = there * Rotation.from_rotvec([0.06, 0, 0])
    assert not inside(data, turned((3.0, -2.0, 1.0), off.as_rotvec()))


def test_planes_and_lines_hold_the_position_and_leave_the_rotation_free():
    plane = {"plane": {"point": [0, 0, 0.5], "normal": [0, 3, 4], "tolerance": 0.01}}
    across, along = np.array([0.0, 0.6, 0.8]), np.array([0.0, 0.8, -0.6])
    assert inside(plane, turned((5.0, 0.0, 0.5) + 2.0 * along, [1, 2, 0]))
    assert not inside(plane, turned((0.0, 0.0, 0.5) + 0.02 * across, [0, 0, 0]))
    line = {"line": {"point": [0, 0, 0.5], "direction": [0, 3, 4], "tolerance": 0.01}}
    assert inside(line, turned((0.0, 0.0, 0.5) - 7.0 * across, [1, 2, 0]))
    assert not inside(line, turned((0.02, 0.0, 0.5), [0, 0, 0]))


@pytest.mark.parametrize("length", [1e-300, 1.0, 1e300])
def test_a_normal_may_have_any_length(length):
    with np.errstate(all="raise"):
        found = region({"plane": {"point": [0, 0, 0.5], "normal": [0, 0.6 * length, 0.8 * length]}})
    np.testing.assert_allclose(found.T0_w[:3, 2], [0.0, 0.6, 0.8], atol=1e-15)


def test_a_pose_may_leave_the_yaw_free():
    data = {"pose": {"at": {"xyz": [0.4, 0, 0.6], "rpy": [np.pi, 0, 0]}, "yaw": 3.15}}
    there = turned((0.4, 0.0, 0.6), [np.pi, 0, 0])
    assert inside(data, there)
    yawed = turned((0.4, 0, 0.6), [0, 0, 2.0]) @ np.linalg.inv(pose((0.4, 0, 0.6)))
    assert inside(data, yawed @ there)
    assert not inside(data, there @ turned((0, 0, 0), [0.1, 0, 0]))
    assert not inside(data, pose((0.0, 0.001, 0.0)) @ there)
    assert len(region({"pose": {"at": {"xyz": [0.4, 0, 0.6]}}}).bounded_rows) == 6


def test_wrong_regions_are_refused_by_their_path():
    for data, told in (
        ({"uprigth": 0.1}, ".uprigth is unknown; did you mean 'upright'?; fields: T0_w, Tw_e, Bw,"),
        ({"upright": "0.1"}, ".upright.tilt is '0.1'; it must be a finite float"),
        ({"upright": {"axis": "w"}}, ".upright.axis 'w'; valid choices: x, -x"),
        ({"upright": 0.1, "plane": {}}, " has upright, plane; a region by name stands alone"),
        ({"plane": {"point": [0, 0, 0], "normal": [0] * 3}}, ".plane: the direction is 0, 0, 0"),
        ({"plane": {"point": [0, 0, 0]}}, ".plane.normal is missing; fields: normal, point, tol"),
    ):
        refused(re.escape(f"constraint{told}"), region, data, error=CvqmptError)
