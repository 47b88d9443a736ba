"""MoveIt scenes are converted shape by shape; unsupported content is refused by name."""

import json

import numpy as np
import pytest
from command_line import refused as refused_command
from refusals import DATA, refused

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.robot.load import panda
from cvqmpt_lab.scene.moveit_scenes import read_moveit_scene
from cvqmpt_lab.scene.scene_files import read_scene
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Sphere

OLDER, NEWER = ((DATA / f"{version}.scene").read_text() for version in ("older", "newer"))
CORNERS = [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]
FACES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
CAN = {"id": "can", "primitives": [{"type": "cylinder", "dimensions": [0.14, 0.03]}],
       "primitive_poses": [{"position": [0, 0, 1], "orientation": [0, 0, 0, 1]}]}  # fmt: skip
TETRAHEDRON = {
    "id": "tetrahedron",
    "pose": {"position": {"x": 1, "y": 0, "z": 0},
             "orientation": {"x": 0, "y": 0, "z": 0.7071068, "w": 0.7071068}},
    "meshes": [{"vertices": CORNERS, "triangles": [{"vertex_indices": face} for face in FACES]}],
    "mesh_poses": [{"position": [1, 0, 0], "orientation": [0, 0, 0, 1]}],
}  # fmt: skip


def read(folder, text, suffix=".scene"):
    # JSON is valid YAML
    (folder / f"a{suffix}").write_text(text if suffix == ".scene" else json.dumps(text))
    return read_moveit_scene(folder / f"a{suffix}")


def test_text_of_both_versions_is_read(tmp_path):
    scene, _ = read(tmp_path, OLDER)
    box, sphere, can = scene.objects
    assert scene.name == "cell" and scene.names == ("the box/0", "the box/1", "can")
    assert (box.shape, sphere.shape) == (Box((0.2, 0.4, 0.6)), Sphere(0.1))
    assert can.shape == Cylinder(0.03, 0.14)
    assert box.T_world_object @ (0, 1, 0, 1) == pytest.approx((0.0, 0.0, 0.5, 1.0), abs=1e-6)
    (tetrahedron,) = read(tmp_path, NEWER)[0].objects
    assert isinstance(tetrahedron.shape, ConvexMesh)
    assert tetrahedron.T_world_object[:3, 3] == pytest.approx((1.0, 1.0, 0.0), abs=1e-6)
    assert np.ptp(tetrahedron.shape.vertices, axis=0) == pytest.approx(0.1, abs=1e-9)


def test_yaml_gives_the_same_scene_with_heights_before_radii(tmp_path):
    data = {"name": "cell", "world": {"collision_objects": [TETRAHEDRON, CAN]}}
    scene, frame = read(tmp_path, data, ".yaml")
    expected = [*read(tmp_path, NEWER)[0].objects, read(tmp_path, OLDER)[0]["can"]]
    assert scene.names == ("tetrahedron", "can") and frame == ""
    for found, wanted in zip(scene.objects, expected, strict=True):
        assert found.shape == wanted.shape
        assert found.T_world_object == pytest.approx(wanted.T_world_object, abs=1e-7)


def test_messages_are_read_as_ros_2_prints_them(tmp_path):
    """Ended by ---; the operation to add an object is a byte."""
    plain = read(tmp_path, [CAN], ".yaml")[0]
    for operation in ('"\\0"', '!!binary "AA=="', "0"):
        text = json.dumps([CAN])[:-2] + f', "operation": {operation}}}]'
        (tmp_path / "a.yaml").write_text(text + "\n---\n")
        assert read_moveit_scene(tmp_path / "a.yaml")[0] == plain
    (tmp_path / "a.yaml").write_text(json.dumps([CAN | {"operation": "\1"}]))
    refused("operation '.x01'; only", read_moveit_scene, tmp_path / "a.yaml")


