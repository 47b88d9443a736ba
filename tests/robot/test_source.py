"""What a problem file says of its robot: names, options beside them, and fields that are wrong."""

import numpy as np
import pytest

from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.robot.loading import MOST_REACH, robot_from_source
from cvqmpt_lab.robot.source import ARMS


@pytest.mark.parametrize(
    "name", ["ur5", "xarm7", "z1", "so-arm", "tiago-no-hand", "talos-left-arm", "kinova"]
)
def test_an_arm_is_loaded_by_its_name(name):
    robot = robot_from_source({"name": name})
    assert robot.end_effector == ARMS[name].end_effector and 5 <= robot.dof <= 8
    assert (robot.upper > robot.lower).all() and 0.4 < robot.reach < MOST_REACH
    states = robot.random_configurations(np.random.default_rng(0), 20)
    assert all(np.linalg.norm(robot.pose(q)[:3, 3]) <= robot.reach for q in states)


def test_what_is_given_beside_a_name_overrides_it():
    source = {
        "name": "ur5",
        "locked": {"elbow_joint": 1.0},
        "end_effector": "ee_link",
        "acceleration_limits": 3.0,
    }
    robot = robot_from_source(source)
    assert robot.dof == 5 and robot.end_effector == "ee_link" and robot.source == source
    assert robot.acceleration_limits.tolist() == [3.0] * 5


@pytest.mark.parametrize(
    ("source", "pattern"),
    [
        ({"name": "panda", "fingeropening": 0.01}, "did you mean 'finger_opening'"),
        ({"name": "panda", "lock": {}}, r"robot\.lock is unknown; did you mean 'locked'"),
        ({"urdf": "a.urdf", "end_efector": "tool"}, "did you mean 'end_effector'"),
        ({"urdf": "a.urdf"}, r"robot\.end_effector is missing"),
        ({"urdf": "a.urdf", "end_effector": "tool", "name": "panda"}, r"robot\.name is unknown"),
        ({"urdf": 5, "end_effector": "tool"}, "urdf is 5"),
        ({"urdf": "arm.urdf", "end_effector": "tool", "locked": 3}, "locked is 3"),
        ({"name": "panda", "finger_opening": False}, "finger_opening is False"),
        ({"name": "panda", "finger_opening": "wide"}, "'wide'"),
        ({"name": "panda", "finger_opening": [0.01]}, "finger_opening"),
        ({"name": "ur5", "finger_opening": 0.01}, "the panda's, not that of 'ur5'"),
        ({"name": "panda", "locked": [1]}, "must be an object"),
        ({"name": "panda", "package_dirs": "x"}, "must be a list"),
        ({"name": "panda", "base": [0, 0]}, r"robot\.base has shape"),
        ({"name": "panda", "end_effector": 5}, "must be str"),
        ({"name": "ur55"}, "robot 'ur55'.*panda, ur3, ur5"),
        ({"name": True}, r"robot\.name is True"),
        ({"name": ["panda"]}, "name"),
        ({}, "robot needs 'name' .* or 'urdf' and 'end_effector'"),
        (0.5, "must be an object"),
        (None, "must be an object"),
    ],
    ids=str,
)
def test_a_wrong_field_of_a_robot_is_named(refused, source, pattern):
    refused(CvqmptError, pattern, robot_from_source, source)
