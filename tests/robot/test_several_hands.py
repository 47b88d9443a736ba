"""Robots with several end effectors: their joints and frames, from names, URDFs and JSON."""

import numpy as np
import pytest

from cvqmpt_lab.base.errors import UnknownChoiceError
from cvqmpt_lab.collision.carried import carried_pairs
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.source import ARMS as NAMED
from cvqmpt_lab.robot.source import example_robots
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.scene.shapes import Box


@pytest.mark.parametrize("name", ["baxter", pytest.param("tiago-pro", marks=pytest.mark.slow)])
def test_planned_joints_are_those_of_both_hands(name):
    """A joint that moves both hands, such as the lift of the torso, is listed once."""
    robot = robot_from_source({"name": name})
    alone = [
        robot_from_source({"name": name, "end_effector": hand}).joint_names
        for hand in robot.end_effectors
    ]
    assert set(robot.joint_names) == set().union(*alone)
    assert len(robot.joint_names) == len(set(robot.joint_names)) == robot.dof
    shared = set(alone[0]) & set(alone[1])
    assert shared == ({"torso_lift_joint"} if name == "tiago-pro" else set())
    for hand, names in zip(robot.end_effectors, alone, strict=True):
        moves = robot.kinematics.moves[:, robot.hand(hand)[0]]
        assert set(np.array(robot.joint_names)[moves]) == set(names)


def test_hands_of_a_name_or_a_urdf_are_chosen_on_the_command_line(cvqmpt):
    """Frames other than those of the named arm, and any two frames of a URDF file."""
    urdf = example_robots() / NAMED["baxter"].urdf
    frames = "left_wrist", "right_gripper"
    for robot in ("baxter", urdf):
        said = cvqmpt("robot", robot, "--end-effectors", *frames)
        assert "end effector left_wrist and right_gripper" in said
        assert "baxter: 14 joints" in said
    assert "baxter: 7 joints" in cvqmpt("robot baxter --end-effector left_gripper")


def test_the_source_in_json_makes_the_same_robot():
    frames = ["right_gripper", "left_wrist"]
    robot = robot_from_source({"name": "baxter", "end_effectors": frames})
    again = robot_from_source(dict(robot.source))
    assert [*again.end_effectors] == frames and again.end_effector == frames[0]
    assert again.joint_names == robot.joint_names
    with pytest.raises(UnknownChoiceError, match="'left_gripper'"):
        robot.hand("left_gripper")


@pytest.mark.parametrize("carrier", ["left_gripper", "right_gripper"])
def test_what_both_hands_hold_may_touch_both_and_nothing_else(carrier):
    """A tray is held by one gripper or by both; it must never touch a forearm."""
    robot = robot_from_source({"name": "baxter"})
    other = next(hand for hand in robot.end_effectors if hand != carrier)
    one = Attachment("tray", Box((0.1, 0.1, 0.1)), np.eye(4), end_effector=carrier)
    rigid = {
        hand: {piece.name for piece in robot.links if piece.link == robot.hand(hand)[0]}
        for hand in robot.end_effectors
    }
    names = [piece.name for piece in robot.links]
    for also, excused in (((), rigid[carrier]), ((other,), rigid[carrier] | rigid[other])):
        held = one.changed(also_held_by=also)
        with_tray = {names[k] for k, _ in carried_pairs(robot, (held,))}
        assert with_tray == set(names) - excused
