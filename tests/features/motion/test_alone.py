"""A motion and a robot alone are judged: no start, no goal, no problem file."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import refused as refused_command
from refusals import refused

from cvqmpt_lab import JointState, Motion, judge, upright
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.cli.main import main
from cvqmpt_lab.features.motion.alone import robot_moving, with_unknown_limits
from cvqmpt_lab.features.motion.limit_use import Ends
from cvqmpt_lab.robot.load import load_robot, robot_from_source
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Sphere

READY = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
FOLDED = np.array([0.0, 0.0, 0.0, -3.05, 0.0, 0.0, 0.785])  # the hand touches the arm


@pytest.fixture(scope="module")
def so_arm():
    return robot_from_source({"name": "so-arm101"})


def eased(robot, begin, end, seconds=4.0, count=81):
    """Return a motion from rest to rest, by a polynomial of degree 7, with its rates."""
    t = np.linspace(0.0, 1.0, count)[:, None]
    share = np.polynomial.Polynomial([0, 0, 0, 0, 35, -84, 70, -20])
    begin, end = np.asarray(begin, dtype=float), np.asarray(end, dtype=float)
    q, v, a = (begin * (k == 0) + (end - begin) * share.deriv(k)(t) / seconds**k for k in range(3))
    return Motion(robot.joint_names, q, seconds * t[:, 0], v, a)


def test_a_motion_of_a_robot_alone_is_certified_or_its_fault_is_named(panda):
    motion = eased(panda, READY, READY + 0.3)
    judged = judge(motion, panda)
    assert judged.certified and judged.check.certificate.self_clearance.at_least_m > 0.0
    assert {"velocity", "acceleration", "jerk", "effort"} <= {u.kind for u in judged.check.uses}
    for wrong, kind in (
        (motion.at_speed(20.0), "velocity"),
        (eased(panda, READY, READY + 3.0 * np.eye(7)[0]), "limits"),
        (eased(panda, READY, FOLDED, 20.0), "collision"),
    ):
        judged = judge(wrong, panda)
        assert kind in {fault.kind for fault in judged.check.certificate.faults}, kind
    nan = Motion(None, np.where(motion.positions > 2.0, np.nan, motion.positions))
    nan.positions[3, 3] = np.nan
    assert judge(nan, panda).first_fault.text == "a state is not finite"


def test_scene_constraint_and_load_are_options(panda):
    motion = eased(panda, READY, READY + 0.3 * np.eye(7)[0])
    hand = panda.pose(READY)
    ball = Scene("ball", (SceneObject("ball", Sphere(0.05), hand),))
    assert judge(motion, panda, scene=ball).first_fault.kind == "collision"
    assert judge(motion, panda, constraint=[upright(0.1, "-z")]).certified
    tilted = eased(panda, READY, READY + 0.3 * np.eye(7)[5])
    assert judge(tilted, panda, constraint=[upright(0.1, "-z")]).first_fault.kind == "manifold"
    plate = Attachment("plate", Box((0.02, 1.6, 0.02)), pose((0.0, 0.0, 0.15)))
    near = Scene("near", (SceneObject("ball", Sphere(0.05), hand @ pose((0.0, 0.6, 0.15))),))
    assert judge(motion, panda, scene=near, attachments=[plate]).first_fault.kind == "collision"
    assert judge(motion, panda, scene=near).certified


def test_a_state_is_a_pair_a_message_or_a_mapping(panda):
    times = np.linspace(0.0, 0.3, 16)
    speed = 0.2 * np.eye(7)[0]
    chunk = Motion(None, READY + times[:, None] * speed, times)
    names = list(panda.joint_names)
    message = {
        "name": names[::-1],
        "position": READY[::-1].tolist(),
        "velocity": speed[::-1].tolist(),
    }
    for state in (
        JointState(READY, speed),
        JointState(READY.tolist(), speed.tolist()),
        (READY, speed),
        message,
        SimpleNamespace(**message, effort=[]),
    ):
        assert judge(chunk, panda, last=state).certified
    # at rest, the arm would have to reach this speed at once
    for state in (JointState(READY), {**message, "velocity": []}):
        assert judge(chunk, panda, last=state).first_fault.kind == "acceleration"
    refused("last: q has shape .6,.", judge, chunk, panda, JointState(READY[1:], speed))
    refused("last is no JointState", judge, chunk, panda, {"position": READY.tolist()})
    refused("last is no state", judge, chunk, panda, 3.0)


def test_a_part_without_a_current_state_may_move_at_its_begin(panda):
    times = np.linspace(0.0, 0.3, 16)
    chunk = Motion(None, READY + 0.2 * times[:, None] * np.eye(7)[0], times)
    assert not judge(chunk, panda).certified
    assert judge(chunk, panda, ends=Ends(part=True, moving=True)).certified


def test_limits_that_nobody_states_refuse_nothing(so_arm, slider_arm_urdf):
    motion = eased(so_arm, np.zeros(5), [0.4, 0.3, 0.2, 0.1, 0.5], 0.3)
    judged = judge(motion, so_arm)
    assert judged.certified and {"acceleration"}.isdisjoint(u.kind for u in judged.check.uses)
    assert any("accelerations are not judged" in note for note in judged_notes(so_arm))
    slow = load_robot(slider_arm_urdf, "tool")
    assert judge(eased(slow, np.full(4, 0.1), np.full(4, 0.2)), slow).certified


def judged_notes(robot):
    return with_unknown_limits(robot).notes


def test_a_gripper_that_the_motion_names_moves(so_arm):
    six = robot_moving(so_arm, ("gripper",))
    assert six.joint_names == (*so_arm.joint_names, "gripper")
    assert robot_moving(so_arm, ()) is so_arm
    q = np.zeros((2, 6))
    q[1, 5] = 1.0
    names = tuple(name for name in six.joint_names)
    assert judge(eased(six, *q), so_arm).check.states.shape[1] == 6
    wide = eased(six, q[0], [0, 0, 0, 0, 0, 3.0])
    assert "gripper leaves its limits" in judge(wide, so_arm).check.certificate.reasons[0]
    assert judge(Motion(names, wide.positions[:2] * 0), so_arm).certified


def test_what_belongs_to_a_problem_is_refused(problem, panda):
    motion = eased(panda, READY, READY + 0.1)
    refused("go with a robot alone", judge, motion, problem, scene=Scene("none", ()))
    refused("problem is a dict", judge, motion, {})
    refused("motion is a list", judge, [[0.0]], panda)


def test_the_command_needs_a_motion_and_a_robot(tmp_path, cvqmpt, capsys, panda, so_arm):
    motion = eased(panda, READY, READY + 0.3)
    path = tmp_path / "m.csv"
    rows = np.column_stack(
        [motion.times, motion.positions, motion.velocities, motion.accelerations]
    )
    header = ["time"] + [
        f"{n}_{k}" for k in ("position", "velocity", "acceleration") for n in panda.joint_names
    ]
    path.write_text(
        "\n".join([",".join(header), *(",".join(map(repr, row)) for row in rows.tolist())])
    )
    assert "certificate certified" in cvqmpt(f"certify {path} --robot panda")
    assert "problem panda alone" in cvqmpt(f"certify {path} --robot panda")
    assert "jerk used to" in cvqmpt(f"certify {path} --robot panda")
    cvqmpt(f"robot panda --velocity 0.05 --out {tmp_path / 'slow.json'}")
    assert "velocity limit" in cvqmpt(f"certify {path} --robot {tmp_path / 'slow.json'}", code=1)
    hand = panda.pose(READY + 0.3).tolist()
    ball = {
        "name": "b",
        "objects": [
            {"name": "ball", "shape": {"type": "sphere", "radius": 0.05}, "T_world_object": hand}
        ],
    }
    (tmp_path / "scene.json").write_text(json.dumps(ball))
    scene = f"certify {path} --robot panda --scene {tmp_path / 'scene.json'}"
    assert "in collision" in cvqmpt(scene, code=1)
    held = [
        {
            "name": "cup",
            "shape": {"type": "sphere", "radius": 0.02},
            "T_hand_object": np.eye(4).tolist(),
        }
    ]
    (tmp_path / "held.json").write_text(json.dumps(held))
    told = cvqmpt(f"certify {path} --robot panda --attachments {tmp_path / 'held.json'}")
    assert "1 carried pieces" in told
    told = cvqmpt(f"certify {path} --robot panda --constraint upright", code=1)
    assert "off the manifold" in told
    said = refused_command(capsys, "certify", path)
    assert "Give --robot" in said and "birrt" not in said and "kitchen" not in said
    said = refused_command(capsys, "certify", path, "--robot", "panda", "--attachments", path)
    assert "attachments" in said
    part = cvqmpt(f"certify {path} --robot panda --part --current", " ".join(map(str, READY)))
    assert "certificate certified" in part
    assert main(["certify", str(path), "--robot", "ur5"]) == 2
    assert "the robot has shoulder_pan_joint" in capsys.readouterr().err
