"""Robots with several end effectors: joints of all, poses of each, from names, URDFs and json."""

import numpy as np
import pinocchio as pin
import pytest
from properties.random_arms import ARMS, two_armed

from cvqmpt_lab.collision.solids import carried_pairs
from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.source import ARMS as NAMED
from cvqmpt_lab.robot.source import example_robots
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.scene.shapes import Box

DUAL = [name for name, arm in NAMED.items() if arm.end_effectors]


@pytest.mark.parametrize("name", ["baxter", pytest.param("tiago-pro", marks=pytest.mark.slow)])
def test_planned_joints_are_those_of_both_hands(name):
    """In the order of the model, each once: a lift that both hang on, too."""
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


def test_every_named_robot_of_two_hands_says_which():
    assert {"baxter", "tiago-pro", "tiago-dual", "pr2", "talos", "g1"} <= set(DUAL)
    for name in DUAL:
        assert NAMED[name].end_effector == "" and len(NAMED[name].end_effectors) == 2


@pytest.mark.parametrize("number", range(ARMS))
def test_poses_of_each_hand_are_pinocchio_s(number):
    robot = two_armed(number)
    states = robot.random_configurations(np.random.default_rng(0), 20)
    rotations, translations = link_poses(robot.kinematics, states)
    data = robot.model.createData()
    for hand in ("tool", "other_tool"):
        link, T_link_hand = robot.hand(hand)
        frame = robot.model.getFrameId(hand, pin.FrameType.BODY)
        for q, R, t, found in zip(
            states,
            rotations[:, link],
            translations[:, link],
            robot.poses(states, hand),
            strict=True,
        ):
            pin.framesForwardKinematics(robot.model, data, q)
            expected = data.oMf[frame].homogeneous
            np.testing.assert_allclose(found, expected, atol=1e-12)
            at = np.block([[R, t[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
            np.testing.assert_allclose(at @ T_link_hand, expected, atol=1e-12)


def test_hands_of_a_name_or_a_urdf_are_chosen_on_the_command_line(cvqmpt):
    """By name, other ones than the arm's own; in a URDF, any two frames."""
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
    """A tray between both grippers, held by one of them or by both; forearms are never excused."""
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
