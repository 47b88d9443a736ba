"""Planning problems: json, and the one-line messages that name what is wrong."""

import copy
import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.errors import CvqmptError, InvalidInputError, InvalidProblemError
from cvqmpt_lab.methods.table import planner_named
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planning.result import Budget, PlanStatus
from cvqmpt_lab.problem import PlanningProblem, check_problem
from cvqmpt_lab.scene.scene import SceneObject, pose
from cvqmpt_lab.scene.shapes import Box
from experiments.suites.place_task import place_problem


@pytest.fixture(scope="module")
def data():
    """A problem with every field in use, as json gives it back."""
    problem = with_sampled_goals(place_problem(0, with_can=True))[0]
    return json.loads(json.dumps(problem.to_dict(), allow_nan=False))


def digest(data):
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def changed(data, path, value):
    """A copy of the json with one entry replaced, or taken out when value is None."""
    result = copy.deepcopy(data)
    *way, last = path
    entry = result
    for key in way:
        entry = entry[key]
    if value is None:
        del entry[last]
    else:
        entry[last] = value
    return result


def refused(pattern, data, error=InvalidInputError):
    with pytest.raises(error, match=pattern) as caught:
        PlanningProblem.from_dict(data)
    assert "\n" not in str(caught.value)


def test_json_round_trip_is_exact(data, tmp_path):
    problem = PlanningProblem.from_dict(data)
    assert digest(problem.to_dict()) == digest(data)
    problem.save(tmp_path / "problem.json")
    assert [path.name for path in tmp_path.iterdir()] == ["problem.json"]
    again = PlanningProblem.load(tmp_path / "problem.json")
    assert digest(again.to_dict()) == digest(data)
    np.testing.assert_array_equal(again.goals, problem.goals)
    assert again.attachments[0].shape == problem.attachments[0].shape and again.scene == problem.scene


@pytest.mark.parametrize(
    "path",
    [
        *[("name",), ("robot",), ("scene",), ("start",), ("schema",)],
        *[("constraint", 0, field) for field in ("T0_w", "Tw_e", "Bw")],
        *[("goal_region", field) for field in ("T0_w", "Tw_e", "Bw")],
        *[("attachments", 0, field) for field in ("name", "shape", "T_hand_object")],
        *[("scene", "objects"), ("scene", "objects", 3, "shape"), ("scene", "objects", 3, "T_world_object")],
    ],
    ids=lambda path: path[-1] if len(path) == 1 else f"{path[0]}-{path[-1]}",
)
def test_missing_fields_are_named(data, path):
    refused(f"'{path[-1]}'", changed(data, path, None))


@pytest.mark.parametrize("field", ["attachments", "constraint", "goals", "goal_region"])
def test_optional_fields_may_be_missing(data, field):
    assert PlanningProblem.from_dict(changed(data, (field,), None)).name == "0"


@pytest.mark.parametrize(
    ("path", "value", "pattern"),
    [
        (("schema",), "cvqmpt-problem/2", "'schema' is 'cvqmpt-problem/2'.*reads 'cvqmpt-problem/1'"),
        (("robot",), "panda", "'robot' must be a json object, not str"),
        (("robot",), {"name": "ur5"}, "robot 'ur5'"),
        (("scene",), [], "'scene' must be a json object"),
        (("scene", "objects", 3, "T_world_object"), [[1]], "T_world_object"),
        (("start",), "home", "'start' must hold numbers"),
        (("start",), [0.0] * 6, r"start has shape \(6,\)"),
        (("start",), 5, "start has shape"),
        (("goals",), [["a"] * 7], "'goals' must hold numbers"),
        (("goals",), [[0.0] * 7, [0.0] * 6], "'goals' must hold numbers"),
        (("constraint",), [5], "'constraint' must be a json object"),
        (("constraint", 0, "Bw"), [[0, 1]] * 5, "'Bw'"),
        (("goal_region",), [], "'goal_region' must be a json object"),
        (("attachments",), ["can"], "'attachments' must be a json object"),
        (("attachments", 0, "T_hand_object"), [1], "attachment is malformed"),
        (("attachments", 0, "shape"), {"type": "cone"}, "'cone'"),
        pytest.param(("goals",), [[0.0] * 6], "goals"),
        pytest.param(("goals",), [[0.0, 0.0, 0.0, -1.0]] * 7, "goals"),
        pytest.param(("constraint",), 5, "constraint"),
        pytest.param(("constraint",), {}, "constraint"),
        pytest.param(("attachments",), 5, "attachments"),
        pytest.param(("attachments", 0, "T_hand_object", 0, 3), np.nan, "T_hand_object"),
        pytest.param(("attachments", 0, "T_hand_object", 0, 0), 7.0, "T_hand_object"),
        pytest.param(("attachments", 0, "name"), 5, "name"),
        pytest.param(("name",), ["x"], "name"),
    ],
)
def test_malformed_fields_are_named(data, path, value, pattern):
    refused(pattern, changed(data, path, value), CvqmptError)


