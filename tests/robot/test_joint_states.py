"""JointState messages of ROS as configurations: of problem files and of the command line."""

import json

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import numbers_of

STATE = {
    "header": {"frame_id": ""},
    "name": ["bend", "rail", "lift", "twist", "left_wheel"],
    "position": [0.3, 0.1, 0.2, 0.4, 9.0],
    "velocity": [],
}


@pytest.mark.parametrize("message", [STATE, {"joint_state": STATE, "is_diff": False}])
def test_values_are_taken_by_name_and_other_joints_are_noted(slider_arm, message, caplog):
    assert numbers_of(slider_arm, message, "start") == [0.1, 0.2, 0.3, 0.4]
    assert caplog.messages == ["start: left_wheel are left out, they are not planned"]


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"position": [0.1]}, "start has 5 names and 1 positions"),
        ({"name": ["rail"] * 5}, "'rail' occurs twice"),
        ({"name": list("abcde")}, "start has joints .*; the robot has rail, lift"),
        ({"name": ["rail", *"bcde"]}, "start has no value for lift, bend, twist"),
        ({"position": ["fast", 0, 0, 0, 0]}, "start: bend is 'fast'"),
        ({"name": 3}, "name is 3; it must be a list"),
    ],
)
def test_states_that_do_not_fit_are_refused(slider_arm, changed, told):
    refused(told, numbers_of, slider_arm, STATE | changed, "start")


def test_a_file_with_a_joint_state_is_a_configuration_of_the_command_line(cvqmpt, tmp_path):
    q = [0.1, -0.5, 0.2, -2.0, 0.1, 1.5, 0.7]
    state = {"name": [f"panda_joint{k + 1}" for k in range(7)][::-1], "position": q[::-1]}
    (tmp_path / "state.yaml").write_text(json.dumps(state) + "\n---\n")
    found = json.loads(cvqmpt("fk", tmp_path / "state.yaml", "--json"))
    np.testing.assert_array_equal(found["q"], q)


def test_the_start_of_a_problem_may_be_a_joint_state(problem):
    """In any order, with the fingers, which are not planned."""
    message = {
        "name": ["panda_finger_joint1", *problem.robot.joint_names[::-1]],
        "position": [0.01, *problem.start.tolist()[::-1]],
    }
    found = PlanningProblem.from_dict({**problem.to_dict(), "start": message})
    np.testing.assert_array_equal(found.start, problem.start)
