"""Tasks to start from: an arm opens a drawer or a door that stands in its reach."""

import re
from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.hold_handle import _set, hold_of
from cvqmpt_lab.benchmarks.task_template import task_template
from cvqmpt_lab.benchmarks.templates import with_limits
from cvqmpt_lab.features.tasks.solve import solve_task
from cvqmpt_lab.features.tasks.task import Slide, Task
from cvqmpt_lab.features.tasks.world import World
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.source import ARMS
from cvqmpt_lab.robot.urdf import Joint
from cvqmpt_lab.search.result import Budget

REFUSED = {  # and what their refusal says
    "so-arm": "no collision bodies at gripper",
    "two-dof": "no collision bodies at Tip",
    "finger": "its 3 joints bring finger_tip_link, -z ahead, to 0 of 320 places",
    "pr2-left": "joint 'l_shoulder_lift_joint' needs .* Nm to stand still",
    "pr2-right": "joint 'r_shoulder_lift_joint' needs .* Nm to stand still",
    "romeo-left": "its 7 joints bring l_wrist",
    "romeo-right": "its 7 joints bring r_wrist",
}
REFUSED |= {name: "has several end effectors" for name, arm in ARMS.items() if arm.end_effectors}


@cache
def made_once(name, what):
    return task_template(with_limits({"name": name})[0], what)


def template(name, what="drawer"):
    """Return a task that the test may change; it takes seconds to make."""
    return deepcopy(made_once(name, what))


def check_solved(made):
    """Assert that another seed solves the task, and that every phase is checked with obstacles."""
    solution = solve_task(Task.from_dict(made), "birrt", Budget(seconds=10.0), seed=3)
    assert solution.solved, solution.failure
    for outcome in solution.outcomes:
        assert outcome.solution.certificate.valid
    (joint,) = solution.world.scene.articulations
    assert joint.value == pytest.approx(made["phases"][3]["value"], abs=1e-6)


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("panda", "drawer"),
        ("panda", "door"),
        ("xarm7", "drawer"),
        ("ur5", "door"),
        ("ur5-gripper", "drawer"),
    ],
)
def test_an_arm_opens_what_stands_in_its_reach(name, what):
    check_solved(template(name, what))


@pytest.mark.slow
def test_every_arm_opens_one_or_says_what_is_missing(part):
    for name, what in part([(name, what) for name in ARMS for what in ("drawer", "door")], 1):
        # a hand of five joints cannot turn with a door
        if name in REFUSED or (name, what) == ("so-arm101", "door"):
            refused(REFUSED.get(name, "its 5 joints bring"), template, name, what)
        else:
            check_solved(template(name, what))


def test_the_search_for_a_place_is_counted_and_ends():
    source, calls = with_limits({"name": "panda"})[0], []
    task_template(source, report=lambda done, total: calls.append((done, total)))
    assert calls[0] == (0, 160) and calls[-1] == (160, 160)
    refused("0 s are over, and 160 places not tried", task_template, source, seconds=0.0)


@pytest.mark.slow
def test_a_hand_of_five_joints_with_a_rotary_gripper_opens_a_drawer():
    check_solved(template("so-arm101"))


def test_an_arm_on_a_base_elsewhere_gets_a_drawer_there():
    source = {"name": "ur5", "base": {"xyz": [2.0, -1.0, 0.5], "rpy": [0.0, 0.0, 1.0]}}
    made = task_template(with_limits(source)[0])
    at = made["scene"]["objects"][1]["T_world_object"]["xyz"]
    assert 0.2 < np.linalg.norm(np.subtract(at, (2.0, -1.0, 0.5))) < 1.2
    check_solved(made)


def test_a_finger_at_its_limit_stays_within_it_after_rounding():
    """The hand of the G1 was refused: its thumb was locked at 1.0472, beyond 1.04719755."""
    most = 1.04719755
    thumb = Joint("thumb", "revolute", "palm", "tip", -most, most, None, 1.0, 0.0)
    for share in (0.0, 1.0):
        assert abs(_set({}, [thumb], share)["locked"]["thumb"]) <= thumb.upper


