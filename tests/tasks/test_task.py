"""Tasks as data: json, and sequences of phases that must be refused."""

import json
from dataclasses import replace

import pytest

from cvqmpt_lab.errors import CvqmptError, InvalidInputError
from cvqmpt_lab.tasks.task import Grasp, Release, Task
from cvqmpt_lab.tasks.world import World
from experiments.suites.place_task import carried_can


def changed(task, which, **fields):
    """The task with fields of one phase changed."""
    assert which in [phase.name for phase in task.phases]
    return replace(task, phases=tuple(replace(p, **fields) if p.name == which else p for p in task.phases))


def without(task, name):
    return replace(task, phases=tuple(phase for phase in task.phases if phase.name != name))


def grasping_twice(task):
    again = Grasp("again", "mustard_bottle", {}, carried_can())
    return replace(task, phases=(*task.phases[:7], again, *task.phases[7:]))


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ((7, "goal"), None, r"phases\[7\].goal is missing"),
        ((2, "constraint"), None, r"phases\[2\].constraint is missing"),
        ((5, "distance"), None, r"phases\[5\].distance is missing"),
        ((7, "kind"), None, r"phases\[7\].kind is missing; one of move, slide, turn"),
        ((7, "kind"), [], r"unknown phases\[7\].kind \[\]; valid choices: move, slide"),
        ((7, "constraints"), [], r"phases\[7\].constraints is unknown; did you mean 'constraint'"),
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
        (lambda task: without(task, "hold-handle"), "'open-door': the hand holds no door or drawer"),
        (lambda task: without(task, "grasp-can"), "'put-down': the gripper holds nothing to release"),
        (lambda task: changed(task, "grasp-can", object="cup"), "'grasp-can': unknown object .*'cup'"),
        (lambda task: changed(task, "hold-handle", articulation="lid"), "unknown articulation"),
        (lambda task: changed(task, "open-door", value=-2.0), "'open-door': value -2.0 of hinge .* outside"),
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
    with pytest.raises(InvalidInputError, match=r"'grasp-can': 'can' is .* m from where the hand closes"):
        start.after(next(phase for phase in task.phases if isinstance(phase, Grasp)))
