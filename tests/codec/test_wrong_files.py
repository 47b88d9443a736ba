"""Wrong problem files end in one line: the file, the path of the field, its value, and the cure."""

import copy
import json

import numpy as np
import pytest

from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.problem import PlanningProblem

READY = [0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8]
SPHERE = {"type": "sphere", "radius": 0.1}
BALL = {"name": "b", "shape": SPHERE, "T_world_object": {"xyz": [2, 0, 0]}}
REGION = {"T0_w": {"xyz": [0.4, 0, 0.5]}, "Tw_e": {}, "Bw": [[-1, 1]] * 6}
GOOD = {
    "schema": "cvqmpt-problem/1",
    "name": "mine",
    "robot": {"name": "panda"},
    "scene": {"name": "room", "objects": [BALL]},
    "start": READY,
    "goals": [READY],
}
SHAPE, POSE = "scene.objects.0.shape", "scene.objects.0.T_world_object"
NONE = type(None)  # take the field out


@pytest.mark.parametrize(
    ("field", "value", "line"),
    [
        ("satrt", READY, "satrt is unknown; did you mean 'start'?; fields: name, robot, scene"),
        ("name", NONE, "name is missing; fields: name, robot, scene"),
        ("name", "", "name is ''; it must be 1 to 200 printable characters"),
        ("schema", "cvqmpt-problem/2", "schema is 'cvqmpt-problem/2'; this version reads"),
        ("schema", "cvqmpt-task/1", "schema is 'cvqmpt-task/1': give it with --task-file"),
        ("robot.name", None, "robot.name is None; it must be str"),
        ("robot.name", "pnada", "'pnada'; valid choices: panda, ur3"),
        ("robot.name", "iiwa", "robot 'iiwa' is not in the package example-robot-data"),
        ("robot.finger_opening", 0.5, "finger opening 0.5 m: give a value from 0 to 0.04 m"),
        ("scene", "none.json", "cannot read scene none.json: No such file or directory"),
        ("scene.objects", [BALL, BALL], "'b' occurs twice; names must be unique"),
        (f"{SHAPE}.radius", -1, "scene.objects[0].shape.radius is -1.0; it must be a positive"),
        (f"{SHAPE}.type", "sphre", "scene.objects[0].shape.type 'sphre'; valid choices: box"),
        (SHAPE, {"type": "box", "size": [500] * 3}, "'b', is 500 m large, more than 250"),
        (SHAPE, {"type": "cloud_file", "path": "a", "sclae": 1}, "did you mean 'scale'?"),
        (POSE, np.diag([1.0, 1, -1, 1]).tolist(), "is no rigid pose: its rotation part is mirr"),
        (POSE, {"rpy": [0, 0, 90]}, "'rpy' holds 90, more than 2 pi: degrees? Give radians"),
        (f"{POSE}.xyz", [float("nan"), 0, 0], "T_world_object.xyz[0] is nan; it must be a finite"),
        (f"{POSE}.xyz", [500, 0, 0], "is 499.9 m off, more than 100: no metres? Give metres"),
        ("start", [0, -40, 0, -132, 0, 90, 45], "panda_joint4 by 128.9; degrees? Give radians"),
        ("start", "raedy", "unknown group_state of start 'raedy'; valid choices: default"),
        ("start", {"panda_jiont1": 0.0}, "'panda_jiont1'; valid choices: panda_joint1"),
        ("start_region", REGION, "give 'start' or 'start_region', one of the two"),
        ("goals", [], "give 'goals' (configurations) or a 'goal_region'"),
        ("goals", [READY, [1]], "goals is [[0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8], [1]]; it must"),
        ("goal_region", REGION | {"base": "panda_hand"}, "'goal_region' hangs on 'panda_hand'"),
        ("clearance", 5, "clearance is 5.0; it must be a distance from 0 to 0.2 [m]"),
        ("constraint", {"uprigth": 0.1}, "constraint.uprigth is unknown; did you mean 'upright'?"),
        ("constraint", {"upright": 10}, "constraint.upright.tilt is 10.0; it must be from 0 to"),
        ("constraint", [{"upright": 0.1}] * 33, "a constraint of 33 regions; at most 32"),
        ("constraint", REGION | {"Bw": [[1, -1]] * 6}, "constraint.Bw[0], position x [m], is [1.0"),
        ("constraint", REGION | {"base": "panda_hadn"}, "did you mean 'panda_hand'?"),
    ],
    ids=str,
)
def test_one_line_names_the_field_and_the_cure(field, value, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = copy.deepcopy(GOOD)
    holder, keys = data, [int(key) if key.isdecimal() else key for key in field.split(".")]
    for key in keys[:-1]:
        holder = holder[key]
    holder[keys[-1]] = value
    if value is NONE:
        del holder[keys[-1]]
    (tmp_path / "mine.json").write_text(json.dumps(data))
    with pytest.raises(CvqmptError) as caught:
        PlanningProblem.load("mine.json")
    assert str(caught.value).startswith("mine.json: ") and line in str(caught.value)
    assert str(caught.value).isprintable()
