"""Wrong problem files end in one line: the file, the path of the field, its value, and the cure."""

import json
import re

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem

READY = [0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8]
SPHERE = {"type": "sphere", "radius": 0.1}
HERE, FAR = np.eye(4).tolist(), pose((1e300, 0.0, 0.0)).tolist()
BALL = {"name": "b", "shape": SPHERE, "T_world_object": {"xyz": [2, 0, 0]}}
CAN = {"name": "can", "shape": SPHERE, "T_hand_object": HERE}
REGION = {"T0_w": {"xyz": [0.4, 0, 0.5]}, "Tw_e": {}, "Bw": [[-1, 1]] * 6}
GOOD = {
    "schema": "cvqmpt-problem/1",
    "name": "mine",
    "robot": {"name": "panda"},
    "scene": {"name": "room", "objects": [BALL]},
    "constraint": [REGION],
    "attachments": [CAN],
    "start": READY,
    "goals": [READY],
}
SHAPE, POSE = "scene.objects.0.shape", "scene.objects.0.T_world_object"
BOX = {"type": "box", "size": [0.1] * 3}
FAR_CLOUD = {"type": "point_cloud", "points": [[1e300, 0.0, 0.0]], "radius": 0.01}
CORNERS = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
LEAF = {"name": "leaf", "T": HERE, "vertices": CORNERS}
HINGE = {"name": "door", "kind": "hinge", "T_world_joint": HERE, "lower": 0.0, "upper": 1.0}
FAR_CASING = HINGE | {"parts": [LEAF], "casing": [LEAF | {"name": "post", "T": FAR}]}
FAR_PLANE = {"plane": {"normal": [1, 0, 0], "point": [500, 0, 0]}}
IN_DEGREES = {"pose": {"at": {"xyz": [0.5, 0, 0.3], "rpy": [180, 0, 0]}}}
FAR_OFF = "is no rigid pose: its position is 1e+300 m off"
NONE = type(None)  # take the field out


