"""Shapes, scene objects, articulations and scenes: validation, motion and JSON."""

import json
import math

import numpy as np
import pytest

from cvqmpt_lab.codec.plain import from_plain, to_plain
from cvqmpt_lab.errors import CvqmptError, InvalidInputError, UnknownChoiceError
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.objects import CRACKER_BOX
from cvqmpt_lab.scene.scene import Articulation, Scene, SceneObject
from cvqmpt_lab.scene.shapes import (
    Box,
    ConvexMesh,
    Cylinder,
    PointCloud,
    Shape,
    Sphere,
    bounding_radius,
    shape_vertices,
)

TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])
SHAPES: list[Shape] = [
    Box((0.1, 0.2, 0.3)),
    Cylinder(0.3, 0.8),
    Sphere(0.25),
    ConvexMesh(TETRAHEDRON),
    PointCloud(np.array([[1.0, 0.0, 0.0], [0.0, -2.0, 0.0]]), 0.05),
]


def tilted_pose():
    """A pose whose rotation is about no world axis."""
    T = pose((0.1, -0.2, 1.0 / 3.0), 0.7)
    cosine, sine = math.cos(0.4), math.sin(0.4)
    T[:3, :3] = T[:3, :3] @ np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    return T


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
            Articulation(
                "door", "hinge", pose((1.0, 0.0, 0.0), 0.3), 0.0, 1.57, hinge_value, ("door/panel",)
            ),
            Articulation("drawer", "slider", T_slider, 0.0, 0.4, 0.1, ("drawer/tray",)),
        ),
    )


def not_rigid(T):
    return lambda: SceneObject("cup", Sphere(0.1), T)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Box((0.1, 0.0, 0.2)), r"Box\.size\[1\] is 0.0"),
        (lambda: Box((0.1, 0.2)), r"Box\.size"),  # type: ignore[arg-type]
        (lambda: Box((0.1, math.nan, 0.2)), "nan"),
        (lambda: Cylinder(-0.1, 0.2), r"Cylinder\.radius"),
        (lambda: Cylinder(0.1, math.inf), r"Cylinder\.height"),
        (lambda: Sphere("big"), "'big'"),  # type: ignore[arg-type]
        (lambda: ConvexMesh(np.where(TETRAHEDRON == 3.0, math.nan, TETRAHEDRON)), r"vertices\[3, 2\]"),
        (lambda: PointCloud(np.zeros((0, 3)), 0.1), r"PointCloud\.points is empty"),
        (lambda: PointCloud(np.zeros((4, 2)), 0.1), r"\(4, 2\)"),
        (lambda: PointCloud(np.zeros((4, 3)), 0.0), r"PointCloud\.radius"),
        *(
            (not_rigid(T), "SceneObject 'cup': T_world_object")
            for T in (np.eye(3), 2.0 * np.eye(4), "upright")
        ),
        (not_rigid(np.diag([1.0, 1.0, -1.0, 1.0])), "SceneObject 'cup': T_world_object"),
    ],
)
def test_unusable_shapes_are_refused_and_named(make, named):
    with pytest.raises(InvalidInputError, match=named):
        make()


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_shapes_survive_json(shape):
    copy = from_plain(Shape, json.loads(json.dumps(to_plain(shape, Shape))))
    assert copy == shape
    assert hash(copy) == hash(shape)
    assert all(copy != other for other in SHAPES if other is not shape)


def test_arrays_inside_shapes_and_poses_are_read_only_copies():
    points = TETRAHEDRON.copy()
    mesh = ConvexMesh(points)
    points[0] = 9.0
    assert mesh == ConvexMesh(TETRAHEDRON)
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0, 0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        small_scene()["wall"].T_world_object[0, 3] = 1.0


def test_vertices_and_bounding_radius():
    corners = shape_vertices(Box((2.0, 4.0, 6.0)))
    assert corners.shape == (8, 3)
    np.testing.assert_array_equal(corners.max(axis=0), (1.0, 2.0, 3.0))
    np.testing.assert_array_equal(corners.min(axis=0), (-1.0, -2.0, -3.0))
    assert len(np.unique(corners, axis=0)) == 8
    np.testing.assert_allclose(
        [bounding_radius(shape) for shape in SHAPES], [math.sqrt(0.14) / 2, 0.5, 0.25, 3.0, 2.05]
    )
    with pytest.raises(InvalidInputError, match="Sphere"):
        shape_vertices(Sphere(1.0))  # type: ignore[arg-type]


