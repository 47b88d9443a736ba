"""`cvqmpt robot`, and the options by which other commands name a robot."""

import json

import numpy as np
import pytest
from PIL import Image

from cli.main import main
from cvqmpt_lab.robot.loading import load_robot
from cvqmpt_lab.robot.self_collision import read_srdf
from cvqmpt_lab.robot.source import ARMS


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
