"""Planning problems: json, and the one-line messages that name what is wrong."""

import copy
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cvqmpt_lab.benchmarks.door_task import door_problem
from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.collision.arrays import robot_arrays, robot_swing, scene_arrays
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, upright
from cvqmpt_lab.errors import CvqmptError, InvalidProblemError
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem, check_problem, with_usable_goals
from cvqmpt_lab.robot.load import group_states
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box, shape_vertices

DATA = Path(__file__).parent / "data"


@pytest.fixture(scope="module")
def data():
    """A problem with every field in use, as json gives it back."""
    problem = with_sampled_goals(place_problem(0, with_can=True))[0]
    return json.loads(json.dumps(problem.to_dict(), allow_nan=False))


def changed(data, path, value):
    """A copy of the json with one entry replaced, or taken out when value is None."""
    result = place = copy.deepcopy(data)
    *way, last = entry(path)
    for key in way:
        place = place[key]
    if value is None:
        del place[last]
    else:
        place[last] = value
    return result


def refused(pattern, data):
    with pytest.raises(CvqmptError, match=pattern) as caught:
        PlanningProblem.from_dict(data)
    assert "\n" not in str(caught.value)


def entry(path):
    """Keys of a dotted path; numbers are places in lists."""
    return [int(key) if key.isdigit() else key for key in path.split(".")]


# the first two planned without the constraint, and without the can, and were certified
MISSPELT = {
    "constraint": "constraints", "attachments": "attachment",
    "goals": "goal", "goal_region": "goal_regoin",
    "constraint.0.Bw": "BW", "constraint.0.base": "bass", "scene.articulations": "articulation",
    "scene.objects.3.shape": "sahpe",
}  # fmt: skip


def test_missing_fields_are_named(data):
    for path in ("name", "robot", "scene", "constraint.0.Bw", "attachments.0.shape"):
        refused(rf"{entry(path)[-1]} is missing; fields: ", changed(data, path, None))


@pytest.mark.parametrize(("path", "misspelt"), MISSPELT.items())
def test_a_misspelt_field_is_refused_with_the_nearest_known_one(data, path, misspelt):
    folder, _, field = path.rpartition(".")
    wrong = changed(data, f"{folder}.{misspelt}".lstrip("."), 0)
    refused(f"{misspelt} is unknown; did you mean '{field}'", wrong)


MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()
FAR, HERE = pose((1e300, 0.0, 0.0)).tolist(), np.eye(4).tolist()
FAR_OFF = r"is no rigid pose: its position is 1e\+300 m off"
HUGE = {"type": "sphere", "radius": 1e300}
FAR_CLOUD = {"type": "point_cloud", "points": [[1e300, 0.0, 0.0]], "radius": 0.01}
LEAF = {"name": "leaf", "T": HERE, "vertices": shape_vertices(Box((1.0, 1.0, 1.0))).tolist()}
HINGE = {"name": "door", "kind": "hinge", "T_world_joint": HERE, "lower": 0.0, "upper": 1.0}
FAR_CASING = HINGE | {"parts": [LEAF], "casing": [LEAF | {"name": "post", "T": FAR}]}


@pytest.mark.parametrize(
    ("path", "value", "pattern"),
    [
        ("schema", "cvqmpt-problem/2", "cvqmpt-problem/1"),
        ("robot", "panda", "must be an object"),
        ("robot", {"name": "ur5-misspelt"}, "ur5-misspelt"),
        ("start.0", "0.5", r"start is \['0.5'"),
        ("start", [0.0] * 6, r"start has shape \(6,\), robot panda needs \(7,\)"),
        ("start.3", 0.1, "start.*panda_joint4 by 0.1698"),
        ("goals", [[0.0] * 7, [0.0] * 6], "must be numbers"),
        ("goals", [[0.0] * 6], r"panda needs \(k, 7\)"),
        ("goals.1.0", -3.0, "goal 1.*panda_joint1 by 0.1027"),
        ("constraint", {}, "constraint.T0_w is missing"),
        ("constraint.0.Bw", [[0, 1]] * 5, "must be 6 rows"),
        ("attachments.0.T_hand_object", MIRRORED, "mirrored"),
        ("attachments.0.T_hand_object", FAR, FAR_OFF),
        ("attachments.0.shape", HUGE, r"positive length, up to 1e\+06"),
        ("attachments.0.shape", FAR_CLOUD, r"points holds 1e\+300, more than 1e\+06; give metres"),
        ("constraint.0.Tw_e", FAR, rf"constraint\[0\].Tw_e {FAR_OFF}"),
        ("robot.articulated", FAR_CASING, r"casing\[0\].T is no rigid pose: its position"),
        ("name", "two\nlines", "printable"),
    ],
)
def test_malformed_fields_are_named(data, path, value, pattern):
    refused(pattern, changed(data, path, value))