def test_hinges_and_sliders_move_their_parts_and_nothing_else():
    closed = small_scene()
    opened = closed.with_joint("door", 1.2)
    np.testing.assert_allclose(
        opened["door/panel"].T_world_object,
        pose((1.0 - 0.2 * math.sin(1.2), 0.2 * math.cos(1.2), 0.0), 1.2),
        atol=1e-12,
    )
    assert opened.articulation("door").value == 1.2
    assert all(opened[name] == closed[name] for name in ("wall", "drawer/tray", "floor"))
    pulled = closed.with_joint("drawer", 0.4)
    np.testing.assert_allclose(pulled["drawer/tray"].T_world_object, pose((0.9, 0.8, 0.0)), atol=1e-12)


def door_as(**change):
    return lambda: Articulation(**{**to_plain(small_scene().articulation("door")), **change})


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
    ],
)
def test_unusable_articulations_and_names_are_refused(make, named):
    with pytest.raises(CvqmptError, match=named):
        make()


def test_lookup_adding_and_removing():
    scene = small_scene()
    assert "wall" in scene and "window" not in scene
    assert [item.name for item in scene.obstacles] == ["wall", "door/panel", "drawer/tray"]
    with pytest.raises(UnknownChoiceError, match=r"'window'; valid choices: wall, door/panel"):
        scene["window"]
    with pytest.raises(UnknownChoiceError, match="'window'"):
        scene.without("window")
    with pytest.raises(UnknownChoiceError, match="'lid'; valid choices: door, drawer"):
        scene.with_joint("lid", 0.0)
    more = scene.with_objects(SceneObject("cup", Sphere(0.1), pose((0.0, 0.0, 0.0))))
    assert more.names == (*scene.names, "cup")
    assert more.without("cup") == scene
    less = scene.without("door/panel")
    assert [joint.name for joint in less.articulations] == ["drawer"]


def test_scenes_are_equal_and_hash_equal_by_content():
    cloud = SceneObject("cloud", SHAPES[4], tilted_pose())
    scene = small_scene().with_joint("door", 1.1).with_objects(cloud)
    again = from_plain(Scene, json.loads(json.dumps(to_plain(scene))))
    assert again == scene and hash(again) == hash(scene)
    nudged = tilted_pose()
    nudged[0, 3] += 1e-12
    assert scene.without("cloud").with_objects(SceneObject("cloud", SHAPES[4], nudged)) != scene


def test_minus_zero_is_the_same_content():
    zero = SceneObject("cup", Sphere(0.1), pose((0.0, 0.0, 0.0)))
    minus = SceneObject("cup", Sphere(0.1), pose((-0.0, 0.0, 0.0)))
    assert zero == minus and hash(zero) == hash(minus)


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (lambda data: data.pop("objects"), "scene.objects is missing"),
        (lambda data: data.update(objects={}), "scene.objects is {}; it must be a list"),
        (lambda data: data["objects"][1].pop("T_world_object"), "scene.objects[1].T_world_object is missing"),
        (lambda data: data["objects"][1].update(obstacle="yes"), "scene.objects[1].obstacle is 'yes'"),
        (lambda data: data["objects"][2]["shape"].pop("size"), "scene.objects[2].shape.size is missing"),
        (lambda data: data["objects"][2]["shape"].update(type="cone"), "scene.objects[2].shape.type 'cone'"),
        (lambda data: data["objects"][2]["shape"].pop("type"), "scene.objects[2].shape.type is missing"),
        (
            lambda data: data["objects"][2]["shape"].update(colour=1),
            "scene.objects[2].shape.colour is unknown",
        ),
        (lambda data: data["objects"][2].update(shape=[1]), "type"),
        (
            lambda data: data["articulations"][0].update(value=9.0),
            "scene.articulations[0]: value 9.0 of hinge",
        ),
        (lambda data: data["articulations"][0].update(moves=[3]), "scene.articulations[0].moves[0] is 3"),
        (lambda data: data["articulations"][0].update(moves=["lid"]), "articulation 'door' moves 'lid'"),
        (lambda data: data["articulations"].append(7), "scene.articulations[2] is 7"),
        (lambda data: data.update(name=None), "scene.name is None"),
        (
            lambda data: data.update(artculations=[]),
            "scene.artculations is unknown; did you mean 'articulations'",
        ),
    ],
)
def test_damaged_fields_are_named(damage, named):
    data = to_plain(small_scene())
    damage(data)
    with pytest.raises(CvqmptError) as caught:
        from_plain(Scene, data, "scene")
    assert named in str(caught.value)


def test_counter_objects_stand_where_their_centre_of_mass_says():
    box = CRACKER_BOX.at_com("crackers", (0.6, -0.6, 0.3), yaw=-math.pi / 4)
    offset = pose((0.0, 0.0, 0.0), -math.pi / 4)[:3, :3] @ (-0.002, -0.001, 0.015)
    np.testing.assert_allclose(box.T_world_object[:3, 3], np.array([0.6, -0.6, 0.3]) + offset, atol=1e-12)
