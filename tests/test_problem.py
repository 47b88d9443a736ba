"""Planning problems: json, and the one-line messages that name what is wrong."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from refusals import DATA, refused
from small_arms import gantry, problem_of

from cvqmpt_lab.base.errors import InvalidProblemError
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.place_task import door_problem, place_problem
from cvqmpt_lab.cli.problem_options import pose_region
from cvqmpt_lab.collision.arrays import robot_arrays, robot_swing, scene_arrays
from cvqmpt_lab.constraints.joint_coupling import JointCoupling
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, upright
from cvqmpt_lab.planning.pipeline import with_drawn_goals
from cvqmpt_lab.planning.usable import (
    check_problem,
    usable_goals,
    why_no_goal,
    with_projected_start,
)
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import group_states, robot_from_source
from cvqmpt_lab.scene.cells import map_of_points
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, PointCloud


def test_a_problem_that_cannot_be_planned_is_refused_by_start_or_goal(problem):
    """A changed region must not be ignored in favour of goals sampled from the old region."""
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
            rf"start breaks `upright-box` by {amount:.3g} rad: rotation about . .*\d+°",
            {"start": tilted},
        ),
    ):
        refused(pattern, check_problem, replace(problem, **changes), error=InvalidProblemError)


def test_a_start_outside_its_cone_is_refused_with_the_tilt_in_degrees(problem):
    """A tilt of 0, which is stored as two rotations of 0, gives the same message."""
    lean = np.degrees(np.arccos(problem.robot.pose(problem.start)[2, 2]))
    for tilt, what in ((0.1, "tilt .* of 0.1 rad"), (0.0, "rotation about . .*")):
        told = rf"start breaks `upright` by .* rad: {what} \(it tilts by {lean:.0f}°\)"
        with pytest.raises(InvalidProblemError, match=told):
            # the hand's own x axis points up at the start, its z axis does not
            check_problem(replace(problem, constraint=(upright(tilt, "z"),)))


def test_the_reasons_why_there_is_no_goal_are_named(problem):
    """Reasons: distance and reach; colliding pieces and counts; violated bound in degrees."""
    at_goal = problem.robot.pose(problem.goals[0])

    def why(T, **changes):
        region = TaskSpaceRegion(T, np.eye(4), np.zeros((6, 2)))
        return why_no_goal(replace(problem, goals=np.empty((0, 7)), goal_region=region, **changes))

    told = r"they lie 3.\d\d m or more from panda_joint1, the hand reaches 0.86 m"
    assert re.fullmatch(told, why(pose((3, 0, 0)) @ at_goal))
    buried = why(at_goal, scene=with_brick(problem, at_goal @ pose((0, 0, 0.1))))
    told = r"all (\d+) configurations that reach them collide: .*panda_hand_0 and brick in \d+"
    assert re.match(told, buried)
    quarter = pose((0, 0, 0))[:, [2, 1, 0, 3]] * [1, 1, -1, 1]  # a turn about y
    tilted = at_goal @ quarter
    assert re.search(r"every pose breaks `upright-box` by .*it tilts by \d\d°\)", why(tilted))
    down = pose((0.75, 0.0, 0.6))
    down[:3, :3] = np.diag([1.0, -1.0, -1.0])
    said = why(down, constraint=(), scene=Scene("none", ()))
    told = r"with another orientation, .* nearest one found, (\d+) deg from it: (\S+)$"
    angle, typed = re.search(told, said).groups()
    assert int(angle) <= 20 and "another orientation" not in why(
        pose_region("--goal-pose", typed).T0_w, constraint=(), scene=Scene("none", ())
    )
    flat = why(at_goal, constraint=(upright(0.1, "z"),))
    assert re.search(r'axis -?[xy] of the hand points up there, not z: write "axis": "', flat)
    goals = problem.goals[:3].copy()
    goals[:, 6] += np.where(goals[:, 6] < 0, 0.4, -0.4)
    bounds = np.array([[-1.2, 1.2]] * 3 + [[-np.pi, np.pi]] * 3)
    wide = TaskSpaceRegion(np.eye(4), np.eye(4), bounds)
    left = replace(problem, goals=goals, goal_region=wide)
    told = "'goal_region' leaves the constraint: the best of 3 goals in it"
    refused(told, check_problem, left, error=InvalidProblemError)


def test_goals_that_cannot_be_used_are_left_out_while_one_is_left(problem):
    """Of 20 goals one collides and one is tilted; then only these two; then the start collides."""
    at_goal = problem.robot.pose(problem.goals[2], "panda_link4")
    hindered = replace(problem, scene=with_brick(problem, at_goal))
    met = hindered.collision_checker().in_collision_batch(problem.goals)
    k, goals = int(np.flatnonzero(~met)[0]), problem.goals.copy()
    goals[k, 6] += 0.4 if goals[k, 6] < 0 else -0.4
    hindered = replace(hindered, goals=goals)
    found, left_out = usable_goals(hindered, goals)
    reasons = {int(text.split()[1]): text for text in left_out}
    assert met[2] and sorted(reasons) == sorted([*np.flatnonzero(met), k])
    assert "brick" in reasons[2] and "breaks `upright-box`" in reasons[k]
    np.testing.assert_array_equal(found, np.delete(goals, [*reasons], axis=0))
    check_problem(replace(hindered, goals=found))
    every, none = usable_goals(problem, problem.goals)
    assert none == () and (every == problem.goals).all()
    alone = replace(hindered, goals=goals[[2, k]])
    told = r"none of 2 goals can be used: goal 1 breaks `upright-box`.*; `cvqmpt ik` finds"
    refused(told, usable_goals, alone, alone.goals, error=InvalidProblemError)
    at_start = replace(problem, scene=with_brick(problem, problem.robot.pose(problem.start)))
    refused(
        "start is in collision", usable_goals, at_start, at_start.goals, error=InvalidProblemError
    )


def with_brick(problem, T):
    return problem.scene.with_objects(SceneObject("brick", Box((0.1,) * 3), T))


def test_a_start_region_gives_a_start_free_of_collision_that_keeps_the_constraint(problem):
    at = {"xyz": [0.4, 0.2, 0.6], "rpy": [np.pi, -np.pi / 2, 0]}
    asked = problem.to_dict()
    del asked["start"]
    asked["start_region"] = {"pose": {"at": at, "position": 0.05, "yaw": 3.2}}
    problem = PlanningProblem.from_dict(asked)
    check_problem(problem)
    reached = problem.robot.pose(problem.start)[:3, 3]
    np.testing.assert_allclose(reached, at["xyz"], atol=0.05001)
    np.testing.assert_array_equal(PlanningProblem.from_dict(asked).start, problem.start)
    # the file that is written holds the start alone
    again = PlanningProblem.from_dict(problem.to_dict())
    np.testing.assert_array_equal(again.start, problem.start)
    at["xyz"] = [5.0, 0.0, 0.0]
    told = "no start in 'start_region': of 100 poses, 100 without inverse kinematics"
    refused(told, PlanningProblem.from_dict, asked)


def test_files_of_before_still_load(tmp_path):
    """Files of old versions: every pose is a matrix, sampled goals are stored beside the region."""
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


def test_a_scene_out_of_reach_is_suspected(problem, caplog):
    """A path beside a box of 300 x 600 x 20 m, meant in mm, 670 m away was once certified."""
    box = SceneObject("shelf", Box((0.3, 0.6, 0.02)), pose((0.6, 0.0, 0.3)))
    for far, told in ((0.0, False), (5.4, True)):
        moved = replace(box, T_world_object=pose((0.6 + far, 0.0, 0.3)))
        own = replace(problem, scene=Scene("room", (moved,)), goals=problem.goals[:0])
        PlanningProblem.from_dict(own.to_dict())
        assert ("m: the nearest, 'shelf', is" in caplog.text) == told


@pytest.mark.parametrize(
    ("constraint", "pose_of"),
    [
        (
            {"upright": {"tilt": 0.0, "axis": "-z"}},
            {"xyz": [0.5, -0.2, 0.4], "rpy": [3.1416, 0, 0]},
        ),
        (
            {"fixed-orientation": {"tolerance": 0, "rpy": [3.141592653589793, 0, 0]}},
            {"xyz": [0.5, -0.2, 0.4], "rpy": [3.1416, 0, 0]},
        ),
        (
            {"plane": {"normal": [0.6, 0, 0.8], "point": [0.5, 0, 0.4]}},
            {"xyz": [0.43333, -0.2, 0.45], "rpy": [3.14, 0, 0]},
        ),
    ],
)
def test_a_pose_with_rounded_numbers_keeps_an_exact_bound(problem, constraint, pose_of):
    """Pose and bound differ by 2e-6 to 1e-5; larger differences are refused with the amount."""
    plain = problem.to_dict()
    data = {key: plain[key] for key in ("schema", "name", "robot")}
    data |= {"constraint": constraint, "scene": {"name": "empty", "objects": []}}
    data |= {"start_region": {"pose": {"at": pose_of}}, "goal_region": {"pose": {"at": pose_of}}}
    found = PlanningProblem.from_dict(data)
    assert np.linalg.norm(found.manifold.residual(found.start)) <= 1e-4
    np.testing.assert_allclose(found.robot.pose(found.start)[:3, 3], pose_of["xyz"], atol=1e-4)
    apart = {**pose_of, "rpy": [3.1426, 0, 0], "xyz": np.add(pose_of["xyz"], [0, 0, 1e-3]).tolist()}
    told = "no start in 'start_region': .* in collision; .*every pose breaks .* by 0.00"
    refused(told, PlanningProblem.from_dict, data | {"start_region": {"pose": {"at": apart}}})


def test_points_far_from_a_near_frame_are_suspected_and_then_refused(problem, caplog):
    """Frames at the robot's base; a cloud and a mesh 12 m away, of a wrong frame, were certified.

    Kinds that are made from measured points were never refused, however far.
    """
    corners = np.array([[x, y, z] for x in (0.0, 0.2) for y in (0.0, 0.2) for z in (0.0, 0.2)])
    shapes = {
        "cloud": lambda away: PointCloud(corners + (away, 0.0, 0.0), 0.01),
        "map": lambda away: map_of_points(corners + (away, 0.0, 0.0), 0.02),
        "mesh": lambda away: ConvexMesh(corners + (away, 0.0, 0.0)),
    }
    for name, shape in shapes.items():
        for away, times in ((0.6, 0), (12.0, 1)):
            caplog.clear()
            scene = Scene("room", (SceneObject(name, shape(away), np.eye(4)),))
            PlanningProblem.from_dict(
                replace(problem, scene=scene, goals=problem.goals[:0]).to_dict()
            )
            told = (
                rf"no obstacle is in the arm's reach of .* the nearest, '{name}', is 1[12](\.\d)? m"
            )
            assert len(re.findall(told, caplog.text)) == times
        scene = Scene("room", (SceneObject(name, shape(120.0), np.eye(4)),))
        far = replace(problem, scene=scene, goals=problem.goals[:0]).to_dict()
        refused(f"'{name}', is 1[12].* m away, more than 100", PlanningProblem.from_dict, far)


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


def arrays_of(value, where, seen):
    """Yield every array that is reached from a value, with its path of fields."""
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
    problem = with_drawn_goals(problem)
    _ = problem.robot.turning, problem.manifold.regions, problem.robot.kinematics_digest
    robot, load = problem.robot, problem.attachments
    cached = robot_arrays(robot, load), robot_swing(robot, load), scene_arrays(problem.scene, 1.0)
    found = dict(arrays_of((problem, cached), "problem", {}))
    assert len(found) > 60
    assert [where for where, array in found.items() if array.flags.writeable] == []
    with pytest.raises(ValueError, match="read-only"):
        lower = problem.robot.lower
        lower -= 0.5


def test_a_goal_stays_where_a_whole_turn_of_a_joint_would_break_the_constraint():
    robot = robot_from_source({"name": "kinova"})
    first, fourth = robot.joint_names[0], robot.joint_names[3]
    coupling = JointCoupling({first: 1.0, fourth: -2.0}, lower=-0.01, upper=0.01)
    start = np.array([-1.0, 2.9, 1.3, -0.5, 1.4, 0.0])
    # nearer to the start is -0.28 of the first joint and -3.28 of the other one
    goal = np.array([6.0, 2.9, 1.3, 3.0, 1.4, 0.0])
    problem = PlanningProblem(
        "p", robot, Scene("s", ()), start=start, goals=[goal], constraint=(coupling,)
    )
    np.testing.assert_array_equal(problem.goals, [goal])
    check_problem(problem)
    free = replace(problem, constraint=())
    np.testing.assert_allclose(free.goals[0, [0, 3]], [6.0 - 2 * np.pi, 3.0 - 2 * np.pi])


def test_an_unknown_joint_of_a_coupling_is_refused_with_the_file(tmp_path):
    """The file was not named: the joint was refused while planning."""
    bound = {"joint-coupling": {"factors": {"left_rial": 1.0}}}
    states = np.zeros((2, 1))
    told = (
        f"{tmp_path / 'problem.json'}: unknown joint of robot gantry in joint-coupling 'left_rial'"
    )
    refused(told, problem_of, tmp_path, gantry(), states, ("left",), constraint=[bound])


def test_a_base_inside_an_obstacle_is_named_where_the_start_collides(panda):
    """The floor is 5 cm too high for the base, and reaches the shoulder."""
    scene = Scene("room", (SceneObject("floor", Box((3.0, 3.0, 1.0)), pose((0.0, 0.0, -0.2))),))
    start = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8])
    asked = PlanningProblem("sunk", panda, scene, start, start[None] + 0.1)
    told = refused("start is in collision", check_problem, asked)
    assert "the base stands in an obstacle, too (panda_link0" in told and "'base'" in told


def test_no_projection_is_advised_where_the_projection_failed(problem):
    far = TaskSpaceRegion(pose((1000.0, 0.0, 0.0)), np.eye(4), np.zeros((6, 2)))
    told = refused(
        "projection of the start fails", with_projected_start, problem.changed(constraint=(far,))
    )
    assert "--project-start" not in told
