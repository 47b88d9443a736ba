"""Limits of MoveIt's joint_limits.yaml replace those of the URDF and of the arm."""

import json

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.robot.load import panda, robot_from_source

TEXT = """
default_velocity_scaling_factor: 0.1
joint_limits:
  panda_joint1:
    has_velocity_limits: true
    max_velocity: 1.5
    has_acceleration_limits: true
    max_acceleration: 3.75
    has_position_limits: true
    min_position: -1.0
    max_position: 4.0
  panda_joint2:
    has_velocity_limits: false
    max_velocity: 0.1
  panda_finger_joint1:
    has_velocity_limits: true
    max_velocity: 0.1
"""


@pytest.fixture
def with_limits(tmp_path):
    def load(text, source=None):
        (tmp_path / "joint_limits.yaml").write_text(text)
        return robot_from_source(
            {"name": "panda", **(source or {}), "joint_limits": str(tmp_path / "joint_limits.yaml")}
        )

    return load


def test_limits_of_the_file_replace_others(with_limits):
    robot, known = with_limits(TEXT), panda()
    first = np.arange(7) == 0
    np.testing.assert_array_equal(
        robot.velocity_limits, np.where(first, 1.5, known.velocity_limits)
    )
    own, others = robot.limits["acceleration"], known.limits["acceleration"]
    np.testing.assert_array_equal(own, np.where(first, 3.75, others))
    np.testing.assert_array_equal(robot.limits["jerk"], known.limits["jerk"])
    assert (robot.lower[0], robot.upper[0]) == (-1.0, known.upper[0])
    np.testing.assert_array_equal(robot.lower[1:], known.lower[1:])


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("panda_joint1", "joint1", "joint of joint_limits 'joint1'"),
        ("max_velocity: 1.5", "", "has has_velocity_limits: true, but no max_velocity"),
        ("max_velocity: 1.5", "max_velocity: fast", "max_velocity is 'fast'"),
        ("max_velocity: 1.5", "max_velocity: 0.0", "velocity limit 0.0 of joint 'panda_joint1'"),
        ("max_position: 4.0", "max_position: -2.0", "leave it no range: from -1 to -2"),
        ("max_velocity: 0.1", "max_speed: 0.1", "key of joint_limits.panda_joint2 'max_speed'"),
    ],
)
def test_wrong_files_are_one_line(with_limits, old, new, told):
    refused(told, with_limits, TEXT.replace(old, new, 1))


def test_a_joint_without_a_limit_is_named(with_limits, tmp_path):
    from cvqmpt_lab.robot.source import ARMS, example_robots

    urdf = str(example_robots() / ARMS["panda"].urdf)
    source = {"name": "", "urdf": urdf, "end_effector": "panda_hand"}
    told = "acceleration limits, but none of panda_joint2, .*: add max_acceleration"
    refused(told, with_limits, TEXT, source)


def test_tags_of_units_are_read_as_xacro_reads_them(with_limits):
    text = TEXT.replace("max_velocity: 1.5", "max_velocity: !degrees 60")
    text = text.replace("min_position: -1.0", "min_position: !degrees -45.0")
    robot = with_limits(text.replace("max_position: 4.0", "max_position: !radians 0.5"))
    np.testing.assert_allclose(robot.velocity_limits[0], np.pi / 3)
    np.testing.assert_allclose((robot.lower[0], robot.upper[0]), (-np.pi / 4, 0.5))


@pytest.mark.parametrize(
    "above",
    [
        ("robot_description_planning",),
        ("/**", "ros__parameters", "robot_description_planning"),
        ("arm", "move_group", "ros__parameters", "robot_description_planning"),
        ("/move_group", "ros__parameters"),
    ],
)
def test_limits_inside_parameters_of_ros_are_found(with_limits, above):
    inside = {"joint_limits": {"panda_joint1": {"has_velocity_limits": True, "max_velocity": 0.5}}}
    for name in reversed(above):
        inside = {name: inside}
    assert with_limits(json.dumps(inside)).velocity_limits[0] == 0.5


def test_parameters_with_limits_twice_or_without_are_refused(with_limits):
    limits = {"joint_limits": {"panda_joint1": {"has_velocity_limits": True, "max_velocity": 0.5}}}
    one = {"ros__parameters": limits}
    told = "joint_limits occur in /a.ros__parameters and in /b.ros__parameters; keep those of one"
    refused(told, with_limits, json.dumps({"/a": one, "/b": one}))
    other = {"/**": {"ros__parameters": {"use_sim_time": True}}}
    refused("its ROS parameters have no joint_limits", with_limits, json.dumps(other))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a:\n\t- b", "line 2, column 1: a tab; indent by blanks"),
        ("joint_limits: {panda_joint1: {max_velocity: 1.0}", "expected ',' or '}'"),
        ("? [a, b]\n: 1", "a key is a list or a mapping"),
        ("a: !!python/tuple [1]", "the tag !!python/tuple is not read"),
        ("a: !degrees fast", "!degrees has 'fast'; write a number"),
        ("joint_limits: {1: {}}", "unknown joint of joint_limits 1"),
        ("joint_limits: 2001-99-99", "a value that is none of its type"),
        ("[" * 3000, "nested too deeply"),
    ],
)
def test_malformed_text_is_one_line(with_limits, text, told):
    assert "\n" not in refused(told, with_limits, text)


def test_joints_without_an_effort_in_the_file_keep_the_one_of_the_urdf(with_limits):
    """A file with the effort of one joint was refused: none of the others were known."""
    text = "joint_limits: {panda_joint1: {has_effort_limits: true, max_effort: 50.0}}"
    known = panda().limits["effort"]
    np.testing.assert_array_equal(with_limits(text).limits["effort"], [50.0, *known[1:]])
    ur5 = "joint_limits: {shoulder_pan_joint: {has_effort_limits: true, max_effort: 100.0}}"
    robot = with_limits(ur5, {"name": "ur5"})
    assert robot.limits["effort"].tolist() == [100.0, *robot.model.upperEffortLimit[1:]]
