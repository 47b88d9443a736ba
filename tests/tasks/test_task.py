"""Tasks as data: json, and sequences of phases that must be refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.tasks.task import Grasp, Release, Task
from cvqmpt_lab.tasks.world import World
from experiments.suites.place_task import carried_can


def changed(task, which, **fields):
    """The task with fields of one phase changed."""
    assert which in [phase.name for phase in task.phases]
    return replace(task, phases=tuple(replace(p, **fields) if p.name == which else p for p in task.phases))


def without(task, name):
    return replace(task, phases=tuple(phase for phase in task.phases if phase.name != name))


def test_json_round_trip(task, tmp_path):
    task.save(tmp_path / "task.json")
    again = Task.load(tmp_path / "task.json")
    assert again.to_dict() == task.to_dict()
    assert [type(phase) for phase in again.phases] == [type(phase) for phase in task.phases]


@pytest.mark.parametrize(
    ("name", "field", "message"),
    [
        ("carry", "goal", r"phases\[7\].goal is missing"),
        ("open-door", "constraint", r"phases\[2\].constraint is missing"),
        ("approach", "distance", r"phases\[5\].distance is missing"),
        ("carry", "kind", r"phases\[7\].kind is missing; one of move, slide, turn"),
    ],
)
def test_missing_fields_are_named(task, tmp_path, name, field, message):
    data = task.to_dict()
    phase = next(item for item in data["phases"] if item["name"] == name)
    del phase[field]
    file = tmp_path / "task.json"
    file.write_text(json.dumps(data))
    with pytest.raises(InvalidInputError, match=message) as error:
        Task.load(file)
    assert str(file) in str(error.value)


def test_malformed_values_are_named(task):
    data = task.to_dict()
    data["phases"][5]["distance"] = "far"
    with pytest.raises(InvalidInputError, match=r"phases\[5\].distance is 'far'"):
        Task.from_dict(data)
    data = task.to_dict()
    data["start"] = [0.0] * 6
    with pytest.raises(InvalidInputError, match=r"start has shape \(6,\), robot panda needs \(7,\)"):
        Task.from_dict(data)


def test_unknown_fields_and_kinds_are_refused(task):
    data = task.to_dict()
    data["phases"][7]["constraints"] = data["phases"][7].pop("constraint")
    with pytest.raises(
        InvalidInputError, match=r"phases\[7\].constraints is unknown; did you mean 'constraint'"
    ):
        Task.from_dict(data)
    data = task.to_dict()
    data["phases"][7]["kind"] = []
    with pytest.raises(
        UnknownChoiceError, match=r"unknown phases\[7\].kind \[\]; valid choices: move, slide"
    ):
        Task.from_dict(data)


def test_task_files_of_before_still_load(tmp_path):
    path = Path(__file__).parents[1] / "data" / "task-1.json"
    old, task = json.loads(path.read_text()), Task.load(path)
    assert [phase["name"] for phase in old["phases"]] == [phase.name for phase in task.phases]
    assert (
        task.start.tolist() == old["start"]
        and task.phases[0].goal.Bw.tolist() == old["phases"][0]["goal"]["Bw"]
    )
    task.save(tmp_path / "now.json")
    assert Task.load(tmp_path / "now.json") == task


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda task: without(task, "let-go"), "'reach-can': the hand holds 'dagger_door_left'"),
        (lambda task: without(task, "hold-handle"), "'open-door': the hand holds no door or drawer"),
        (lambda task: without(task, "grasp-can"), "'put-down': the gripper holds nothing to release"),
        (
            lambda task: changed(task, "grasp-can", object="cup"),
            "'grasp-can': unknown object .*'cup'",
        ),
        (
            lambda task: changed(task, "hold-handle", articulation="lid"),
            "'hold-handle': unknown articulation",
        ),
        (lambda task: changed(task, "open-door", value=-2.0), "'open-door': value -2.0 of hinge .* outside"),
        (lambda task: changed(task, "put-down", name="carry"), "'carry' occurs twice"),
        (lambda task: replace(task, phases=(Release("r", {}),)), "plans nothing"),
        (
            lambda task: replace(
                task,
                phases=(
                    *task.phases[:7],
                    Grasp("again", "mustard_bottle", {}, carried_can()),
                    *task.phases[7:],
                ),
            ),
            "'again': the gripper already holds 'can'",
        ),
    ],
)
def test_phases_that_cannot_follow_are_refused(task, spoil, message):
    with pytest.raises(InvalidInputError, match=message):
        spoil(task)


def test_a_hand_that_closes_where_nothing_is(task):
    start = World.before(task)
    with pytest.raises(
        InvalidInputError, match=r"phase 'grasp-can': 'can' is .* m from where the hand closes"
    ):
        start.after(next(phase for phase in task.phases if isinstance(phase, Grasp)))
