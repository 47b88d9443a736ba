"""Shapes, scene objects, articulations and scenes: validation, motion and JSON."""

import math
from functools import partial

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.codec import from_plain, to_plain
from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import Articulation, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Sphere, shape_vertices

TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])
HINGE = pose((1.0, 0.0, 0.0), 0.3)


def small_scene(hinge_value=0.0):
    """A wall, a door hinged at (1, 0), a drawer that slides along -x, and a visible floor."""
    T_slider = np.array([[0.0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    return Scene(
        "small",
        (
            SceneObject("wall", Box((0.1, 2.0, 2.0)), pose((2.0, 0.0, 0.0))),
            SceneObject("door/panel", Box((0.02, 0.4, 0.7)), pose((1.0, 0.2, 0.0))),
            SceneObject("drawer/tray", Box((0.5, 0.4, 0.1)), pose((1.2, 0.8, 0.0))),
            SceneObject("floor", Box((9.0, 9.0, 0.1)), pose((0.0, 0.0, -1.0)), obstacle=False),
        ),
        (
            Articulation("door", "hinge", HINGE, 0.0, 1.57, hinge_value, ("door/panel",)),
            Articulation("drawer", "slider", T_slider, 0.0, 0.4, 0.1, ("drawer/tray",)),
        ),
    )


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Box((0.1, 0.0, 0.2)), r"Box\.size\[1\] is 0.0"),
        (lambda: Box((0.1, 0.2)), r"Box\.size"),  # type: ignore[arg-type]
        (lambda: Box((0.1, math.nan, 0.2)), "nan"),
        (lambda: Cylinder(-0.1, 0.2), r"Cylinder\.radius"),
        (lambda: Cylinder(0.1, math.inf), r"Cylinder\.height"),
        (lambda: Sphere("big"), "'big'"),  # type: ignore[arg-type]
        (lambda: ConvexMesh([*TETRAHEDRON[:3], (0, 0, math.nan)]), r"vertices\[3, 2\]"),
        (lambda: PointCloud(np.zeros((0, 3)), 0.1), r"PointCloud\.points is empty"),
        (lambda: PointCloud(np.zeros((4, 2)), 0.1), r"\(4, 2\)"),
        (lambda: PointCloud(np.zeros((4, 3)), 0.0), r"PointCloud\.radius"),
        (lambda: shape_vertices(Sphere(1.0)), "Sphere"),  # type: ignore[arg-type]
        *(
            (partial(SceneObject, "cup", Sphere(0.1), T), "'cup': T_world_object")
            for T in (np.eye(3), 2.0 * np.eye(4), "upright", np.diag([1.0, 1.0, -1.0, 1.0]))
        ),
    ],
)
def test_unusable_shapes_are_refused_and_named(make, named):
    refused(named, make)


def test_arrays_inside_shapes_and_poses_are_read_only_copies():
    points = TETRAHEDRON.copy()
    mesh = ConvexMesh(points)
    points[0] = 9.0
    assert mesh == ConvexMesh(TETRAHEDRON)
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0, 0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        small_scene()["wall"].T_world_object[0, 3] = 1.0


def test_hinges_and_sliders_move_their_parts_and_nothing_else():
    closed = small_scene()
    opened = closed.with_joint("door", 1.2)
    expected = pose((1.0 - 0.2 * math.sin(1.2), 0.2 * math.cos(1.2), 0.0), 1.2)
    np.testing.assert_allclose(opened["door/panel"].T_world_object, expected, atol=1e-12)
    assert opened.articulation("door").value == 1.2
    assert all(opened[name] == closed[name] for name in ("wall", "drawer/tray", "floor"))
    pulled = closed.with_joint("drawer", 0.4)
    np.testing.assert_allclose(
        pulled["drawer/tray"].T_world_object, pose((0.9, 0.8, 0.0)), atol=1e-12
    )


def door_as(**change):
    return lambda: Articulation(**{**to_plain(small_scene().articulation("door")), **change})


def read_with_door(**change):
    """The scene from json with a changed door."""
    data = to_plain(SCENE)
    data["articulations"][0] |= change
    return from_plain(Scene, data, "scene")


SCENE = small_scene()
DOOR = SCENE.articulation("door")
OTHER = Articulation("other", "hinge", pose((0.0, 0.0, 0.0)), 0.0, 1.0, 0.0, ("door/panel",))


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: small_scene().with_joint("door", 1.6), r"1\.6.*'door'.*\[0\.0, 1\.57\] rad"),
        (lambda: small_scene().with_joint("drawer", math.nan), r"\[0\.0, 0\.4\] m"),
        (lambda: small_scene(hinge_value=2.0), r"2\.0"),
        (door_as(kind="screw"), "screw.*hinge, slider"),
        (door_as(lower=2.0), "lower 2.0"),
        (door_as(upper=math.inf), "upper"),
        (door_as(moves="door/panel"), "moves"),
        (lambda: SCENE.with_objects(SCENE["wall"]), "'wall' occurs twice"),
        (lambda: Scene("twice", SCENE.objects, (DOOR, DOOR)), "'door' occurs twice"),
        (lambda: Scene("lost", (SCENE["wall"],), (DOOR,)), "moves 'door/panel'"),
        (lambda: Scene("both", SCENE.objects, (DOOR, OTHER)), "'door/panel' occurs twice"),
        (lambda: read_with_door(value=9.0), r"scene\.articulations\[0\]: value 9\.0 of hinge"),
        (lambda: read_with_door(moves=["lid"]), "articulation 'door' moves 'lid'"),
    ],
)
def test_unusable_articulations_and_names_are_refused(make, named):
    refused(named, make)


def test_lookup_adding_and_removing():
    scene = small_scene()
    with pytest.raises(UnknownChoiceError, match=r"'window'; valid choices: wall, door/panel"):
        scene["window"]
    refused("'window'", scene.without, "window")
    refused("'lid'; valid choices: door, drawer", scene.with_joint, "lid", 0.0)
    more = scene.with_objects(SceneObject("cup", Sphere(0.1), pose((0.0, 0.0, 0.0))))
    assert more.names == (*scene.names, "cup")
    assert more.without("cup") == scene
    less = scene.without("door/panel")
    assert [joint.name for joint in less.articulations] == ["drawer"]