def test_fingers_close_on_a_bar_and_a_flange_touches_a_knob():
    panda, flange, fixed = (hold_of({"name": name}) for name in ("panda", "xarm7", "ur5-gripper"))
    assert panda.opened == {"finger_opening": 0.04}
    # the bar is 14 mm thick
    assert 0.007 <= panda.closed["finger_opening"] < 0.0075
    assert {piece.rpartition("_")[0] for piece in panda.touching} == {
        "panda_leftfinger",
        "panda_rightfinger",
    }
    assert flange.bar == 0.0 and flange.touching == ("link7_0",) and not flange.closed
    # its fingers do not move: the knob goes between them, to the palm
    assert fixed.bar == 0.0 and fixed.touching == ("tool0_2",) and fixed.beyond > 0.04


def test_the_bar_can_be_held_only_by_what_may_touch_it():
    made = template("panda")
    made["phases"][2]["may_touch"] = []
    solution = solve_task(Task.from_dict(made), "birrt", Budget(seconds=1.0), seed=0)
    assert not solution.solved and "'pull'" in solution.failure


@pytest.mark.parametrize(("axis", "way"), [("z", (0, 0, 0.1)), ("-x", (-0.1, 0, 0))])
def test_a_slide_goes_along_the_axis_of_the_hand_that_is_named(axis, way):
    task = Task.from_dict(template("xarm7"))
    world, slide = World.before(task), Slide("there", 0.1, axis)
    for there, phase in ((way, slide), (np.negative(way), slide.changed(distance=-0.1))):
        problem = world.problem(task, phase)
        T = world.arm.pose(task.start)
        expected = T[:3, :3] @ there + T[:3, 3]
        np.testing.assert_allclose(problem.goal_region.T0_w[:3, 3], expected, atol=1e-12)
        middle = T[:3, :3] @ np.multiply(0.5, there) + T[:3, 3]
        for place, inside in ((middle, True), (2.0 * T[:3, 3] - middle, False)):
            off = np.linalg.inv(problem.constraint[0].T0_w)[:3] @ np.append(place, 1.0)
            bounds = problem.constraint[0].Bw[:3]
            kept = (bounds[:, 0] - 1e-9 <= off) & (off <= bounds[:, 1] + 1e-9)
            assert kept.all() == inside


def test_limits_are_written_where_they_are_known_and_guesses_are_named():
    source, notes = with_limits({"name": "panda"})
    robot = robot_from_source({"name": "panda"})
    for kind in ("acceleration", "jerk", "effort"):
        assert source[f"{kind}_limits"] == robot.limits[kind].tolist()
    assert notes == []
    source, notes = with_limits({"name": "ur5"})
    velocity = np.array(robot_from_source({"name": "ur5"}).model.upperVelocityLimit)
    np.testing.assert_allclose(source["acceleration_limits"], velocity / 0.5)
    np.testing.assert_allclose(source["jerk_limits"], velocity / 0.05)
    assert source["effort_limits"] == [150.0, 150.0, 150.0, 28.0, 28.0, 28.0]
    assert [note.split()[0] for note in notes] == ["acceleration_limits", "jerk_limits"]
    source, notes = with_limits({"name": "ur5", "acceleration_limits": 2.0})
    assert source["acceleration_limits"] == [2.0] * 6 and source["jerk_limits"] == [20.0] * 6
    assert [note.split()[0] for note in notes] == ["jerk_limits"]


def test_limits_that_nothing_is_known_of_are_not_written(slider_arm_urdf, tmp_path):
    text = re.sub(r' (velocity|effort)="[^"]*"', r' \1="0"', slider_arm_urdf.read_text())
    (tmp_path / "arm.urdf").write_text(text)
    given = {"urdf": str(tmp_path / "arm.urdf"), "end_effector": "tool"}
    source, notes = with_limits(given)
    assert source == given and len(notes) == 3
    assert all("not written: the URDF states" in note for note in notes)
