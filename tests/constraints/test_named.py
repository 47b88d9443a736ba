"""Regions by name: their bounds and errors."""

import numpy as np
import pytest
from constraints.test_task_space_region import displacement
from scipy.spatial.transform import Rotation

from cvqmpt_lab.codec import from_plain, to_plain
from cvqmpt_lab.constraints.named import Region
from cvqmpt_lab.constraints.task_space_region import upright, upright_box
from cvqmpt_lab.poses import pose


def region(data):
    return from_plain(Region, data, "constraint")


def inside(data, T_world_e):
    """Whether an end-effector pose (4, 4) satisfies a region, by its definition."""
    r = region(data)
    x = displacement(r, T_world_e)
    return bool(((x >= r.bounds[:, 0] - 1e-9) & (x <= r.bounds[:, 1] + 1e-9)).all())


def turned(xyz, rotvec):
    T = pose(xyz)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    return T


@pytest.mark.parametrize(("name", "kind"), [("upright", upright), ("upright-box", upright_box)])
def test_a_short_form_is_the_first_field_and_what_is_written_is_read_again(name, kind):
    in_full = {name: {"tilt": 0.1, "axis": "x"}}
    assert region({name: 0.1}) == region(in_full) == kind(0.1) != kind(0.2)
    assert region(to_plain(kind(0.2), Region)) == kind(0.2)


def test_the_box_is_the_papers_constraint_and_is_written_as_before_there_were_cones():
    np.testing.assert_array_equal(upright_box(0.2).Bw[4:], [[-0.2, 0.2]] * 2)
    assert set(to_plain(upright_box(0.2))) == {"T0_w", "Tw_e", "Bw"}
    assert to_plain(upright(0.2))["tilt"] == 0.2


@pytest.mark.parametrize("axis", ["x", "-x", "y", "-y", "z", "-z"])
def test_upright_keeps_any_axis_of_the_hand_up_and_leaves_yaw_free(axis):
    """To the angle asked for in any direction; the box lets a hand lean by more."""
    rng, fields, seen = np.random.default_rng(0), {"tilt": 0.2, "axis": axis}, set()
    zero = [region({name: {**fields, "tilt": 0.0}}) for name in ("upright", "upright-box")]
    direction = np.eye(3)["xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1)
    for _ in range(200):
        up = Rotation.align_vectors([[0, 0, 1]], [direction])[0]
        way = rng.uniform(-np.pi, np.pi)
        about = np.array([np.cos(way), np.sin(way), 0.0])
        tilt = Rotation.from_rotvec(rng.uniform(0.0, 0.5) * about)
        rotation = tilt * Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]) * up
        T = pose(rng.uniform(-1, 1, 3))
        T[:3, :3] = rotation.as_matrix()
        angle = np.arccos(np.clip((rotation.as_matrix() @ direction)[2], -1, 1))
        in_cone, in_box = inside({"upright": fields}, T), inside({"upright-box": fields}, T)
        assert in_cone == (angle <= 0.2)
        assert angle < 1.42 * 0.2 if in_box else angle > 0.63 * 0.2
        seen.add((in_cone, in_box))
        level = np.eye(4)
        level[:3, :3] = (tilt.inv() * rotation).as_matrix()
        assert all(np.abs(displacement(one, level)[one.bounded_rows]).max() < 1e-9 for one in zero)
    assert {(True, True), (False, True), (False, False)} <= seen


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
