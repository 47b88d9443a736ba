"""`cvqmpt robot`, and the options of other commands for a user's robot."""

import json

import numpy as np
import pytest
from command_line import refused, run_here
from PIL import Image

from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.source import ARMS
from cvqmpt_lab.scene.scene import Scene


def test_without_a_robot_the_names_are_listed(cvqmpt):
    assert [line.split()[0] for line in cvqmpt("robot").splitlines()] == list(ARMS)


def test_a_picture_is_written_in_the_format_of_its_name(cvqmpt, tmp_path, slider_arm_urdf, capsys):
    for name, head in (("a.png", b"\x89PNG"), ("a.pdf", b"%PDF"), ("a.jpg", b"\xff\xd8")):
        cvqmpt("robot", slider_arm_urdf, "--picture", tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(head)
    assert len(np.unique(np.asarray(Image.open(tmp_path / "a.png")))) > 20
    told = refused(capsys, "robot", slider_arm_urdf, "--picture", tmp_path / "a.svg")
    assert "suffix '.svg'; valid choices: .png, .jpg, .pdf" in told


@pytest.fixture
def arm_file(tmp_path, slider_arm):
    """Write a problem of the tests' slider arm without its slider; run in its folder."""

    def write(**fields):
        start, goals = [0.0] * 4, [[0.3, 0.2, -0.4, 1.0]]
        data = PlanningProblem("reach", slider_arm, Scene("empty", ()), start, goals).to_dict()
        data |= {"start": start[1:], "goals": [goals[0][1:]]}
        (tmp_path / "arm.json").write_text(json.dumps(data | fields))
        return tmp_path / "arm.json"

    return write


def test_joints_are_locked(cvqmpt, capsys, arm_file, slider_arm_urdf):
    file = arm_file()
    words = f"plan {file} --iterations 20000 --robot"
    hand = f"robot {slider_arm_urdf} --end-effector tool --out"
    robot = file.parent / "robot.json"
    cvqmpt(hand, robot)
    assert "robot slider_arm needs (4,)" in refused(capsys, *words.split(), robot)
    cvqmpt(hand, robot, "--lock", "rail=0.2")
    cvqmpt(words, robot)


def test_a_robot_file_has_every_option_and_paths_relative_to_it(cvqmpt, tmp_path, slider_arm_urdf):
    arm, file = tmp_path / "arms" / "arm.urdf", tmp_path / "robot.json"
    arm.parent.mkdir()
    arm.write_bytes(slider_arm_urdf.read_bytes())
    for name in ("a.srdf", "b.yaml"):
        (tmp_path / name).write_text('<robot name="slider_arm"/>' if name == "a.srdf" else "{}")
    limits = "--velocity 1 --acceleration 2 --jerk 30 --effort 40 --tool-speed 0.5,1"
    poses = "--base 0,0,0.1 --tool 0,0,0.1,0,0,0 --lock rail=0.2 --package-dir /tmp"
    flags = "--hard-limits --visual-as-collision --skip-missing-meshes --bodies hulls"
    words = f"robot {arm} --end-effector tool --srdf {tmp_path}/a.srdf {limits} {poses} {flags}"
    cvqmpt(words, "--out", file)
    data = json.loads(file.read_text())
    assert data["urdf"] == "arms/arm.urdf" and data["srdf"] == "a.srdf"
    assert data["package_dirs"] == ["/tmp"] and data["locked"] == {"rail": 0.2}
    assert data["frame_limits"] == {"tool/tool": {"speed": 0.5, "turning_speed": 1.0}}
    once = json.loads(cvqmpt(f"robot {file} --json"))
    assert once == json.loads(cvqmpt(words, "--json"))


def test_a_urdf_alone_is_a_robot_whose_end_effector_is_a_guess(cvqmpt, capsys, slider_arm_urdf):
    cvqmpt(f"fk 0,0,0,0 --robot {slider_arm_urdf}")
    run_here(["fk", "0,0,0,0", "--robot", slider_arm_urdf])
    assert "end effector tool is a guess; cvqmpt robot" in capsys.readouterr().err


def test_options_alone_speak_of_the_files_own_robot_whose_path_is_seen_from_the_file(
    cvqmpt, capsys, arm_file, slider_arm_urdf
):
    robot = {"urdf": "arm.urdf", "end_effector": "tool", "locked": {"rail": 0.0}}
    file = arm_file(robot=robot)
    (file.parent / "arm.urdf").write_bytes(slider_arm_urdf.read_bytes())
    words = f"plan {file} --iterations 20000"
    cvqmpt(words)
    changed = file.parent / "changed.json"
    cvqmpt(f"robot {file} --acceleration 2 --out", changed)
    cvqmpt(words, "--robot", changed, "--trajectory", file.parent / "t.csv")
    cvqmpt(f"robot {file} --lock bend=0 --out", changed)
    assert "robot slider_arm needs (2,)" in refused(capsys, *words.split(), "--robot", changed)


def test_an_arm_too_weak_for_its_own_weight_is_said(cvqmpt, tmp_path):
    weak = tmp_path / "weak.json"
    told = cvqmpt("robot panda --effort 87,30,87,87,12,12,12 --out", weak)
    assert "timing       the arm cannot hold itself up everywhere: joint 'panda_joint2'" in told
    notes = json.loads(cvqmpt("robot --json", weak))["notes"]
    assert "cannot hold itself up" in notes[-1]
    told = cvqmpt("problems new", tmp_path / "new.json", "--robot", weak)
    assert "note: the arm cannot hold itself up everywhere: joint 'panda_joint2'" in told
