"""`cvqmpt robot`, and the options by which other commands name a robot of one's own."""

import json

import numpy as np
import pytest
from command_line import refused
from PIL import Image

from cli.main import main
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import load_robot
from cvqmpt_lab.robot.self_collision import read_srdf
from cvqmpt_lab.robot.source import ARMS
from cvqmpt_lab.scene.scene import Scene


@pytest.fixture
def said(capsys):
    """Runs `cvqmpt robot`; its exit code and what was printed."""

    def call(*words):
        code = main(["robot", *map(str, words)])
        return code, capsys.readouterr().out

    return call


def test_without_a_robot_the_names_are_listed(said):
    code, out = said()
    assert code == 0 and [line.split()[0] for line in out.splitlines()] == list(ARMS)


def test_an_urdf_alone_is_told_with_a_guess_of_its_end_effector(said, slider_arm_urdf):
    code, out = said(slider_arm_urdf)
    assert code == 0 and "end effector tool (a guess of tool: --end-effector names another)" in out
    assert "joint        rail: prismatic, -0.500 to 0.700 m, at most 1.00 m/s" in out
    assert "pairs        2 of pieces are checked; left out, of links: " in out


def test_everything_is_told_as_json(said, slider_arm_urdf):
    options = "--end-effector wrist --lock bend=0.5 --base 1,0,0,0,0,1.5 --acceleration 2 --json"
    code, out = said(slider_arm_urdf, *options.split())
    told = json.loads(out)
    robot = load_robot(slider_arm_urdf, "wrist", locked={"bend": 0.5}, acceleration_limits=2.0)
    assert code == 0 and [joint["name"] for joint in told["joints"]] == list(robot.joint_names)
    assert told["held_joints"] == [{"name": "bend", "value": 0.5, "reason": "as asked for"}]
    assert told["source"]["base"] == {"xyz": [1.0, 0.0, 0.0], "rpy": [0.0, 0.0, 1.5]}
    assert told["kinematics_digest"] != robot.kinematics_digest, "it stands elsewhere"


def test_a_picture_and_an_srdf_are_written(said, tmp_path, slider_arm_urdf):
    picture, srdf = tmp_path / "a.png", tmp_path / "a.srdf"
    assert said(slider_arm_urdf, "--picture", picture, "--srdf-out", srdf)[0] == 0
    assert len(np.unique(np.asarray(Image.open(picture)))) > 20
    assert read_srdf(srdf) == load_robot(slider_arm_urdf, "tool").left_out_pairs


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("robot ur55", "did you mean 'ur5'"),
        ("robot none.urdf", "cannot read URDF none.urdf"),
        ("robot ur5 --lock elbow_joint", "--lock 'elbow_joint': write JOINT=VALUE"),
        ("robot ur5 --base 1,2", "--base '1,2': write X,Y,Z"),
        ("robot ur5 --base 1,2,x", "--base '1,2,x': write numbers"),
        ("robot ur5 --picture /nowhere/a.png", "/nowhere does not exist"),
        ("plan --problem-file p.json --robot ur5 --urdf a.urdf", "--robot ur5 and --urdf a.urdf: give one"),
        ("plan place-task --base 0,0,0", "--robot or --urdf; give it"),
        ("plan --problem-file p.json --base 0,0,0", "cannot read problem file p.json"),
        ("plan --problem-file p.json --urdf a.urdf", "cvqmpt robot a.urdf suggests one"),
    ],
)
def test_what_cannot_be_is_one_line(capsys, words, says):
    assert main(words.split()) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1


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
