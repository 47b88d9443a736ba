"""The codec: values from json, and one-line errors that name the wrong field."""

import re
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.codec import Checked, Document, Tagged, from_plain, to_plain
from cvqmpt_lab.poses import Pose, pose
from cvqmpt_lab.values import Array, Length, Name


@dataclass(frozen=True, eq=False)
class Ball(Checked):
    radius: Length


@dataclass(frozen=True, eq=False)
class Mesh(Checked):
    points: Annotated[np.ndarray, Array((None, 3), "points x, y, z [m]")]


@dataclass(frozen=True, eq=False)
class Thing(Checked):
    name: Name
    shape: Annotated[Ball | Mesh, Tagged("type", {"ball": Ball, "mesh": Mesh})]
    place: Pose = field(default_factory=lambda: np.eye(4))
    colour: Literal["red", "blue"] = "red"
    mass: float | None = None
    count: int = 1
    solid: bool = True


@dataclass(frozen=True, eq=False)
class Heap(Document):
    SCHEMA = "heap/1"
    things: tuple[Thing, ...]


BALL = {"name": "a", "shape": {"type": "ball", "radius": 0.1}}


def test_defaults_are_left_out_and_may_be_missing_unless_all_is_asked_for():
    thing = from_plain(Thing, BALL)
    assert to_plain(thing) == BALL
    complete = to_plain(thing, complete=True)
    assert complete["mass"] is None and complete["count"] == 1
    told = "place is missing; fields: name, shape, place"
    refused(told, from_plain, Thing, BALL, complete=True)


def mesh(points):
    return {"shape": {"type": "mesh", "points": points}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nmae": "a"}, "nmae is unknown; did you mean 'name'?; fields: name, shape"),
        ({"name": ""}, "name is ''; it must be 1 to 200 printable characters"),
        ({"name": "a\nb"}, "name is 'a\\nb'; it must be"),
        ({"name": "a\x1b[31mb"}, "name is 'a\\x1b[31mb'; it must be"),
        ({"name": 5}, "name is 5; it must be str"),
        ({"name": "x" * 400_000}, "name is 'xxxx"),
        ({"mass": "2"}, "mass is '2'; it must be a finite float"),
        ({"mass": True}, "mass is True; it must be a finite float"),
        ({"mass": 10**400}, "mass is 1000"),
        ({"mass": float("nan")}, "mass is nan; it must be a finite float"),
        ({"count": 1.5}, "count is 1.5; it must be int"),
        ({"count": -1}, "count is -1; it cannot be negative"),
        ({"solid": 1}, "solid is 1; it must be bool"),
        ({"colour": "rde"}, "'rde'; valid choices: red, blue; did you mean 'red'?"),
        ({"colour": []}, "valid choices: red, blue"),
        ({"shape": []}, "shape is []; it must be an object with 'type', one of ball, mesh"),
        ({"shape": {"radius": 1.0}}, "shape.type is missing; one of ball, mesh"),
        ({"shape": {"type": []}}, "shape.type []; valid choices: ball, mesh"),
        ({"shape": {"type": "bell"}}, "shape.type 'bell'; valid choices: ball, mesh; did you"),
        ({"shape": {"type": "ball"}}, "shape.radius is missing; fields: radius"),
        ({"shape": {"type": "ball", "radius": 0}}, "shape.radius is 0.0; it must be a positive"),
        (mesh([[1, 2, "3"]]), "shape.points is [[1, 2, '3']]; it must"),
        (mesh([[1, 2, True]]), "shape.points is [[1, 2, True]]"),
        (mesh([[1, 2, 10**400]]), "shape.points is [[1, 2, 1000"),
        (mesh([[1, 2], [3]]), "shape.points is [[1, 2], [3]]; it"),
        (mesh([[1, 2]]), "shape (1, 2); it must be (any, 3) points x, y, z"),
        (mesh([[1, 2, np.inf]]), "shape.points[0, 2] is NaN or inf"),
        ({"place": [1]}, "place has shape (1,); it must be (4, 4)"),
        ({"place": "here"}, "it must be numbers, or {xyz, rpy} or {xyz, quaternion}"),
        ({"place": {"xyz": [1, 2]}}, "place.xyz is [1, 2]; it must be a list of 3"),
        ({"place": {"xzy": [1, 2, 3]}}, "place.xzy is unknown; did you mean 'xyz'?"),
        ({"place": {"quaternion": [0, 0, 0, 2]}}, "quaternion [x, y, z, w] has length 2"),
        ({"place": {"rpy": [0] * 3, "quaternion": [0, 0, 0, 1]}}, "give 'rpy' or 'quaternion'"),
    ],
)
def test_the_wrong_field_is_named_by_its_path(change, message):
    data = {"things": [BALL | {"_comment": "what it is for"} | change]}
    said = refused(re.escape(message), from_plain, Heap, data)
    assert "things[0]." in said and len(said) < 600


@pytest.mark.parametrize(
    ("matrix", "fault"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "rotation part is mirrored"),
        (np.diag([1.0, 1.0, 1.0, 5.0]), "last row is [0.0, 0.0, 0.0, 5.0], not 0 0 0 1"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "rotation part is not orthonormal"),
        (np.diag([1e308, 1.0, 1.0, 1.0]), "rotation part is not orthonormal"),
        (np.eye(4) + np.eye(4)[:, 3:] * [1, 0, 0, 0], "last row is [1.0, 0.0, 0.0, 1.0]"),
    ],
    ids=["mirrored", "bottom row 5", "scaled", "huge", "sheared"],
)
def test_only_rigid_poses_are_poses(matrix, fault):
    told = re.escape(f"things[0].place is no rigid pose: its {fault}")
    refused(told, from_plain, Heap, {"things": [BALL | {"place": matrix.tolist()}]})
    refused("Thing 'a': place is no rigid pose", Thing, "a", Ball(0.1), matrix)


def test_poses_are_written_by_people_in_three_ways():
    turned = pose((1.0, 2.0, 3.0), np.pi / 2)
    quaternion = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]
    turns = {"rpy": [0, 0, np.pi / 2]}, {"quaternion": quaternion}
    for data in (turned.tolist(), *({"xyz": [1, 2, 3], **turn} for turn in turns)):
        found = from_plain(Thing, BALL | {"place": data}).place
        np.testing.assert_allclose(found, turned, atol=1e-15)
    rolled = from_plain(Thing, BALL | {"place": {"rpy": [np.pi / 2, 0.0, np.pi / 2]}}).place
    roll_first = rolled[:3, :3] @ (0, 1, 0)  # about the fixed x
    np.testing.assert_allclose(roll_first, (0, 0, 1), atol=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"schema": "heap/1", "things": [], "things": []}', "'things' occurs twice"),
        ('{"schema": "heap/1", "things": NaN}', "heap.json: things is nan; it must be a list"),
        ('{"things": ' + "[" * 100_000, "heap.json is not json"),
        ('{"things": ' + "1" * 5000 + "}", "heap.json is not json"),
        ("[]", "heap.json must hold one json object"),
        ('{"things": []}', "heap.json: schema is None; this version reads 'heap/1'"),
        ('{"schema": [], "things": []}', "heap.json: schema is []; this version"),
        ('{"schema": "heap/1", "things": 5}', "heap.json: things is 5; it must be a list"),
    ],
)
def test_a_file_that_cannot_be_read_is_named_in_one_line(tmp_path, text, message):
    path = tmp_path / "heap.json"
    path.write_text(text)
    assert len(refused(re.escape(message), Heap.load, path)) < 400
