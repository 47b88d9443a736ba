"""Problem files of two hands that are wrong: each one line that says what, and by how much."""

import json

import pytest
from command_line import refused

from cvqmpt_lab.benchmarks.two_arms import two_arms_problem

OFF = 0.05  # [rad] of a wrist at the start


@pytest.fixture(scope="module")
def tray():
    """The json form of a tray that baxter's hands carry over a table."""
    return json.dumps(two_arms_problem(0).to_dict())


def apart(data, metres=3.0):
    data["constraint"][0]["T0_w"] = {"xyz": [0.0, metres, 0.0]}


def apart_from_a_region(data):
    apart(data)
    del data["start"]
    data["start_region"] = data["goal_region"]


def closed_twice(data):
    """Two grasps of the second hand at once."""
    other = {**data["constraint"][0], "T0_w": {"xyz": [0.0, 0.5, 0.0]}}
    data["constraint"].append(other)


def level_and_on_edge(data):
    data["constraint"].append({"upright": {"tilt": 0.1, "axis": "y"}})


def relative_to(base):
    def spoil(data):
        at = {"xyz": [0.0, 0.0, 0.1]}
        data["constraint"].append({"relative-pose": {"base": base, "at": at}})

    return spoil


def named(where, field, value):
    def spoil(data):
        (data[where][0] if isinstance(data[where], list) else data[where])[field] = value

    return spoil


HOLD = "left_gripper and right_gripper cannot both hold on: the best of 100 tries breaks `pose` by"
UNKNOWN = "unknown end effector of robot baxter 'nope'; valid choices: left_gripper, right_gripper"
SPOILED = {
    "hands too far apart": (apart, "start breaks `pose`", "constraint[0]: " + HOLD),
    "and no start": (apart_from_a_region, "no start in 'start_region'", "constraint[0]: " + HOLD),
    "two grasps": (closed_twice, "constraint[0] and constraint[2] contradict each other", "|F| = "),
    "two angles": (level_and_on_edge, "constraint[1] and constraint[2] contradict", "|F| = "),
    "one link": (relative_to("left_gripper"), "'left_gripper' and end effector 'left_gripper'", ""),
    "a rigid link": (relative_to("left_wrist"), "do not move against each other", "leave the reg"),
    "region": (named("constraint", "end_effector", "nope"), UNKNOWN, ""),
    "base": (named("constraint", "base", "nope"), "unknown frame of robot baxter 'nope'", "torso"),
    "goal": (named("goal_region", "end_effector", "nope"), UNKNOWN, ""),
    "carried": (named("attachments", "end_effector", "nope"), UNKNOWN, ""),
    "held": (named("attachments", "also_held_by", ["nope"]), UNKNOWN, ""),
    "held twice": (
        named("attachments", "also_held_by", ["left_gripper"]),
        "end effectors that hold attachment 'tray': 'left_gripper' occurs twice",
        "",
    ),
    "both fields": (
        named("robot", "end_effector", "left_gripper"),
        "'end_effector' and 'end_effectors': give one of the two",
        "",
    ),
    "one frame twice": (
        named("robot", "end_effectors", ["left_gripper", "left_gripper"]),
        "robot.end_effectors: 'left_gripper' occurs twice",
        "",
    ),
}


@pytest.mark.parametrize("what", SPOILED)
def test_what_is_wrong_is_said_in_one_line(capsys, tray, tmp_path, what):
    (spoil, told, more), data, path = SPOILED[what], json.loads(tray), tmp_path / "mine.json"
    data["robot"].setdefault("end_effectors", ["left_gripper", "right_gripper"])
    spoil(data)
    path.write_text(json.dumps(data))
    line = refused(capsys, "plan", "--problem-file", path)
    assert told in line and more in line, line


def test_a_start_off_the_chain_is_refused_with_F_or_projected(cvqmpt, capsys, tray, tmp_path):
    data, path = json.loads(tray), tmp_path / "mine.json"
    data["start"][6] += OFF
    path.write_text(json.dumps(data))
    line = refused(capsys, "plan", "--problem-file", path)
    assert f"start breaks `pose` by {OFF:g} rad" in line and "|F| = 0.0" in line
    assert "--project-start" in line
    assert "certificate valid" in cvqmpt("plan --project-start --problem-file", path)
