"""`cvqmpt robot`, and the options of other commands for a user's robot."""

import json

import numpy as np
import pytest
from command_line import refused
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
    words = f"plan --problem-file {arm_file()} --urdf {slider_arm_urdf} --end-effector tool"
    assert "robot slider_arm needs (4,)" in refused(capsys, *words.split())
    cvqmpt(words, "--lock", "rail=0.2", "--iterations", "20000")


def test_options_alone_speak_of_the_files_own_robot_whose_path_is_seen_from_the_file(
    cvqmpt, capsys, arm_file, slider_arm_urdf
):
    robot = {"urdf": "arm.urdf", "end_effector": "tool", "locked": {"rail": 0.0}}
    file = arm_file(robot=robot)
    (file.parent / "arm.urdf").write_bytes(slider_arm_urdf.read_bytes())
    words = f"plan --problem-file {file} --iterations 20000"
    cvqmpt(words)
    cvqmpt(words, "--acceleration", 2, "--trajectory", file.parent / "t.csv")
    assert "robot slider_arm needs (2,)" in refused(capsys, *words.split(), "--lock", "bend=0")
