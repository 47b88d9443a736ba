"""`cvqmpt problems` and `cvqmpt ik`: templates, problems of suites, configurations."""

import json
from dataclasses import replace

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from refusals import refused

from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.planning.pipeline import with_drawn_goals
from cvqmpt_lab.planning.usable import check_problem
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.source import read_source
from cvqmpt_lab.search.space import ConstrainedSpace, direct_motion

IK = "ik --pose '-0.3, 0.5, 0.3, 3.14, 0, 0'"


@pytest.fixture
def mine(tmp_path, cvqmpt):
    """Return a problem that `problems new` wrote."""
    path = tmp_path / "mine.json"
    assert f"cvqmpt plan {path}" in cvqmpt("problems new", path)
    return path


def test_motions_of_a_new_problem_and_task_need_no_limits_on_the_command_line(tmp_path, cvqmpt):
    """Commands of docs/ros2.md; the UR5's model has no acceleration limits."""
    path, motion, task = (tmp_path / name for name in ("mine.json", "motion.json", "door.json"))
    told = cvqmpt("problems new --robot ur5", path)
    assert "acceleration_limits are a guess, the limit of velocity in 0.5 s" in told
    cvqmpt(f"plan {path} --trajectory {motion} --speed 0.1 --rate 100")
    times = [point["time_from_start"] for point in json.loads(motion.read_text())["points"]]
    seconds = np.array([time["sec"] + 1e-9 * time["nanosec"] for time in times])
    assert np.ptp(np.diff(seconds)) < 1e-6 and 0.005 < np.diff(seconds).max() < 0.01 + 1e-6
    assert "certificate certified;" in cvqmpt(f"certify {motion} {path}")
    start = json.loads(motion.read_text())["points"][0]["positions"]
    current = ["--current", " ".join(map(str, start))]
    assert "certificate certified;" in cvqmpt(f"certify {motion} {path}", *current)
    assert "a guess" in cvqmpt(f"problems new {task} --task door --robot ur5")
    assert Task.load(task).scene.articulations[0].kind == "hinge"
    told = cvqmpt(f"plan {task} --trajectory {tmp_path / 'motions'}")
    assert "6 files and 2 gripper events" in told


def test_a_new_problem_leads_round_an_obstacle_from_a_calm_start_for_any_urdf(tmp_path, cvqmpt):
    """Formerly a UR10 started with a joint at 4.98 rad, and the box did not block its motion."""
    urdf, path = read_source({"name": "ur10"}).urdf, tmp_path / "new" / "mine.json"
    path.parent.mkdir()
    assert "end effector tool0 is a guess" in cvqmpt("problems new", path, "--robot", urdf)
    data = json.loads(path.read_text())
    assert set(data["start"]) == set(PlanningProblem.load(path).robot.joint_names)
    assert max(map(abs, data["start"].values())) < np.pi
    validator = Draft202012Validator(json.loads((path.parent / data["$schema"]).read_text()))
    assert list(validator.iter_errors(data)) == []
    wrong = {**data, "robot": {"urdf": "a.urdf", "end_efector": "tool0"}}
    assert list(validator.iter_errors(wrong))
    problem = with_drawn_goals(PlanningProblem.load(path))
    space = ConstrainedSpace.of(problem)
    assert all(direct_motion(space, problem.start, goal) is None for goal in problem.goals[1::2])
    empty = ConstrainedSpace.of(replace(problem, scene=problem.scene.without("wall")))
    assert any(direct_motion(empty, problem.start, goal) is not None for goal in problem.goals)


