"""Bounds that bind nothing are refused with the unit asked; ways to say "free" are not."""

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.cli.main import main
from cvqmpt_lab.constraints.named import region
from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.features.moveit_requests.motion_request import _joint, _orientation
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene

AT = {"xyz": [0.3, 0.0, 0.5]}


@pytest.fixture(scope="module", params=["ur5", "panda"])
def robot(request):
    return robot_from_source({"name": request.param})


def problem(robot, *members, **fields):
    """Return a problem with a constraint."""
    start = 0.5 * (robot.lower + robot.upper)
    return PlanningProblem(
        "p", robot, Scene("empty", ()), start, start[None], constraint=members, **fields
    )


def rows(*bounds):
    """Return a region at the origin with symmetric bounds (6,)."""
    return TaskSpaceRegion(np.eye(4), np.eye(4), np.array([[-x, x] for x in bounds]))


DEGREES = {
    "upright": {"tilt": 5.0},
    "upright-box": {"tilt": 4.0},
    "fixed-orientation": {"tolerance": 3.5},
    "look-at": {"point": [0.6, 0.0, 0.0], "angle": 5.0},
    "pose": {"at": AT, "tilt": 5.0},
}


@pytest.mark.parametrize("name", DEGREES)
def test_degrees_are_asked_of_every_name(robot, name):
    told = r"constraint\[0\]: .* rad is more than half a turn .*: degrees\? . deg|.* deg = 0\.0"
    refused(told, problem, robot, region(name, **DEGREES[name]))


def test_degrees_are_asked_of_rows_and_of_regions_of_ends(robot):
    for row in (3, 4, 5):
        bounds = [FREE] * 6
        bounds[row] = 5.0
        refused("5 deg = 0.0873 rad; pi leaves it free", problem, robot, rows(*bounds))
    turned = region("pose", at=AT, yaw=5.0)
    told = "goal_region: rotation about z: 5 rad"
    refused(told, problem, robot, goal_region=turned)


LENGTHS = {
    "plane": {"normal": [0, 0, 1], "point": [0, 0, 0.5], "tolerance": 5.0},
    "line": {"direction": [0, 1, 0], "point": [0.3, 0, 0.5], "tolerance": 5.0},
    "on-sphere": {"centre": [0, 0, 0.3], "radius": 0.4, "tolerance": 5.0},
    "on-cylinder": {"direction": [0, 0, 1], "point": [0, 0, 0.3], "radius": 0.4, "tolerance": 5.0},
    "distance": {"bounds": [0.0, 5.0]},
    "pose": {"at": AT, "position": 5.0},
}


@pytest.mark.parametrize("name", LENGTHS)
def test_millimetres_are_asked_of_every_name(robot, name):
    told = r"m bounds nothing, as .* reaches at most .* m from there: millimetres\? 5"
    refused(told, problem, robot, region(name, **LENGTHS[name]))


def test_a_bound_that_binds_at_any_state_is_no_mistake(robot):
    """The reach that is compared contains all states that the robot really reaches."""
    states = robot.random_configurations(np.random.default_rng(0), 300)
    far = np.abs(robot.poses(states)[:, :3, 3]).max()
    refused("bounds nothing", problem, robot, rows(3.0, 3.0, 3.0, *[FREE] * 3))
    problem(robot, rows(far - 0.01, *[3.0] * 2, *[FREE] * 3))
    moved = TaskSpaceRegion(pose((9.0, 0.0, 0.0)), pose((0.0, 0.0, 1.0)), rows(9.0, *[5.0] * 5).Bw)
    refused("5 rad", problem, robot, moved)
    problem(robot, moved.changed(Bw=rows(9.0, *[9.0] * 2, *[FREE] * 3).Bw))


@pytest.mark.parametrize("free", [np.pi, 3.14, 3.15, 3.2, 6.28, 2 * np.pi])
def test_ways_to_say_free_are_read(robot, free):
    problem(robot, rows(FREE, FREE, 0.5, free, free, free))
    problem(robot, region("pose", at=AT, position=0.1, tilt=free, yaw=free))
    made = region("look-at", point=[0.6, 0.0, 0.0], angle=free, distance=[0.3, 5.0])
    inner = problem(robot, made, region("upright", tilt=free)).changed(
        constraint=(made.inset(0.3, 0.3), region("upright", tilt=free).inset(0.3, 0.3))
    )
    assert inner.regions[1].bounded_rows.size == (free < np.pi)
    one_sided = TaskSpaceRegion(np.eye(4), np.eye(4), np.array([[-FREE, FREE]] * 6))
    problem(
        robot, one_sided.changed(Bw=np.array([[-FREE, FREE]] * 2 + [[0.1, 5.0]] + 3 * [[-1, free]]))
    )


def test_a_note_says_which_region_binds_nothing(robot):
    """A file with tilt 3.2, perhaps degrees, was certified without a word."""
    made = problem(robot, region("upright", tilt=0.1), region("upright", tilt=3.2))
    (note,) = (note for note in made.notes if "binds nothing" in note)
    assert note.startswith("constraint[1] binds nothing")


def test_a_joint_coupling_that_binds_nothing_is_refused(robot):
    one, other = robot.joint_names[:2]
    factors = {one: 1.0, other: -2.0}
    wide = region("joint-coupling", factors=factors, lower=-45.0, upper=45.0)
    refused("bounds nothing: by the joint limits, the sum is", problem, robot, wide)
    problem(robot, region("joint-coupling", factors=factors, lower=-45.0, upper=1.0))


def test_a_chain_is_compared_with_the_reach_of_both_hands():
    robot = robot_from_source({"name": "baxter"})
    left, right = robot.end_effectors
    near = region("relative-pose", base=left, at=AT, position=1.5).changed(end_effector=right)
    assert isinstance(near, TaskSpaceRegionChain)
    problem(robot, near)
    for fields, told in (({"position": 5.0}, "millimetres"), ({"rotation": 5.0}, "degrees")):
        wide = region("relative-pose", base=left, at=AT, **fields).changed(end_effector=right)
        refused(told, problem, robot, wide)


def test_degrees_are_asked_on_the_command_line(capsys):
    q = "0,-0.785,0,-2.356,0,1.571,0.785"
    words = ["plan", "--robot", "panda", f"--start={q}", f"--goal={q}"]
    for text in (
        "upright=5",
        "fixed-orientation=5",
        '{"look-at": {"point": [1, 0, 0], "angle": 5}}',
    ):
        assert main([*words, "--constraint", text]) == 2
        assert "5 deg = 0.0873 rad" in capsys.readouterr().err


@pytest.mark.parametrize("kind", [0, 1])
def test_degrees_are_asked_of_requests_of_moveit(panda, kind):
    fields = {
        "header": {"frame_id": "panda_link0"},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        "link_name": "panda_hand",
        "parameterization": kind,
        **{f"absolute_{axis}_axis_tolerance": 0.1 for axis in "xyz"},
    }
    for free in (3.15, 2 * np.pi, 3.14159):
        _orientation({**fields, "absolute_z_axis_tolerance": free}, panda)
    told = "absolute_z_axis_tolerance: 5 rad .* degrees"
    refused(told, _orientation, {**fields, "absolute_z_axis_tolerance": 5.0}, panda)
    joint = {"joint_name": "panda_joint1", "position": 0.0, "tolerance_above": 5.0}
    refused("tolerance of panda_joint1: 5 rad", _joint, {**joint, "tolerance_below": 5.0}, panda)
    for below, above in ((0.1, 5.0), (6.28, 6.28), (3.14, 3.14)):
        _joint({**joint, "tolerance_below": below, "tolerance_above": above}, panda)
