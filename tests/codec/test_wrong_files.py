"""A wrong problem or task file gives one line: the file, the path of the field, the cure."""

import json

import numpy as np
import pytest
from command_line import refused as refused_command
from refusals import DATA, refused, table

from cvqmpt_lab.benchmarks.two_arms import two_arms_problem
from cvqmpt_lab.planning.usable import check_problem
from cvqmpt_lab.problem import PlanningProblem

TABLE = table("wrong_problems")  # column value: JSON; empty: the field is deleted
READY = [0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8]
SPHERE = {"type": "sphere", "radius": 0.1}
BALL = {"name": "b", "shape": SPHERE, "T_world_object": {"xyz": [2, 0, 0]}}
GOOD = {
    "schema": "cvqmpt-problem/1",
    "name": "mine",
    "robot": {"name": "panda"},
    "scene": {"name": "room", "objects": [BALL]},
    "constraint": [{"T0_w": {"xyz": [0.4, 0, 0.5]}, "Tw_e": {}, "Bw": [[-1, 1]] * 6}],
    "attachments": [{"name": "can", "shape": SPHERE, "T_hand_object": np.eye(4).tolist()}],
    "start": READY,
    "goals": [READY],
}


@pytest.fixture(scope="module")
def good():
    """Valid files by name: a problem, a task, a problem of two hands that carry a tray."""
    tray = two_arms_problem(0).to_dict()
    tray["robot"].setdefault("end_effectors", ["left_gripper", "right_gripper"])
    without = {name: value for name, value in tray.items() if name != "start"}
    without["start_region"] = tray["goal_region"]
    task = json.loads((DATA / "task-1.json").read_text())
    return {"mine": GOOD, "tray": tray, "tray without a start": without, "task": task}


@pytest.mark.parametrize("row", TABLE, ids=[f"{row['field']} {row['line']}" for row in TABLE])
def test_one_line_names_the_field_and_the_cure(row, good, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = holder = json.loads(json.dumps(good[row["base"]]))
    *keys, last = [int(key) if key.isdecimal() else key for key in row["field"].split(".")]
    for key in keys:
        holder = holder[key]
    if not row["value"]:
        del holder[last]
    elif isinstance(holder, list) and last == len(holder):
        holder.append(json.loads(row["value"]))
    else:
        holder[last] = json.loads(row["value"])
    (tmp_path / "mine.json").write_text(json.dumps(data))
    said = refused_command(capsys, "plan", "mine.json")
    assert row["line"] in said and row["also"] in said
    assert said.startswith("cvqmpt: mine.json: ") or row["base"].startswith("tray")


def test_the_good_file_is_accepted_and_a_list_is_refused():
    PlanningProblem.from_dict(GOOD)
    refused("must be an object with schema, name, robot", PlanningProblem.from_dict, [])


def test_a_start_in_which_another_axis_points_up_is_answered_with_it():
    wrong = {**GOOD, "attachments": [], "constraint": {"upright": {"tilt": 0.1, "axis": "x"}}}
    pattern = r'axis -z of the hand points up there, not x: write "axis": "-z" in constraint\[0\]'
    refused(pattern, check_problem, PlanningProblem.from_dict(wrong))


def test_a_start_off_the_chain_is_refused_with_F_or_projected(good, cvqmpt, capsys, tmp_path):
    data, path = json.loads(json.dumps(good["tray"])), tmp_path / "mine.json"
    data["start"][6] += 0.05
    path.write_text(json.dumps(data))
    line = refused_command(capsys, "plan", path)
    assert "start breaks `pose` by 0.05 rad" in line and "|F| = 0.0" in line
    assert "--project-start" in line
    assert "certificate certified" in cvqmpt("plan --project-start", path)
