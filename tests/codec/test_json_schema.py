"""The json schemas that ship are those of the code, accept what the code writes, and refuse what it
refuses.

After a change of a field: `python -m tests.codec.test_json_schema` writes them anew.
"""

import json

import pytest
from jsonschema import Draft202012Validator

from cvqmpt_lab.codec.json_schema import FOLDER, schema_of
from cvqmpt_lab.codec.plain import to_text
from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.files import write_text
from cvqmpt_lab.problem import PlanningProblem, check_problem
from cvqmpt_lab.tasks.task import Task

KINDS = {"problem": PlanningProblem, "task": Task}
BALL = {
    "name": "b",
    "shape": {"type": "sphere", "radius": 0.1},
    "T_world_object": {"xyz": [2, 0, 0]},
}
START = {"pose": {"at": {"xyz": [0.4, 0.0, 0.6], "rpy": [3.0, 0.0, 0.0]}, "yaw": 3.15}}


def errors(name, data):
    schema = json.loads((FOLDER / f"{name}.schema.json").read_text())
    return [error.json_path for error in Draft202012Validator(schema).iter_errors(data)]


@pytest.fixture
def mine():
    """A problem as a person writes it."""
    return {
        "$schema": "problem.schema.json",
        "schema": "cvqmpt-problem/1",
        "_comment": "a ball",
        "name": "mine",
        "robot": {"name": "panda"},
        "scene": {"name": "room", "objects": [BALL]},
        "constraint": {"upright": 0.3},
        "start_region": START,
        "goal_region": START,
    }


@pytest.mark.parametrize("name", KINDS)
def test_the_schemas_that_ship_are_those_of_the_code(name):
    schema = schema_of(KINDS[name])
    Draft202012Validator.check_schema(schema)
    shipped = json.loads((FOLDER / f"{name}.schema.json").read_text())
    assert shipped == schema, "python -m tests.codec.test_json_schema"


@pytest.mark.parametrize("name", KINDS)
def test_what_the_code_writes_and_wrote_is_valid(name, request):
    old = json.loads((request.path.parents[1] / "data" / f"{name}-1.json").read_text())
    assert errors(name, old) == []
    assert errors(name, json.loads(to_text(KINDS[name].from_dict(old).to_dict()))) == []


@pytest.mark.parametrize(
    "change",
    [
        {"constraints": []},
        {"constraint": {"uprigth": 0.1}},
        {"constraint": {"upright": "0.1"}},
        {"start": ["0.1"]},
        {"schema": "cvqmpt-problem/2"},
        {"scene": {"name": "room"}},
        {
            "scene": {
                "name": "r",
                "objects": [{"name": "b", "shape": {"type": "cone"}, "T_world_object": {}}],
            }
        },
        {
            "goal_region": {
                "T0_w": {"xyz": [0, 0, 0]},
                "Tw_e": {"xyz": [0, 0, 0]},
                "Bw": [[0, 0]] * 5,
            }
        },
    ],
    ids=str,
)
def test_what_the_code_refuses_is_marked(mine, change):
    assert errors("problem", mine | change)
    with pytest.raises(CvqmptError):
        PlanningProblem.from_dict(mine | change)


def test_the_example_of_the_docs_is_valid_and_can_be_planned(request):
    page = (request.config.rootpath / "docs" / "your_own.md").read_text()
    text = page.split("```json\n")[1].split("```")[0]
    assert errors("problem", json.loads(text)) == []
    check_problem(PlanningProblem.from_dict(json.loads(text)))


if __name__ == "__main__":
    for name, kind in KINDS.items():
        write_text(FOLDER / f"{name}.schema.json", to_text(schema_of(kind)) + "\n")
