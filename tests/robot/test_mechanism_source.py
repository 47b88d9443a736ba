"""A robot with a door or drawer in files, and objects that are refused."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from cvqmpt_lab.codec.plain import from_plain, to_plain
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.mechanism import ArticulatedObject, with_articulated_object
from cvqmpt_lab.scene.articulation import take_out
from cvqmpt_lab.scene.kitchen import kitchen
from experiments.suites.door_task import BAR, bar_pose, door_problem, door_world
from experiments.suites.place_task import DOOR

AWAY = np.array([2.8, 0.3, 0.0, -1.5, 0.0, 1.571, 0.785])  # the arm looks away from the kitchen


@pytest.fixture(scope="module")
def world():
    return door_world()


@pytest.fixture(scope="module")
def grasp():
    """A start of the door task: the hand holds the closed door's handle."""
    return door_problem(0).start


def test_a_problem_comes_back_from_its_file(tmp_path):
    problem = door_problem(0)
    problem.save(tmp_path / "door.json")
    again = PlanningProblem.load(tmp_path / "door.json")
    assert again.to_dict() == problem.to_dict() and again.robot.joint_names == problem.robot.joint_names
    assert again.constraint[0].base == BAR and again.scene == problem.scene
    q = problem.start + 0.05
    np.testing.assert_array_equal(again.manifold.residual(q), problem.manifold.residual(q))


def test_what_is_no_door_or_an_angle_outside_its_range_is_refused(grasp):
    with pytest.raises(UnknownChoiceError, match=r"'fridge'.*dagger_door_left"):
        take_out(kitchen(), "fridge")
    for angle in (-1.6, 0.1):
        for made in (bar_pose, partial(door_problem, 0)):
            with pytest.raises(
                InvalidInputError, match=rf"value {angle} of hinge '{DOOR}'.*\[-1.57, 0.0\] rad"
            ):
                made(angle=angle)
        with pytest.raises(InvalidInputError, match=f"start is outside the limits: {DOOR} by"):
            replace(door_problem(0), start=np.append(grasp[:7], angle))


def test_bad_objects_are_refused(panda, world):
    _, robot = world
    item = from_plain(ArticulatedObject, robot.source["articulated"])
    data = to_plain(item)
    with pytest.raises(InvalidInputError, match="has an articulated object already"):
        with_articulated_object(robot, item)
    with pytest.raises(UnknownChoiceError, match=r"'palm'.*panda_hand_0"):
        with_articulated_object(panda, replace(item, may_touch=(("palm", BAR),)))
    with pytest.raises(UnknownChoiceError, match=f"'knob'.*{BAR}"):
        with_articulated_object(panda, replace(item, may_touch=(("panda_hand_0", "knob"),)))
    with pytest.raises(InvalidInputError, match="'panda_hand' already"):
        with_articulated_object(panda, replace(item, name="panda_hand"))
    flat = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    for changes, message in [
        ({"kind": "ball"}, "'ball'.*hinge, slider"),
        ({"lower": 0.0}, r"range \[0.0, 0.0\]"),
        ({"upper": None}, "articulated.upper is None"),
        ({"parts": []}, "moves nothing"),
        ({"velocity": 0.0}, "velocity is 0.0"),
        ({"T_world_joint": [[1.0]]}, "T_world_joint has shape"),
        ({"may_touch": ["x"]}, "may_touch.*must be a list"),
        ({"casing": data["parts"]}, "two pieces called"),
        ({"parts": [{"name": "p", "T": np.eye(4).tolist(), "vertices": [[0, 0, 0]]}]}, "m thick"),
        ({"parts": [{"name": "p", "T": np.eye(4).tolist(), "vertices": flat}], "may_touch": []}, "0 m thick"),
        ([1], "must be an object"),
        ({"name": "door", "kind": None}, "kind"),
    ]:
        with pytest.raises((InvalidInputError, UnknownChoiceError), match=message):
            wrong = data | changes if isinstance(changes, dict) else changes
            robot_from_source({**panda.source, "articulated": wrong})
