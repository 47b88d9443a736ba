"""JSON schemas have the fields of the code, accept its output and refuse wrong files."""

import json
from typing import get_type_hints

import pytest
from jsonschema import Draft202012Validator
from refusals import refused

from cvqmpt_lab.base.codec import field_defaults, field_kinds
from cvqmpt_lab.base.files import json_text
from cvqmpt_lab.base.json_schema import json_schema
from cvqmpt_lab.base.poses import Placement
from cvqmpt_lab.constraints.named import NAMED_REGIONS
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.features.tasks.task import PHASES, Task
from cvqmpt_lab.planning.usable import check_problem
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import FrameLimit
from cvqmpt_lab.robot.source import RobotSource
from cvqmpt_lab.scene.scene import Articulation, Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import SHAPE_CLASSES, SHAPES_BY_PATH

KINDS = {"problem": (PlanningProblem, RobotSource, FrameLimit), "task": (Task, *PHASES.values())}
BOTH = (Scene, SceneObject, Articulation, Attachment, Placement)
BOTH += (TaskSpaceRegion, TaskSpaceRegionChain)
APART = {
    "schema",
    "$schema",
    "_comment",
    "type",
    "kind",
    "articulated",
}  # fields of every object, and names of classes
SPHERE = {"type": "sphere", "radius": 0.1}
BALL = {"name": "b", "shape": SPHERE, "T_world_object": {"xyz": [2, 0, 0]}}
START = {"pose": {"at": {"xyz": [0.4, 0.0, 0.6], "rpy": [3.0, 0.0, 0.0]}, "yaw": 3.15}}


def errors(name, data):
    schema = json_schema(KINDS[name][0])
    return [error.json_path for error in Draft202012Validator(schema).iter_errors(data)]


@pytest.fixture
def mine():
    """A problem as a user writes it."""
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


def objects_of(schema):
    """Return (all fields, required fields) of every object in a schema."""
    inside = schema.values() if isinstance(schema, dict) else schema
    found = {part for item in inside if isinstance(item, dict | list) for part in objects_of(item)}
    if isinstance(schema, dict) and "properties" in schema:
        fields, required = schema["properties"], schema.get("required", ())
        found.add((frozenset(fields) - APART, frozenset(required) - APART))
    return found


@pytest.mark.parametrize("name", KINDS)
def test_the_schemas_have_the_fields_of_the_code(name):
    schema = json_schema(KINDS[name][0])
    Draft202012Validator.check_schema(schema)
    listed = objects_of(schema)
    # a task states poses alone: the reader refuses the names of constraints that are no regions
    by_name = [
        kind
        for kind in NAMED_REGIONS.values()
        if name == "problem" or issubclass(get_type_hints(kind)["return"], TaskSpaceRegion)
    ]
    assert len(NAMED_REGIONS) - len(by_name) == (0 if name == "problem" else 2)
    for kind in (
        *KINDS[name],
        *SHAPE_CLASSES.values(),
        *SHAPES_BY_PATH.values(),
        *by_name,
        *BOTH,
    ):
        fields = frozenset(field_kinds(kind)) - APART
        assert (fields, fields - frozenset(field_defaults(kind))) in listed, kind
    assert schema["properties"]["schema"] == {"const": KINDS[name][0].SCHEMA}


@pytest.mark.parametrize("name", KINDS)
def test_files_that_the_code_writes_and_old_files_are_valid(name, request):
    old = json.loads((request.path.parents[1] / "data" / f"{name}-1.json").read_text())
    assert errors(name, old) == []
    assert errors(name, json.loads(json_text(KINDS[name][0].from_dict(old).to_dict()))) == []


@pytest.mark.parametrize(
    "change",
    [
        {"constraints": []},
        {"constraint": {"uprigth": 0.1}},
        {"constraint": {"upright": "0.1"}},
        {"start": ["0.1"]},
        {"schema": "cvqmpt-problem/2"},
        {"scene": {"name": "room"}},
        {"scene": {"name": "r", "objects": [BALL | {"shape": {"type": "cone"}}]}},
        {"goal_region": {"T0_w": {}, "Tw_e": {}, "Bw": [[0, 0]] * 5}},
    ],
    ids=str,
)
def test_the_schema_marks_errors_that_the_code_refuses(mine, change):
    assert errors("problem", mine | change)
    refused(".", PlanningProblem.from_dict, mine | change)


def test_the_example_of_the_docs_is_valid_and_can_be_planned(request):
    page = (request.config.rootpath / "docs" / "your_own.md").read_text()
    text = page.split("```json\n")[1].split("```")[0]
    assert errors("problem", json.loads(text)) == []
    check_problem(PlanningProblem.from_dict(json.loads(text)))
