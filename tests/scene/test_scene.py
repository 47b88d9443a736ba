"""Shapes, scene objects, articulations and scenes: validation, motion and JSON."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.families import random_scene
from cvqmpt_lab.benchmarks.kitchen import kitchen
from cvqmpt_lab.scene.cells import map_of_points
from cvqmpt_lab.scene.scene import Articulation, Scene, SceneObject
from cvqmpt_lab.scene.shapes import (
    Box,
    ConvexMesh,
    OccupancyMap,
    PointCloud,
    Sphere,
)

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


def test_arrays_inside_shapes_are_read_only_copies():
    points = TETRAHEDRON.copy()
    mesh = ConvexMesh(points)
    points[0] = 9.0
    assert mesh == ConvexMesh(TETRAHEDRON) and not mesh.vertices.flags.writeable


def test_adding_and_removing():
    scene = small_scene()
    more = scene.with_objects(SceneObject("cup", Sphere(0.1), pose((0.0, 0.0, 0.0))))
    assert more.names == (*scene.names, "cup")
    assert more.without("cup") == scene
    less = scene.without("door/panel")
    assert [joint.name for joint in less.articulations] == ["drawer"]


def test_an_environment_is_the_published_one():
    """The last cube and ball of environment 0 depend on all random numbers drawn before."""
    scene = random_scene(0)
    assert len(scene.objects) == len(scene.obstacles) == 16
    cube, ball = scene["cube_7"], scene["sphere_7"]
    there = pose((0.177543, -0.914188, -0.110277), 4.864654)
    np.testing.assert_allclose(cube.T_world_object, there, atol=1e-6)
    np.testing.assert_allclose(ball.T_world_object[:3, 3], (0.443136, 0.711137, -0.107952), 1e-5)
    assert (cube.shape, ball.shape) == (Box((0.2, 0.2, 0.2)), Sphere(0.15))


SCENE = small_scene()
WALL, DOOR = SCENE["wall"], SCENE.articulation("door")
OTHER = Articulation("other", "hinge", pose((0.0, 0.0, 0.0)), 0.0, 1.0, 0.0, ("door/panel",))
FLAT = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.03, 0.03, 1e-9]])
ENDS = np.array([[0.0, 0.0, 0.0], [1e3, 1e3, 1e3]])
WHOLE = "give a whole number from 0 to 4294967295"


def read_with_door(**change):
    """Read the scene from JSON with a changed door."""
    data = to_plain(SCENE)
    data["articulations"][0] |= change
    return from_plain(Scene, data, "scene")


WRONG = [
    (partial(ConvexMesh, TETRAHEDRON[:3]), "of 3 points is 0 m thick"),
    # such hulls once crashed collision code
    (partial(ConvexMesh, FLAT), "not in one plane"),
    (partial(ConvexMesh, 1e5 * TETRAHEDRON), "beyond 10000: give metres"),
    (partial(PointCloud, np.zeros((0, 3)), 0.1), r"PointCloud\.points is empty"),
    (partial(OccupancyMap, [[0.5, 0, 0]]), "holds 0.5; give whole numbers"),
    (partial(OccupancyMap, [[10_000_000, 0, 0]]), "whole numbers from -1000000"),
    (partial(OccupancyMap, []), r"must be \(any, 3\)"),
    (partial(OccupancyMap, np.empty((0, 3))), "is empty"),
    (partial(OccupancyMap, [[0, 0, 0]], resolution=1e-5), "give 0.001 m or more"),
    (partial(OccupancyMap, [[0, 0, 0]], padding=-0.01), "0 or more"),
    # refused before cells are made
    (partial(map_of_points, ENDS, 1e-9), r"resolution is 1e-09 m; give 0\.001 m or more"),
    # other wrong poses are in data/wrong_problems.csv
    (partial(SceneObject, "cup", Sphere(0.1), 2.0 * np.eye(4)), "'cup': T_world_object"),
    (partial(SCENE.with_joint, "door", 1.6), r"1\.6.*'door'.*\[0\.0, 1\.57\] rad"),
    (partial(SCENE.with_joint, "drawer", math.nan), r"\[0\.0, 0\.4\] m"),
    (partial(SCENE.with_joint, "lid", 0.0), "'lid'; valid choices: door, drawer"),
    (partial(SCENE.__getitem__, "window"), "'window'; valid choices: wall, door/panel"),
    (partial(SCENE.without, "window"), "'window'; valid choices"),
    (partial(replace, SCENE, articulations=(DOOR, DOOR)), "'door' occurs twice"),
    (partial(replace, SCENE, articulations=(DOOR, OTHER)), "'door/panel' occurs twice"),
    (partial(read_with_door, value=9.0), r"scene\.articulations\[0\]: value 9\.0 of hinge"),
    (partial(read_with_door, moves=["lid"]), "articulation 'door' moves 'lid'"),
    (partial(random_scene, -1), WHOLE),
    (partial(random_scene, 0, n_cubes=-1), WHOLE),
    (partial(kitchen, door_angles={"fridge": 0.1}), r"'fridge'; valid choices: .*dagger_door_left"),
    (partial(kitchen, door_angles={"dagger_door_left": 0.1}), r"\[-1\.57, 0\.0\] rad"),
    *(
        (partial(kitchen, changes={name: value}), message)
        for name, value, message in (
            ("cabinet_width", -0.3, r"dimension cabinet_width is -0\.3; it must be"),
            ("range_y", math.nan, r"dimension range_y is nan; it must be a"),
            ("range_z", 1.0, r"'range_z'; valid choices: back_wall_x, .*mean 'range_"),
            ("drawer_length", 0.6, "drawer_length reaches through the back"),
            ("wall_cabinet_height", 0.2, "wall_cabinet_height is below the handle"),
        )
    ),
]


@pytest.mark.parametrize(("make", "message"), WRONG)
def test_wrong_values_are_refused_and_named(make, message):
    refused(message, make)
