"""Effort limits with which an arm cannot hold itself up are said before any motion is planned."""

from cvqmpt_lab.robot.dynamics import too_weak
from cvqmpt_lab.robot.load import panda, robot_from_source


def test_joints_too_weak_for_the_arm_s_weight_are_named():
    assert too_weak(panda()) == ""
    weak = robot_from_source({"name": "panda", "effort_limits": [87, 30, 87, 87, 12, 12, 12]})
    said = too_weak(weak)
    assert "joint 'panda_joint2' needs up to 5" in said
    assert "of 30 Nm (too much in" in said
    assert "panda_joint4" not in said
    assert "give --effort" in said


def test_an_arm_without_masses_or_limits_is_not_judged(slider_arm):
    assert too_weak(slider_arm) == ""