@pytest.mark.parametrize(
    ("field", "value", "line"),
    [
        ("satrt", READY, "satrt is unknown; did you mean 'start'?; fields: name, robot, scene"),
        # the first two planned without the constraint, and without the can, and were certified
        ("constraints", 0, "constraints is unknown; did you mean 'constraint'"),
        ("attachment", 0, "attachment is unknown; did you mean 'attachments'"),
        ("constraint.0.bass", 0, "bass is unknown; did you mean 'base'"),
        ("scene.articulation", 0, "articulation is unknown; did you mean 'articulations'"),
        ("scene.objects.0.sahpe", 0, "sahpe is unknown; did you mean 'shape'"),
        ("name", NONE, "name is missing; fields: name, robot, scene"),
        ("name", "", "name is ''; it must be 1 to 200 printable characters"),
        ("schema", "cvqmpt-problem/2", "schema is 'cvqmpt-problem/2'; this version reads"),
        ("schema", "cvqmpt-task/1", "schema is 'cvqmpt-task/1': give it with --task-file"),
        ("robot", "panda", "robot is 'panda'; it must be an object"),
        ("robot.name", None, "robot.name is None; it must be str"),
        ("robot.name", "pnada", "'pnada'; valid choices: panda, ur3"),
        ("robot.name", "iiwa", "robot 'iiwa' is not in the package example-robot-data"),
        ("robot.finger_opening", 0.5, "finger opening 0.5 m: give a value from 0 to 0.04 m"),
        ("robot.articulated", FAR_CASING, f"casing[0].T {FAR_OFF}"),
        ("scene", "none.json", "cannot read scene none.json: No such file or directory"),
        ("scene.objects", [BALL, BALL], "'b' occurs twice; names must be unique"),
        (f"{SHAPE}.radius", -1, "scene.objects[0].shape.radius is -1.0; it must be a positive"),
        (f"{SHAPE}.type", "sphre", "scene.objects[0].shape.type 'sphre'; valid choices: box"),
        (SHAPE, BOX | {"size": [500] * 3}, "'b', is 500 m large, more than 250: no metres?"),
        (SHAPE, {"type": "cloud_file", "path": "a", "sclae": 1}, "did you mean 'scale'?"),
        (SHAPE, {"type": "mesh_file", "path": "a.npy"}, "'.npy'; valid choices: .stl"),
        (POSE, np.diag([1.0, 1, -1, 1]).tolist(), "is no rigid pose: its rotation part is mirr"),
        (POSE, {"rpy": [0, 0, 90]}, "'rpy' holds 90, more than 2 pi: degrees? Give radians"),
        (f"{POSE}.xyz", [float("nan"), 0, 0], "T_world_object.xyz[0] is nan; it must be a finite"),
        (f"{POSE}.xyz", [500, 0, 0], "is 499.9 m off, more than 100: no metres? Give metres"),
        ("attachments", [CAN, CAN], "'can' occurs twice"),
        ("attachments.0.T_hand_object", FAR, FAR_OFF),
        ("attachments.0.shape.radius", 1e300, "positive length, up to 1e+06"),
        ("attachments.0.shape", FAR_CLOUD, "points holds 1e+300, more than 1e+06; give metres"),
        ("start", [0, -40, 0, -132, 0, 90, 45], "panda_joint4 by 128.9; degrees? Give radians"),
        ("start.0", "0.5", "start is ['0.5'"),
        ("start", [0.0] * 6, "start has shape (6,), robot panda needs (7,)"),
        ("start", "raedy", "unknown group_state of start 'raedy'; valid choices: default"),
        ("start", {"panda_jiont1": 0.0}, "'panda_jiont1'; valid choices: panda_joint1"),
        ("start", {"panda_joint1": 0.0}, "start has no value for panda_joint2"),
        ("start_region", REGION, "give 'start' or 'start_region', one of the two"),
        ("start", NONE, "give 'start' or 'start_region', one of the two"),
        ("goals", [], "give 'goals' (configurations) or a 'goal_region'"),
        ("goals", [READY, [1]], "goals is [[0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8], [1]]; it must"),
        ("goals", [[0.0] * 6], "panda needs (k, 7)"),
        ("goals.0.0", -3.0, "goal 0 is outside the limits: panda_joint1 by 0.1027"),
        ("goal_region", REGION | {"base": "panda_hand"}, "'goal_region' hangs on 'panda_hand'"),
        ("goal_region", FAR_PLANE, "goal_region: its frame is 500 m off"),
        ("goal_region", IN_DEGREES, "'rpy' holds 180, more than 2 pi: degrees"),
        ("clearance", 5, "clearance is 5.0; it must be a distance from 0 to 0.2 [m]"),
        ("constraint", {}, "constraint.T0_w is missing"),
        ("constraint", {"uprigth": 0.1}, "constraint.uprigth is unknown; did you mean 'upright'?"),
        ("constraint", {"upright": 10}, "constraint.upright.tilt is 10.0; it must be from 0 to"),
        ("constraint", [{"upright": 0.1}] * 33, "a constraint of 33 regions; at most 32"),
        ("constraint", REGION | {"Bw": [[1, -1]] * 6}, "constraint.Bw[0], position x [m], is [1.0"),
        ("constraint", REGION | {"base": "panda_hadn"}, "did you mean 'panda_hand'?"),
        ("constraint.0.Bw", [[0, 1]] * 5, "must be 6 rows"),
        ("constraint.0.Tw_e", FAR, f"constraint[0].Tw_e {FAR_OFF}"),
    ],
    ids=str,
)
def test_one_line_names_the_field_and_the_cure(field, value, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = json.loads(json.dumps(GOOD))
    holder, keys = data, [int(key) if key.isdecimal() else key for key in field.split(".")]
    for key in keys[:-1]:
        holder = holder[key]
    holder[keys[-1]] = value
    if value is NONE:
        del holder[keys[-1]]
    (tmp_path / "mine.json").write_text(json.dumps(data))
    said = refused(re.escape(line), PlanningProblem.load, "mine.json")
    assert said.startswith("mine.json: ")


def test_the_good_file_is_good_and_a_list_is_no_problem():
    PlanningProblem.from_dict(GOOD)
    refused("must be an object with schema, name, robot", PlanningProblem.from_dict, [])
