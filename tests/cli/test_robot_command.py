"""`cvqmpt robot`, and the options of other commands for a user's robot."""

import json

import numpy as np
import pytest
from command_line import refused
from PIL import Image

from cli.main import main
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.source import ARMS
from cvqmpt_lab.scene.scene import Scene


@pytest.fixture
def said(capsys):
    """Runs `cvqmpt robot`; returns its exit code and output."""

    def call(*words):
        code = main(["robot", *map(str, words)])
        return code, capsys.readouterr().out

    return call


def test_without_a_robot_the_names_are_listed(said):
    code, out = said()
    assert code == 0 and [line.split()[0] for line in out.splitlines()] == list(ARMS)


def test_a_picture_is_written(said, tmp_path, slider_arm_urdf):
    assert said(slider_arm_urdf, "--picture", tmp_path / "a.png")[0] == 0
    assert len(np.unique(np.asarray(Image.open(tmp_path / "a.png")))) > 20


@pytest.fixture
def arm_file(tmp_path, slider_arm):
    """A problem without constraint for the slider arm of the tests, in an empty scene."""
    problem = PlanningProblem(
        "reach", slider_arm, Scene("empty", ()), [0.0] * 4, [[0.3, 0.2, -0.4, 1.0]]
    )
    problem.save(tmp_path / "arm.json")
    return tmp_path / "arm.json"


def test_joints_are_locked(capsys, arm_file, slider_arm_urdf):
    data = json.loads(arm_file.read_text())
    data["start"], data["goals"] = data["start"][1:], [data["goals"][0][1:]]
    arm_file.write_text(json.dumps(data))
    words = f"plan --problem-file {arm_file} --urdf {slider_arm_urdf} --end-effector tool".split()
    assert "robot slider_arm needs (4,)" in refused(capsys, *words)
    words += ["--lock", "rail=0.2", "--iterations", "20000"]
    assert main(words) == 0


def test_options_alone_speak_of_the_files_own_robot_whose_path_is_seen_from_the_file(
    capsys, arm_file, slider_arm_urdf
):
    data = json.loads(arm_file.read_text())
    (arm_file.parent / "arm.urdf").write_bytes(slider_arm_urdf.read_bytes())
    locked = {"rail": data["start"][0]}
    data["robot"] = {"urdf": "arm.urdf", "end_effector": "tool", "locked": locked}
    data["start"], data["goals"] = data["start"][1:], [data["goals"][0][1:]]
    arm_file.write_text(json.dumps(data))
    words = ["plan", "--problem-file", str(arm_file), "--iterations", "20000"]
    assert main(words) == 0
    timed = ["--acceleration", "2", "--trajectory", str(arm_file.parent / "t.csv")]
    assert main([*words, *timed]) == 0
    capsys.readouterr()
    assert "robot slider_arm needs (2,)" in refused(capsys, *words, "--lock", "bend=0")