def test_goals_are_exported_on_request_and_the_file_says_that_they_win(tmp_path, cvqmpt):
    words = "problems export place-task --problems 1 --out"
    cvqmpt(words, tmp_path / "a")
    cvqmpt(words, tmp_path / "b", "--goals")
    without, with_goals = ((tmp_path / name / "place-task-000.json") for name in "ab")
    data = json.loads(with_goals.read_text())
    assert "goals" not in json.loads(without.read_text()) and len(data["goals"]) == 20
    assert "goals are used as they are; delete them" in data["_comment"]
    assert len(without.read_text().splitlines()) < 750  # 4 578 before
    validator = Draft202012Validator(json.loads((tmp_path / "a" / data["$schema"]).read_text()))
    assert list(validator.iter_errors(data)) == []
    for path in (without, with_goals):
        check_problem(PlanningProblem.load(path))


def test_configurations_reach_the_pose_free_of_collision_on_the_manifold(mine, cvqmpt):
    found = json.loads(cvqmpt(IK, mine, "--count", 3, "--json"))
    problem = PlanningProblem.load(mine)
    assert found["joints"] == list(problem.robot.joint_names) and len(found["configurations"]) == 3
    for q in np.array(found["configurations"]):
        np.testing.assert_allclose(problem.robot.pose(q)[:3, 3], (-0.3, 0.5, 0.3), atol=1e-5)
        assert not problem.collision_checker().in_collision(q)
        assert not problem.manifold.residual(q).any()


def test_a_file_with_comments_is_read_and_the_command_line_says_where_the_hand_is(
    tmp_path, mine, cvqmpt
):
    text = mine.read_text().replace("{", "{ // the // panda", 1).replace("\n}", ",\n /* end */ }")
    mine.write_text(text)
    problem = PlanningProblem.load(mine)
    told = cvqmpt("fk", ",".join(map(str, problem.start)))
    at = " ".join(f"{x:.4f}" for x in problem.robot.pose(problem.start)[:3, 3].round(4) + 0.0)
    assert f"panda_hand: {at} m" in told and "points up most" in told
    assert told.strip() in cvqmpt("problems new", tmp_path / "other.json")
    assert cvqmpt("fk", ",".join(map(str, problem.start)), mine) == told
    assert "7 joints, reach" in cvqmpt("robot", mine)
    mine.write_text(text.replace('"name"', '"name",,', 1))
    refused("is not json", PlanningProblem.load, mine)


def test_fk_says_where_a_tool_is_and_where_its_link(tmp_path, panda, problem, cvqmpt):
    start, arm = ",".join(map(str, problem.start)), tmp_path / "arm.json"
    assert "the name panda_hand means the link" in cvqmpt("robot panda --tool 0,0,0.1 --out", arm)
    tool, link = cvqmpt("fk", start, "--robot", arm).splitlines()
    assert tool.startswith("hand        panda_hand/tool: ")
    assert link.replace("link", "hand", 1) == cvqmpt("fk", start).strip()
    poses = json.loads(cvqmpt("fk --json", start, "--robot", arm))["poses"]
    assert list(poses) == ["panda_hand/tool", "panda_hand"]
    np.testing.assert_allclose(poses["panda_hand"], panda.pose(problem.start), atol=1e-12)


def test_postures_of_a_pose_differ_by_more_than_whole_turns(tmp_path, mine, cvqmpt):
    other = tmp_path / "ur5.json"
    other.write_text(json.dumps({**json.loads(mine.read_text()), "robot": {"name": "ur5"}}))
    told = cvqmpt("ik --pose '0.3 0.3 0.5 3.14 0 0' --count 20", other)
    found = np.array([json.loads(line) for line in told.splitlines() if line.startswith("[")])
    apart = np.abs(np.angle(np.exp(1j * (found[:, None] - found)))).max(axis=-1)
    assert (apart + np.eye(len(found)) > 0.01).all() and 2 <= len(found) <= 8
    assert f"{len(found)} postures found, 20 asked" in told


def test_a_pose_out_of_reach_has_no_configuration(mine, cvqmpt):
    told = cvqmpt("ik --pose '5 0 0 0 0 0'", mine, code=1)
    assert "0 postures found, 1 asked; of 100 poses, 100 without inverse kinematics" in told