def test_what_is_no_problem_as_a_whole_is_refused(data):
    refused("must be an object with schema, name, robot", [])
    refused("schema is None", {})
    refused("'carried_can' occurs twice", changed(data, "attachments", data["attachments"] * 2))
    refused("100 regions; at most 32", changed(data, "constraint", data["constraint"] * 100))
    refused("'goals'.*or a 'goal_region'", changed(changed(data, "goals", []), "goal_region", None))


def test_a_problem_that_cannot_be_planned_is_refused_by_start_or_goal(problem):
    """Once a changed region had no effect beside goals sampled from the old one."""
    moved = replace(problem.goal_region, T0_w=problem.goal_region.T0_w @ pose((0.1, 0.0, 0.0)))
    tilted = problem.start.copy()
    tilted[6] += 0.4 if tilted[6] < 0 else -0.4  # turns the hand about its approach axis: a tilt
    amount = np.abs(problem.manifold.residual(tilted)).max()
    at_goal = problem.robot.pose(problem.goals[2]) @ pose((0.0, 0.0, 0.1))
    at_start = problem.robot.pose(problem.start)
    for pattern, changes in (
        (r"goal 0 lies outside 'goal_region' by 0\.\d+", {"goal_region": moved}),
        (r"start is in collision: panda_.* and brick", {"scene": with_brick(problem, at_start)}),
        (r"goal \d+ is in collision: .*brick", {"scene": with_brick(problem, at_goal)}),
        (
            rf"start breaks `upright-box` by {amount:.3g} rad: rotation about . .* \(it tilts by "
            rf"\d+°\)",
            {"start": tilted},
        ),
    ):
        with pytest.raises(InvalidProblemError, match=pattern):
            check_problem(replace(problem, **changes))


def test_a_start_outside_its_cone_is_refused_with_the_tilt_in_degrees(problem):
    """Of a tilt of 0, which is kept as two turns of 0, the same is said."""
    lean = np.degrees(np.arccos(problem.robot.pose(problem.start)[2, 2]))
    for tilt, what in ((0.1, "tilt .* of 0.1 rad"), (0.0, "rotation about . .*")):
        told = rf"start breaks `upright` by .* rad: {what} \(it tilts by {lean:.0f}°\)"
        with pytest.raises(InvalidProblemError, match=told):
            # the hand's own x axis points up at the start, its z axis does not
            check_problem(replace(problem, constraint=(upright(tilt, "z"),)))


def test_the_reasons_why_there_is_no_goal_are_named(problem):
    """Out of reach: distance, reach; collision: pieces, counts; constraint: bound, degrees."""
    at_goal = problem.robot.pose(problem.goals[0])

    def why(T, **changes):
        region = TaskSpaceRegion(T, np.eye(4), np.zeros((6, 2)))
        return replace(problem, goals=np.empty((0, 7)), goal_region=region, **changes).why_no_goal()

    assert re.fullmatch(
        r"they lie 3.\d\d m or more from panda_joint1, the hand reaches 0.86 m",
        why(pose((3, 0, 0)) @ at_goal),
    )
    buried = why(at_goal, scene=with_brick(problem, at_goal @ pose((0, 0, 0.1))))
    assert re.match(
        r"all (\d+) configurations that reach them collide: .*panda_hand_0 and brick in \d+", buried
    )
    quarter = pose((0, 0, 0))[:, [2, 1, 0, 3]] * [1, 1, -1, 1]  # a turn about y
    tilted = at_goal @ quarter
    assert re.search(r"every pose breaks `upright-box` by .*it tilts by \d\d°\)", why(tilted))
    goals = problem.goals[:3].copy()
    goals[:, 6] += np.where(goals[:, 6] < 0, 0.4, -0.4)
    wide = TaskSpaceRegion(
        np.eye(4), np.eye(4), np.array([[-3.0, 3.0]] * 3 + [[-np.pi, np.pi]] * 3)
    )
    with pytest.raises(
        InvalidProblemError, match="'goal_region' leaves the constraint: the best of 3 goals in it"
    ):
        check_problem(replace(problem, goals=goals, goal_region=wide))


