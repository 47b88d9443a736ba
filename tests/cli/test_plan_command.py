"""`cvqmpt plan`: a report and a path of a problem, the phases of a task, and refused options."""

import json
import shutil

import numpy as np
import pytest
from command_line import refused
from jsonschema import Draft202012Validator

from cvqmpt_lab.cli.main import main
from cvqmpt_lab.constraints.task_space_region import displacements
from cvqmpt_lab.features.motion.trajectory import read_motion
from cvqmpt_lab.features.tasks.task import PlannedPhase, Task
from cvqmpt_lab.robot.load import robot_from_source


def test_plan_prints_a_report_and_writes_the_path(cvqmpt, problem_file, problem, tmp_path):
    out = tmp_path / "path.csv"
    words = f"plan {problem_file} --iterations 20000 --save {out}"
    lines = cvqmpt(words).splitlines()
    heads = (
        "problem constraint planner status time counts length certificate uncompared margin path"
    )
    assert [line.split()[0] for line in lines] == heads.split()
    assert "clearance obstacles at least " in lines[7] and ", self at least " in lines[7]
    assert lines[3].split()[:2] == ["status", "solved"] and "certificate certified (" in lines[7]
    assert out.read_text().splitlines()[0] == ",".join(problem.robot.joint_names)
    states = np.loadtxt(out, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(states[[0, -1]], [problem.start, problem.goals[0]])


def test_a_cost_limits_search_and_improvement_without_a_clock(cvqmpt, problem_file):
    words = f"plan {problem_file} --planner birrt"
    once, again = (json.loads(cvqmpt(f"{words} --cost 100 --json")) for _ in range(2))
    assert once["solved"] and once["path"] == again["path"] and once["optimize"] is None
    shorter = json.loads(cvqmpt(f"{words} --cost 100 --optimize 20 --json"))
    assert shorter["length_rad"] <= once["length_rad"]
    said = cvqmpt(f"{words} --cost 0.01", code=1)
    assert "cost limit: no path found within the cost" in said


def test_a_goal_that_collides_is_left_out_and_named(cvqmpt, capsys, problem_file, data, problem):
    folded = [0.0, 0.0, 0.0, -3.07, 0.0, 0.0, 0.0]
    del data["goal_region"]
    data |= {"goals": [*problem.goals[:2].tolist(), folded], "constraint": []}
    problem_file.write_text(json.dumps(data))
    words = f"plan {problem_file} --iterations 20000"
    lines = cvqmpt(words).splitlines()
    assert lines[0].endswith("2 goals")
    assert lines[1].startswith("left out    goal 2 is in collision: panda_")
    said = json.loads(cvqmpt(words, "--json"))
    assert said["goals"] == 2 and [f"left out    {x}" for x in said["goals_left_out"]] == lines[1:2]
    problem_file.write_text(json.dumps(data | {"goals": [folded, folded]}))
    told = "none of 2 goals can be used: goal 1 is in collision"
    assert told in refused(capsys, *words.split())


@pytest.mark.parametrize(
    ("suite", "planner", "why"),
    [("place-task", "roadmap", "work"), ("open-door", "birrt", "mechanism")],
)
def test_the_planner_that_nobody_names_is_a_roadmap_but_where_the_hand_holds_a_door(
    cvqmpt, suite, planner, why
):
    said = json.loads(cvqmpt(f"plan {suite} --problem 0 --iterations 3000 --json"))
    assert said["planner"] == planner and why in said["chosen_because"]


def test_plan_without_success_exits_with_1_and_writes_no_motion(cvqmpt, tmp_path):
    words = "plan place-task --problem 5 --planner birrt --iterations 1 --trajectory"
    out = cvqmpt(words, tmp_path / "motion.csv", code=1)
    assert "iteration limit: no path found within " in out and "trajectory  none" in out
    assert not (tmp_path / "motion.csv").exists()


def test_a_motion_that_cannot_be_timed_keeps_the_picture_and_the_states(
    cvqmpt, capsys, problem_file, data, tmp_path
):
    data["robot"] |= {"effort_limits": [3.0] * 7}
    problem_file.write_text(json.dumps(data))
    files = {name: tmp_path / name for name in ("p.png", "path.csv")}
    words = f"plan {problem_file} --iterations 20000 --trajectory {tmp_path / 'motion.csv'}"
    words += f" --picture {files['p.png']} --save {files['path.csv']}"
    assert main(words.split()) == 2
    said = capsys.readouterr()
    assert "to stand still" in said.err and said.err.count("\n") == 1
    assert "certificate certified (" in said.out
    for path in files.values():
        assert path.exists() and f"written to {path}" in said.out
    assert not (tmp_path / "motion.csv").exists()


def test_a_task_is_exported_and_planned(cvqmpt, task, tmp_path):
    cvqmpt("problems export multi-sequence --problems 1 --out", tmp_path)
    out = cvqmpt("plan", tmp_path / "multi-sequence-000.json")
    names = [phase.name for phase in task.phases if isinstance(phase, PlannedPhase)]
    assert all(name in out for name in (*names, "solved"))
    exported = Task.load(tmp_path / "multi-sequence-000.json")
    assert exported.to_dict() == task.to_dict()


def test_a_new_task_is_planned_into_a_file_a_phase_and_the_events_between(tmp_path, cvqmpt):
    path, folder = tmp_path / "drawer.json", tmp_path / "motions"
    cvqmpt(f"problems new {path} --task")
    schema = json.loads((tmp_path / json.loads(path.read_text())["$schema"]).read_text())
    Draft202012Validator(schema).validate(json.loads(path.read_text()))
    told = json.loads(cvqmpt(f"plan {path} --json --trajectory {folder}"))
    index = json.loads((folder / "task.json").read_text())["steps"]
    names = ["reach", "approach", "close", "pull", "let-go", "back", "away/1", "away"]
    assert told["solved"] and [phase["phase"] for phase in told["phases"]] == names
    assert [step["phase"] for step in index] == names
    assert {step["phase"]: step["gripper"] for step in index if "file" not in step} == {
        "close": {"finger_opening": 0.0072},
        "let-go": {"finger_opening": 0.04},
    }
    written = {"task.json", *(step["file"] for step in index if "file" in step)}
    assert {path.name for path in folder.iterdir()} == written
    task = Task.load(path)
    q = task.start
    for step, phase in zip(index, told["phases"], strict=True):
        if "file" in step:
            motion = read_motion(folder / step["file"])
            assert motion.positions.shape[1] == 7
            assert motion.positions[0] == pytest.approx(q, abs=1e-9)
            q = motion.positions[-1]
            assert phase["certificate"]["verdict"] == "certified"
            assert phase["certificate"]["compared"]["obstacles"]
            assert phase["duration_s"] == step["duration_s"]
            assert motion.times[-1] == pytest.approx(step["duration_s"], abs=1e-6)
            if step["phase"] == "away/1":
                robot, region = robot_from_source(task.robot), task.phases[-1].through[0]
                off = displacements(robot, region, q[None])[0]
                assert np.abs(off[:3]).max() <= 0.0201 and np.abs(off[3:7]).max() < 1e-3
    said = cvqmpt("certify", folder, path)
    assert (
        "6 of 6 phases of drawer are certified" in said
        and said.count("certificate certified;") == 6
    )
    shutil.copy(folder / index[1]["file"], folder / index[0]["file"])
    said = cvqmpt("certify", folder, path, code=1)
    assert "4 of 6 phases" in said and "certificate not certified: refused;" in said


def test_json_holds_the_record_that_certify_prints(tmp_path, cvqmpt):
    path, words = tmp_path / "path.csv", "place-task --problem 8 --json"
    told = cvqmpt(
        f"plan {words} --planner birrt --iterations 20000 --exact-clearance --save {path}"
    )
    planned = json.loads(told)["certificate"]
    assert planned == json.loads(cvqmpt(f"certify {path} {words}")) and planned["valid"]


def test_a_motion_begins_and_ends_at_poses_of_the_hand(cvqmpt, tmp_path, capsys):
    scene = tmp_path / "scene.json"
    box = {"name": "box", "shape": {"type": "box", "size": [0.1, 0.1, 0.3]}}
    pose = {"xyz": [0.5, 0.0, 0.15], "rpy": [0, 0, 0]}
    scene.write_text(json.dumps({"name": "s", "objects": [{**box, "T_world_object": pose}]}))
    ends = "--start-pose 0.5,0.3,0.4,3.1,0,0 --goal-pose 0.5,-0.3,0.4,3.1,0,0"
    out = tmp_path / "path.csv"
    words = f"plan {ends} --scene {scene} --constraint upright --iterations 5000"
    assert "certificate certified" in cvqmpt(f"{words} --save {out}")
    states = np.loadtxt(out, delimiter=",", skiprows=1)
    hand = robot_from_source({"name": "panda"}).poses(states[[0, -1]])[:, :3, 3]
    assert np.allclose(hand, [[0.5, 0.3, 0.4], [0.5, -0.3, 0.4]], atol=1e-3)
    far = "plan --start-pose 0,0,9,0,0,0 --goal-pose 0.5,0,0.4,3,0,0 --scene"
    assert "give another pose" in refused(capsys, *far.split(), scene)


def test_a_file_may_stand_in_the_place_of_a_suite(cvqmpt, problem_file):
    named = cvqmpt(f"plan {problem_file} --iterations 20000 --json")
    given = cvqmpt(f"plan {problem_file} --iterations 20000 --json")
    assert json.loads(named)["path"] == json.loads(given)["path"]