def test_what_is_no_problem_at_all():
    refused("json object, not list", [])
    refused("'schema' is None", {})


def test_nan_and_infinite_entries_are_named(data):
    refused("start has a NaN or infinite entry at joint 2", changed(data, ("start", 2), np.nan))
    refused("goal 1 has a NaN or infinite entry at joint 6", changed(data, ("goals", 1, 6), -np.inf))


def test_joints_outside_their_limits_are_named(data):
    refused("start.*panda_joint4 by 0.1698", changed(data, ("start", 3), 0.1))
    refused("goal 1.*panda_joint1 by 0.1027", changed(data, ("goals", 1, 0), -3.0), InvalidProblemError)


def test_a_problem_needs_some_goal(data):
    neither = changed(changed(data, ("goals",), []), ("goal_region",), None)
    refused("'goals'.*or a 'goal_region'", neither, InvalidProblemError)


def test_files_are_named(tmp_path, data):
    path = tmp_path / "problem.json"
    with pytest.raises(InvalidInputError, match=r"problem\.json: No such file"):
        PlanningProblem.load(path)
    for text, pattern in (("{", "not json"), ("{}", "'schema' is None"), ("[]", "not list")):
        path.write_text(text)
        with pytest.raises(InvalidInputError, match=rf"problem\.json.*{pattern}"):
            PlanningProblem.load(path)
    path.write_text(json.dumps(changed(data, ("start", 3), 0.1)))
    with pytest.raises(InvalidProblemError, match=r"problem\.json.*panda_joint4"):
        PlanningProblem.load(path)


@pytest.mark.parametrize("case", ["not text", "unknown robot", "missing folder"])
def test_files_are_named_for_every_error(tmp_path, data, case):
    path = tmp_path / "problem.json"
    with pytest.raises(CvqmptError, match=r"problem\.json"):
        if case == "not text":
            path.write_bytes(b"\xff\xfe")
            PlanningProblem.load(path)
        elif case == "unknown robot":
            path.write_text(json.dumps(changed(data, ("robot",), {"name": "ur5"})))
            PlanningProblem.load(path)
        else:
            PlanningProblem.from_dict(data).save(tmp_path / "missing" / "problem.json")


def test_check_accepts_a_good_problem(problem):
    check_problem(problem)


def test_start_in_collision_names_the_pair(problem):
    brick = SceneObject("brick", Box((0.1,) * 3), problem.robot.pose(problem.start))
    blocked = replace(problem, scene=problem.scene.with_objects(brick))
    with pytest.raises(InvalidProblemError, match=r"start is in collision: panda_.* and brick"):
        check_problem(blocked)


def test_goal_in_collision_is_named(problem):
    T_world_hand = problem.robot.pose(problem.goals[2]) @ pose((0.0, 0.0, 0.1))
    brick = SceneObject("brick", Box((0.1,) * 3), T_world_hand)
    with pytest.raises(InvalidProblemError, match=r"goal \d+ is in collision: .*brick"):
        check_problem(replace(problem, scene=problem.scene.with_objects(brick)))


def test_off_the_manifold_names_the_amount(problem):
    tilted = problem.start.copy()
    tilted[6] += 0.4 if tilted[6] < 0 else -0.4  # turns the hand about its approach axis: a tilt
    amount = np.abs(problem.manifold.residual(tilted)).max()
    assert amount > 0.2
    with pytest.raises(InvalidProblemError, match=f"start is off the constraint manifold by {amount:.4f}"):
        check_problem(replace(problem, start=tilted))


def test_goals_are_sampled_from_a_goal_region(problem):
    only_region = replace(problem, goals=np.empty((0, 7)))
    sampled, seconds = with_sampled_goals(only_region)
    assert 0 < len(sampled.goals) <= 20 and seconds > 0
    np.testing.assert_array_equal(sampled.goals, with_sampled_goals(only_region)[0].goals)
    check_problem(sampled)
    assert with_sampled_goals(sampled) == (sampled, 0.0)


def test_an_unreachable_goal_region_is_a_result(problem):
    far = replace(problem.goal_region, T0_w=pose((5.0, 0.0, 0.0)))
    solution = solve(
        replace(problem, goals=np.empty((0, 7)), goal_region=far),
        planner_named("birrt"),
        Budget(iterations=10),
        seed=0,
    )
    assert solution.plan.status is PlanStatus.NO_GOAL and not solution.solved


def test_arrays_are_copied_and_read_only(problem):
    start = problem.start.copy()
    mine = replace(problem, start=start)
    start[0] = 9.0
    assert mine.start[0] != 9.0
    with pytest.raises(ValueError, match="read-only"):
        mine.start[0] = 9.0
