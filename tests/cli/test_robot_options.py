"""A robot of one's own, named beside a problem file."""

import json

import pytest
from command_line import refused

from cli.main import main
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Scene


@pytest.fixture
def arm_file(tmp_path, slider_arm):
    """A problem without constraint for the slider arm of the tests, in an empty scene."""
    problem = PlanningProblem("reach", slider_arm, Scene("empty", ()), [0.0] * 4, [[0.3, 0.2, -0.4, 1.0]])
    problem.save(tmp_path / "arm.json")
    return tmp_path / "arm.json"


def test_a_robot_of_the_problem_file_is_replaced(capsys, arm_file, slider_arm_urdf):
    data = json.loads(arm_file.read_text())
    del data["robot"]  # the file may leave it to the command line
    arm_file.write_text(json.dumps(data))
    robot = ["--urdf", str(slider_arm_urdf), "--end-effector", "tool"]
    assert main(["plan", "--problem-file", str(arm_file), *robot, "--iterations", "20000"]) == 0
    assert "robot slider_arm" in capsys.readouterr().out


def test_joints_are_locked(capsys, arm_file, slider_arm_urdf):
    data = json.loads(arm_file.read_text())
    data["start"], data["goals"] = data["start"][1:], [data["goals"][0][1:]]
    arm_file.write_text(json.dumps(data))
    words = ["plan", "--problem-file", arm_file, "--urdf", slider_arm_urdf, "--end-effector", "tool"]
    assert "robot slider_arm needs (4,)" in refused(capsys, *words)
    words += ["--lock", "rail=0.2", "--iterations", "20000"]
    assert main([str(word) for word in words]) == 0


def test_options_alone_speak_of_the_files_own_robot_whose_path_is_seen_from_the_file(
    capsys, arm_file, slider_arm_urdf
):
    data = json.loads(arm_file.read_text())
    (arm_file.parent / "arm.urdf").write_bytes(slider_arm_urdf.read_bytes())
    data["robot"] = {"urdf": "arm.urdf", "end_effector": "tool", "locked": {"rail": data["start"][0]}}
    data["start"], data["goals"] = data["start"][1:], [data["goals"][0][1:]]
    arm_file.write_text(json.dumps(data))
    words = ["plan", "--problem-file", str(arm_file), "--iterations", "20000"]
    assert main(words) == 0
    assert main([*words, "--acceleration", "2", "--trajectory", str(arm_file.parent / "t.csv")]) == 0
    capsys.readouterr()
    assert "robot slider_arm needs (2,)" in refused(capsys, *words, "--lock", "bend=0")


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["--urdf", "URDF", "--end-effector", "nope"], "unknown end-effector frame 'nope'"),
        (["--urdf", "URDF"], "--end-effector FRAME"),
        (["--urdf", "/nope.urdf", "--end-effector", "tool"], "/nope.urdf"),
        (["--end-effector", "nope"], "unknown end-effector frame 'nope'"),
        (["--lock", "rail=0"], "robot slider_arm needs (3,)"),
        (["--urdf", "URDF", "--end-effector", "tool", "--lock", "nope=0"], "unknown joint to lock 'nope'"),
        (["--urdf", "URDF", "--end-effector", "tool", "--lock", "rail"], "JOINT=VALUE"),
        (["--urdf", "URDF", "--end-effector", "tool", "--lock", "rail=nan"], "finite number"),
        (["--urdf", "URDF", "--end-effector", "tool", "--srdf", "/nope.srdf"], "/nope.srdf"),
    ],
)
def test_a_bad_robot_is_refused_by_name(capsys, arm_file, slider_arm_urdf, words, found):
    words = [str(slider_arm_urdf) if word == "URDF" else word for word in words]
    assert found in refused(capsys, "plan", "--problem-file", arm_file, *words)