def test_settings_of_links_are_refused_by_name(tmp_path, caplog):
    """They were dropped without a word; a path then was nearer than the padding."""
    world = {"collision_objects": [CAN]}
    links = {"entry_names": ["hand", "finger"], "entry_values": [{"enabled": [False, True]}] * 2}
    on_can = {"entry_names": ["can", "hand"], "entry_values": [{"enabled": [False, True]}] * 2}
    for data, message in (
        (
            {"link_padding": [{"link_name": "hand", "padding": 0.02}]},
            "link_padding of 'hand' is 0.02",
        ),
        ({"link_scale": [{"link_name": "hand", "scale": 1.1}]}, "link_scale of 'hand' is 1.1"),
        ({"allowed_collision_matrix": on_can}, "allows contact of 'can' and 'hand'"),
        (
            {
                "allowed_collision_matrix": {
                    "default_entry_names": ["can"],
                    "default_entry_values": [True],
                }
            },
            "allows contact of 'can' and 'everything'",
        ),
    ):
        refused(f"{message}, which is not read", read, tmp_path, {"world": world, **data}, ".yaml")
    neutral = {
        "link_padding": [{"link_name": "hand", "padding": 0.0}],
        "link_scale": [{"link_name": "hand", "scale": 1.0}],
        "allowed_collision_matrix": links,
    }
    assert not caplog.text
    assert read(tmp_path, {"world": world, **neutral}, ".yaml")[0].names == ("can",)
    assert caplog.text.count("2 entries for links are not taken over; the robot's SRDF") == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"primitives": [{"type": "cone", "dimensions": [1, 1]}]}, "unknown shape 'cone'; valid"),
        ({"primitives": [{"type": 5, "dimensions": [1, 1]}]}, "unknown shape 'prism'"),
        ({"planes": [{"coef": [0, 0, 1, 0]}]}, "unknown shape 'plane'"),
        ({"primitives": [{"type": "box", "dimensions": [1, 1]}]}, "box has 2 dimensions; 3 are"),
        ({"primitive_poses": []}, "1 primitives and 0 primitive_poses"),
        ({"primitives": [], "primitive_poses": []}, "it has no shape; give 'primitives'"),
        ({"operation": 1}, "operation 1; only objects that are added"),
        ({"scale": [2, 2, 2]}, "unknown key of an object 'scale'; valid choices: id, pose, prim"),
        ({"mesh": [{}]}, "unknown key of an object 'mesh'; .* did you mean 'meshes'"),
        (
            {"primitives": [{"type": "cylinder", "dimensions": [1, 1], "scale": 2}]},
            "unknown key of primitive 'scale'; valid choices: type, dim",
        ),
        (
            {"meshes": [{"resource": "a.stl", "scale": 2}], "mesh_poses": CAN["primitive_poses"]},
            "unknown key of mesh 'scale'; valid choices: resource, dim",
        ),
        (
            {
                "meshes": [TETRAHEDRON["meshes"][0] | {"dimensions": [9, 9, 9]}],
                "mesh_poses": CAN["primitive_poses"],
            },
            "unknown key of mesh 'dimensions'; valid choices: vertices, tri",
        ),
    ],
)
def test_unsupported_shapes_and_operations_are_named(tmp_path, change, message):
    refused(f"object 'can': {message}", read, tmp_path, [CAN | change], ".yaml")


@pytest.mark.parametrize(
    ("turn", "message"),
    [
        ({"rpy": [0, 0, 1.57]}, "unknown key of pose 'rpy'; valid choices: position, orientation"),
        ({"orientation": {"roll": 1.57}}, "unknown key of a vector or quaternion 'roll'; valid"),
        ({"orientation": []}, r"quaternion is \[\]; it must be a list of 4"),
        ({"orientation": [0, 0, 0]}, r"quaternion is .*; it must be a list of 4"),
    ],
)
def test_a_rotation_that_is_not_read_is_refused(tmp_path, turn, message):
    """Objects were read as if they were not rotated."""
    there = {"position": [0, 0, 1], **turn}
    refused(message, read, tmp_path, [CAN | {"primitive_poses": [there]}], ".yaml")
    refused(message, read, tmp_path, [CAN | {"pose": there}], ".yaml")


def test_the_state_of_a_robot_that_is_a_diff_is_told(tmp_path, caplog):
    whole = {"world": {"collision_objects": [CAN]}, "is_diff": False}
    for state, told in (({"is_diff": True}, "the robot is taken to carry nothing"), ({}, "")):
        caplog.clear()
        assert read(tmp_path, whole | {"robot_state": state}, ".yaml")[0].objects
        assert told in caplog.text and bool(caplog.text) == bool(told)


def test_a_scene_with_content_that_cannot_be_converted_is_refused(tmp_path):
    world = {"collision_objects": [CAN]}
    attached = {"attached_collision_objects": [{"link_name": "hand", "object": CAN}]}
    two = [CAN | {"header": {"frame_id": frame}} for frame in ("base", "table")]
    for data, message in (
        ({"world": world, "robot_state": attached}, "carries can; .*'attachments'"),
        ({"world": world | {"octomap": {"octomap": {"data": [1]}}}}, "octomap"),
        ({"world": world, "is_diff": True}, "only what changed, .*/get_planning_scene"),
        ({"collision_objects": [CAN], "is_diff": True}, "is_diff: false if this is all of it"),
        ({"world": {"collision_objects": two}}, "frames base, table"),
    ):
        refused(message, read, tmp_path, data, ".yaml")
    cone = OLDER.replace("sphere", "cone")
    refused("object 'the box': unknown shape 'cone'", read, tmp_path, cone)
    refused(r"'\* late' follows '\.'", read, tmp_path, OLDER + "* late\n")
    refused(r"'\.xml'; valid choices: \.scene, \.yaml", read_moveit_scene, tmp_path / "a.xml")


