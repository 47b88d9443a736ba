"""Starts and goals of a problem as ROS's JointState."""

import numpy as np
from refusals import refused

from cvqmpt_lab.problem import PlanningProblem


def test_starts_are_read_from_joint_states(problem, caplog):
    """In any order, with the fingers, which are not planned."""
    plain, names = problem.to_dict(), [*problem.robot.joint_names]
    message = {
        "header": {"frame_id": ""},
        "name": ["panda_finger_joint1", *names[::-1]],
        "position": [0.01, *problem.start.tolist()[::-1]],
        "velocity": [],
        "effort": [],
    }
    found = PlanningProblem.from_dict({**plain, "start": message})
    np.testing.assert_array_equal(found.start, problem.start)
    assert "start has joints that are not planned, which are left out: panda_fin" in caplog.text
    for changed, told in (
        ({"position": [0.0]}, "start has 8 names and 1 positions"),
        ({"name": names[:3], "position": [0.0] * 3}, "start has no value for panda_joint4"),
        ({"name": ["a", "a"], "position": [0.0] * 2}, "twice"),
        ({"effect": []}, "unknown key of start 'effect'"),
    ):
        wrong = {**plain, "start": message | changed}
        refused(told, PlanningProblem.from_dict, wrong)