def test_goals_that_cannot_be_used_are_left_out_while_one_is_left(problem):
    """A brick at the elbow of one of 20 goals, another one tilted; only those; the start."""
    at_goal = problem.robot.pose(problem.goals[2], "panda_link4")
    hindered = replace(problem, scene=with_brick(problem, at_goal))
    met = hindered.collision_checker().in_collision_batch(problem.goals)
    k, goals = int(np.flatnonzero(~met)[0]), problem.goals.copy()
    goals[k, 6] += 0.4 if goals[k, 6] < 0 else -0.4
    hindered = replace(hindered, goals=goals)
    found, left_out = with_usable_goals(hindered)
    reasons = {int(text.split()[1]): text for text in left_out}
    assert met[2] and sorted(reasons) == sorted([*np.flatnonzero(met), k])
    assert "brick" in reasons[2] and "breaks `upright-box`" in reasons[k]
    np.testing.assert_array_equal(found.goals, np.delete(goals, [*reasons], axis=0))
    check_problem(found)
    assert with_usable_goals(problem) == (problem, ())
    alone = replace(hindered, goals=goals[[2, k]])
    told = r"none of 2 goals can be used: goal 1 breaks `upright-box`.*; `cvqmpt ik` finds"
    with pytest.raises(InvalidProblemError, match=told):
        with_usable_goals(alone)
    at_start = with_brick(problem, problem.robot.pose(problem.start))
    with pytest.raises(InvalidProblemError, match="start is in collision"):
        with_usable_goals(replace(problem, scene=at_start))


def with_brick(problem, T):
    return problem.scene.with_objects(SceneObject("brick", Box((0.1,) * 3), T))


def test_a_start_region_gives_a_start_free_of_collision_that_keeps_the_constraint(data):
    at = {"xyz": [0.4, 0.2, 0.6], "rpy": [np.pi, -np.pi / 2, 0]}
    start = {"pose": {"at": at, "position": 0.05, "yaw": 3.2}}
    asked = changed(changed(data, "start", None), "start_region", start)
    problem = PlanningProblem.from_dict(asked)
    check_problem(problem)
    reached = problem.robot.pose(problem.start)[:3, 3]
    np.testing.assert_allclose(reached, at["xyz"], atol=0.05001)
    np.testing.assert_array_equal(PlanningProblem.from_dict(asked).start, problem.start)
    # the file that is written holds the start alone
    again = PlanningProblem.from_dict(problem.to_dict())
    np.testing.assert_array_equal(again.start, problem.start)
    refused("'start' or 'start_region', one of the two", changed(data, "start_region", start))
    refused("'start' or 'start_region', one of the two", changed(data, "start", None))
    far = changed(asked, "start_region.pose.at.xyz", [5.0, 0.0, 0.0])
    refused("no start in 'start_region': of 100 poses, 100 without inverse kinematics", far)


def test_files_of_before_still_load(tmp_path):
    """Old `cvqmpt problems export`: every pose a matrix, sampled goals stored beside the region."""
    path = DATA / "problem-1.json"
    old, problem = json.loads(path.read_text()), PlanningProblem.load(path)
    assert problem.goals.tolist() == old["goals"] and problem.start.tolist() == old["start"]
    for item, was in zip(problem.scene, old["scene"]["objects"], strict=True):
        assert item.T_world_object.tolist() == was["T_world_object"]
        assert item.obstacle == was["obstacle"]
    for region, was in zip(problem.constraint, old["constraint"], strict=True):
        assert region.T0_w.tolist() == was["T0_w"]
    problem.save(tmp_path / "now.json")
    assert PlanningProblem.load(tmp_path / "now.json") == problem
    assert len((tmp_path / "now.json").read_text().splitlines()) < 130