@pytest.mark.parametrize("text", [OLDER, NEWER], ids=["older", "newer"])
def test_damaged_text_is_refused_in_one_line(tmp_path, text):
    lines = text.splitlines()
    for k, line in enumerate(lines):
        damaged = [lines[:k], lines[:k] + lines[k + 1 :]]
        for wrong in ("nan 1", "-1", "999999999", f"{line} 7"):
            damaged.append([*lines[:k], wrong, *lines[k + 1 :]])
        for each in damaged:
            try:
                read(tmp_path, "\n".join(each))
            except InvalidInputError as error:
                assert str(error).startswith("MoveIt scene ") and str(error).isprintable()


def test_import_writes_a_scene_that_problems_name(tmp_path, cvqmpt, capsys):
    (tmp_path / "shelf.scene").write_text(OLDER)
    words = f"problems import {tmp_path}/shelf.scene --out {tmp_path}/shelf.json"
    assert "3 objects; the file's frame is used as the world, at whose" in cvqmpt(words)
    assert read_scene(tmp_path / "shelf.json") == read_moveit_scene(tmp_path / "shelf.scene")[0]
    assert "exists already" in refused_command(capsys, *words.split())


def in_frame(frame, *transforms):
    """A scene with one object in a frame, and transforms (header, child, translation)."""
    moved = [
        {
            "header": {"frame_id": header},
            "child_frame_id": child,
            "transform": {
                "translation": dict(zip("xyz", xyz, strict=True)),
                "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            },
        }
        for header, child, xyz in transforms
    ]
    objects = [CAN | {"header": {"frame_id": frame}}]
    return {"world": {"collision_objects": objects}, "fixed_frame_transforms": moved}


@pytest.mark.parametrize("of_robot", [True, False])
@pytest.mark.parametrize(
    ("scene", "place", "note"),
    [
        (in_frame("panda_link0", ("camera", "panda_link0", (1, 0, 1))), (0, 0, 1), "left out"),
        (in_frame("panda_link0", ("panda_link0", "map", (1, 0, 1))), (0, 0, 1), "left out"),
        (in_frame("/panda_link0", ("world", "panda_link0", (0, 0, 1))), (0, 0, 1), "left out"),
        (in_frame("eye", ("panda_link0", "eye", (1, 0, 1))), (1, 0, 2), "'eye' is at 1 0 1 m"),
        (in_frame("eye", ("eye", "panda_link0", (1, 0, 1))), (1, 0, 2), "'eye' is at 1 0 1 m"),
        (in_frame("world", ("world", "panda_link0", (0, 0, 1))), (0, 0, 2), "is at 0 0 1 m"),
        (in_frame("panda_link0", ("panda_link0", "panda_link0", (0, 0, 0))), (0, 0, 1), ""),
        (in_frame("world", ("", "world", (0, 0, 0))), (0, 0, 1), ""),
        (in_frame("world", ("", "world", (0, 0, 7))), (0, 0, 1), "left out: '' to 'world'"),
        (in_frame("world", ("camera", "map", (0, 0, 7))), (0, 0, 1), "left out: 'camera' to 'map'"),
    ],
)
def test_transforms_that_an_object_needs_are_applied(
    tmp_path, caplog, scene, place, note, of_robot
):
    """Others were refused, though no object was in their frames."""
    (tmp_path / "a.yaml").write_text(json.dumps(scene))
    found, _ = read_moveit_scene(tmp_path / "a.yaml", panda() if of_robot else None)
    assert found.objects[0].T_world_object[:3, 3].tolist() == list(place)
    assert note in caplog.text
    assert len(caplog.records) == bool(note)


@pytest.mark.parametrize(
    ("scene", "of_robot", "told"),
    [
        (in_frame("camera"), True, "unknown frame of robot panda 'camera'"),
        (in_frame("camera"), False, "frame_id 'camera' is not known to stand .* give --robot"),
        (in_frame("panda_hand"), True, "'panda_hand' is moved by the planned joints"),
        (in_frame("panda_hand"), False, "'panda_hand' is not known to stand"),
        (in_frame("eye", ("panda_link0", "eye", "000")), True, "transform of 'panda_link0' and"),
        (
            in_frame("eye", ("panda_link0", "eye", (1, 0, 1)), ("eye", "panda_link0", (1, 0, 2))),
            True,
            "several poses of frame 'eye'; keep one",
        ),
    ],
)
def test_objects_in_unknown_frames_are_refused_with_and_without_a_robot(
    tmp_path, scene, of_robot, told
):
    (tmp_path / "a.yaml").write_text(json.dumps(scene))
    refused(told, read_moveit_scene, tmp_path / "a.yaml", panda() if of_robot else None)


def test_objects_in_several_frames_of_the_robot_are_placed(tmp_path):
    scene = in_frame("world", ("world", "panda_link0", (0, 0, 1)))
    other = CAN | {"id": "other", "header": {"frame_id": "panda_link0"}}
    scene["world"]["collision_objects"].append(other)
    (tmp_path / "a.yaml").write_text(json.dumps(scene))
    found, _ = read_moveit_scene(tmp_path / "a.yaml", panda())
    assert [item.T_world_object[2, 3] for item in found.objects] == [2.0, 1.0]
