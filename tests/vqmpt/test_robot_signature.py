"""Weights are compared with the robot at hand by joints, limits and kinematics."""

import json
from dataclasses import replace

import pytest

from cvqmpt_lab.codec.plain import from_plain, to_plain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.weights import OtherRobotError, RobotSignature

ARM = RobotSignature("arm", (-1.0, -1.0), (2.0, 2.0), ("shoulder", "elbow"), "0123456789")
OLD = RobotSignature("arm", ARM.lower, ARM.upper)


def test_the_same_robot_may_have_another_name_or_less_on_record():
    ARM.require_same(replace(ARM, name="my arm", upper=(2.0, 2.00001)))
    ARM.require_same(OLD)
    OLD.require_same(ARM)


@pytest.mark.parametrize(
    ("weights", "robot", "message"),
    [
        (ARM, replace(ARM, lower=(0.0,), upper=(1.0,), joints=()), "not this one: 2 joints, not 1"),
        (ARM, replace(ARM, joints=("shoulder", "wrist")), "joint 'elbow', not 'wrist'"),
        (ARM, replace(ARM, upper=(2.0, 2.5)), "upper limit of joint 1 2, not 2.5"),
        (
            ARM,
            replace(ARM, kinematics="fedcba9876"),
            r"placed otherwise \(kinematics 01234567, not fedcba98\)",
        ),
        (OLD, replace(ARM, name="leg"), "not 'leg': another name, and no digest to compare"),
    ],
)
def test_another_robot_is_refused_with_the_difference(weights, robot, message):
    with pytest.raises(OtherRobotError, match=f"for robot 'arm', .*{message}"):
        weights.require_same(robot)


def test_signatures_survive_json_and_earlier_versions_are_read():
    assert from_plain(RobotSignature, json.loads(json.dumps(to_plain(ARM)))) == ARM
    earlier = {"name": "arm", "lower": [-1, -1], "upper": [2, 2]}
    assert from_plain(RobotSignature, earlier) == OLD


@pytest.mark.parametrize(
    "change",
    [
        {"name": 3},
        {"lower": "low"},
        {"lower": ["-1", "-1"]},
        {"upper": [10**400, 2]},
        {"upper": [float("nan"), 2]},
        {"lower": [3, 3]},
        {"lower": [], "upper": []},
        {"joints": "elbow"},
        {"joints": ["elbow"]},
        {"kinematics": 5},
    ],
)
def test_what_is_no_signature_is_refused(change):
    with pytest.raises(InvalidInputError, match=r"^config: robot"):
        from_plain(RobotSignature, to_plain(ARM) | change, "config: robot")
