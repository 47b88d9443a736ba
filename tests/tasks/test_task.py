"""Tasks as data: json, and sequences of phases that must be refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.benchmarks.multi_sequence import CAN_NAME
from cvqmpt_lab.benchmarks.place_task import carried_can
from cvqmpt_lab.certificate import FaultKind, certify
from cvqmpt_lab.errors import CvqmptError, InvalidInputError
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder, OccupancyMap, Sphere
from cvqmpt_lab.tasks.task import Grasp, Release, Task
from cvqmpt_lab.tasks.world import World


def changed(task, which, **fields):
    """The task with fields of one phase changed."""
    assert which in [phase.name for phase in task.phases]
    return replace(
        task, phases=tuple(replace(p, **fields) if p.name == which else p for p in task.phases)
    )


def without(task, name):
    return replace(task, phases=tuple(phase for phase in task.phases if phase.name != name))


def grasping(task, shape):
    """The task with a written attachment of a shape."""
    return changed(task, "grasp-can", attachment=replace(carried_can(), shape=shape))


def grasping_a_map(task):
    cells = replace(task.scene[CAN_NAME], name="map", shape=OccupancyMap(np.zeros((1, 3))))
    return changed(replace(task, scene=task.scene.with_objects(cells)), "grasp-can", object="map")


def grasping_twice(task):
    again = Grasp("again", "mustard_bottle", {})
    return replace(task, phases=(*task.phases[:7], again, *task.phases[7:]))


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ((7, "goal"), None, r"phases\[7\].goal is missing"),
        ((7, "kind"), None, r"phases\[7\].kind is missing; one of move, slide, turn"),
        ((7, "kind"), [], r"unknown phases\[7\].kind \[\]; valid choices: move, slide"),
        ((5, "distance"), "far", r"phases\[5\].distance is 'far'"),
        (("start",), [0.0] * 6, r"start has shape \(6,\), robot panda needs \(7,\)"),
    ],
)
def test_a_wrong_field_is_named(task, tmp_path, path, value, message):
    data, (*which, field), file = task.to_dict(), path, tmp_path / "task.json"
    place = data["phases"][which[0]] if which else data
    if value is None:
        del place[field]
    else:
        place[field] = value
    file.write_text(json.dumps(data))
    with pytest.raises(CvqmptError, match=message) as error:
        Task.load(file)
    assert str(file) in str(error.value)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda task: without(task, "let-go"), "'reach-can': the hand holds 'dagger_door_left'"),
        (
            lambda task: without(task, "hold-handle"),
            "'open-door': the hand holds no door or drawer",
        ),
        (
            lambda task: without(task, "grasp-can"),
            "'put-down': the gripper holds nothing to release",
        ),
        (
            lambda task: changed(task, "grasp-can", object="cup"),
            "'grasp-can': unknown object .*'cup'",
        ),
        (lambda task: grasping(task, Sphere(1e-3)), "'grasp-can': type .* is 'Sphere'.*'Cylinder'"),
        (
            lambda task: grasping(task, Cylinder(0.0373, 0.237)),
            "height .* is 0.237, that of 'can' .* 0.242",
        ),
        (
            grasping_a_map,
            "'grasp-can': attachment 'map' is an occupancy map; what is carried is a solid",
        ),
        (lambda task: changed(task, "hold-handle", articulation="lid"), "unknown articulation"),
        (
            lambda task: changed(task, "open-door", value=-2.0),
            "'open-door': value -2.0 of hinge .* outside",
        ),
        (lambda task: changed(task, "put-down", name="carry"), "'carry' occurs twice"),
        (lambda task: replace(task, phases=(Release("r", {}),)), "plans nothing"),
        (grasping_twice, "'again': the gripper already holds 'can'"),
    ],
)
def test_phases_that_cannot_follow_are_refused(task, spoil, message):
    with pytest.raises(InvalidInputError, match=message):
        spoil(task)


def test_a_hand_that_closes_where_nothing_is(task):
    start = World.before(task)
    with pytest.raises(
        InvalidInputError, match=r"'grasp-can': 'can' is more than 0.02 m from the arm"
    ):
        start.after(next(phase for phase in task.phases if isinstance(phase, Grasp)))


QUARTER_ABOUT_X = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])


@pytest.mark.parametrize(
    ("T_written", "refused"),
    [
        (pose((0.0, 0.0, 0.019)), ""),
        (pose((0.0, 0.0, 0.0), 1.5), ""),  # about the can's own axis
        (pose((0.0, 0.0, 0.021)), "'can' is 0.021 m and 0.00 rad from where the hand closes"),
        (QUARTER_ABOUT_X, "'can' is 0.000 m and 1.57 rad"),
    ],
)
def test_what_is_carried_is_the_object_of_the_scene_wherever_it_was_expected(
    task_solution, T_written, refused
):
    carrying = task_solution.outcomes[-1].world
    can, item = carrying.held.attachment, carrying.held.item
    before = replace(carrying, held=None, scene=carrying.scene.with_objects(item))
    phase = Grasp(
        "grasp-can", CAN_NAME, {}, replace(can, T_hand_object=can.T_hand_object @ T_written)
    )
    if refused:
        with pytest.raises(InvalidInputError, match=refused):
            before.after(phase)
        return
    held = before.after(phase).held.attachment
    T_world_held = before.arm.pose(before.q) @ held.T_hand_object
    np.testing.assert_allclose(T_world_held, item.T_world_object, atol=1e-12)
    assert held == can and held.shape == item.shape


def test_a_carried_can_hits_a_board_that_one_5_mm_shorter_does_not(task_solution):
    solution, item = task_solution.outcomes[-1].solution, task_solution.outcomes[-1].world.held.item
    top = item.T_world_object[2, 3] - item.shape.height / 2 + 0.0025
    board = SceneObject(
        "board", Box((0.05, 0.05, 0.1)), pose((*item.T_world_object[:2, 3], top - 0.05))
    )
    problem = replace(solution.problem, scene=solution.problem.scene.with_objects(board))
    faults = certify(problem, solution.simplified.path).faults
    assert [fault.kind for fault in faults] == [FaultKind.COLLISION] and "can and board" in faults[
        0
    ].text