def test_millimetres_and_degrees_are_suspected(data, caplog):
    """A 300 x 600 x 20 "mm" box 670 m off was certified; tilt 10 made the constraint empty."""
    shelf = {
        "name": "shelf",
        "shape": {"type": "box", "size": [0.3, 0.6, 0.02]},
        "T_world_object": {"xyz": [0.6, 0, 0.3]},
    }
    own = changed(changed(data, "scene", {"name": "room", "objects": [shelf]}), "attachments", [])
    own = changed(changed(own, "goals", []), "constraint", [{"upright": 0.1}])
    PlanningProblem.from_dict(own)
    assert not caplog.messages
    goal = {"pose": {"at": {"xyz": [0.5, 0, 0.3], "rpy": [3.14, 0, 0]}}}
    far = {"plane": {"normal": [1, 0, 0], "point": [500, 0, 0]}}
    in_degrees = [0, -45, 0, -135, 0, 90, 45]
    aimed = changed(own, "goal_region", goal)
    size, xyz = "scene.objects.0.shape.size", "scene.objects.0.T_world_object.xyz"
    for given, path, value, told in (
        (own, size, [300, 600, 20], "'shelf', is 600 m large.*no metres"),
        (own, xyz, [600, 0, 300], "'shelf', is 67\\d.* m off.*no metres"),
        (own, "goal_region", far, "goal_region: its frame is 500 m off"),
        (aimed, "goal_region.pose.at.rpy", [180, 0, 0], "'rpy' holds 180, more than 2 pi: degrees"),
        (aimed, "constraint", {"upright": 10}, "tilt is 10.0; .*degrees"),
        (aimed, "start", in_degrees, "start is outside the limits: panda_joint4 by .*; degrees"),
    ):
        refused(told, changed(given, path, value))
    own = aimed
    PlanningProblem.from_dict(changed(own, "scene.objects.0.T_world_object.xyz", [6, 0, 3]))
    assert "the arm can touch nothing of it: 'shelf' is nearest, 6" in caplog.text


def test_configurations_by_joint_and_by_the_srdf(problem):
    plain, names = problem.to_dict(), problem.robot.joint_names
    values = dict(zip(names, problem.start.tolist(), strict=True))
    backwards = dict(reversed(values.items()))
    given = {**plain, "start": backwards, "goals": [backwards, "default"]}
    found = PlanningProblem.from_dict(given)
    np.testing.assert_array_equal(found.start, problem.start)
    np.testing.assert_array_equal(found.goals[0], problem.start)
    default = group_states(problem.robot)["default"]
    np.testing.assert_array_equal(found.goals[1], [default[name] for name in names])
    first_six = dict(list(values.items())[:6])
    for start, told in (
        ("redy", "unknown group_state of start 'redy'; valid choices: default"),
        ({**values, "joint1": 0.0}, "unknown joint of start 'joint1'.*did you mean"),
        (first_six, "start has no value for panda_joint7; give"),
    ):
        refused(told, {**plain, "start": start})


def arrays_of(value, where, seen):
    """Every array that is reached from a value, with the way to it."""
    if id(value) in seen or isinstance(value, str | bytes | type):
        return
    seen[id(value)] = value
    if isinstance(value, np.ndarray):
        yield where, value
    parts = enumerate(value) if isinstance(value, tuple | list) else vars_of(value).items()
    for name, part in parts:
        yield from arrays_of(part, f"{where}.{name}", seen)


def vars_of(value):
    if isinstance(value, dict):
        return value
    return vars(value) if type(value).__module__.startswith("cvqmpt_lab") else {}


@pytest.mark.parametrize("with_door", [False, True])
def test_nothing_that_problems_share_can_be_written_to(with_door):
    problem = door_problem(0) if with_door else place_problem(0, with_can=True)
    problem = with_sampled_goals(problem)[0]
    _ = problem.robot.turning, problem.manifold.regions, problem.robot.kinematics_digest
    robot, load = problem.robot, problem.attachments
    cached = robot_arrays(robot, load), robot_swing(robot, load), scene_arrays(problem.scene, 1.0)
    found = dict(arrays_of((problem, cached), "problem", {}))
    assert len(found) > 60
    assert [where for where, array in found.items() if array.flags.writeable] == []
    with pytest.raises(ValueError, match="read-only"):
        lower = problem.robot.lower
        lower -= 0.5
