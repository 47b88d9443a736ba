"""Scenes: added and removed objects, random environments; refusals apart from problem files."""

import math
from functools import partial

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.cells import map_of_points
from cvqmpt_lab.scene.families import random_scene
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Sphere, shape_vertices

SCENE = kitchen()
CUP = SceneObject("cup", Sphere(0.1), pose((0.0, 0.0, 0.0)))
ENDS = np.array([[0.0, 0.0, 0.0], [1e3, 1e3, 1e3]])
WHOLE = "give a whole number from 0 to 4294967295"


def test_arrays_inside_shapes_are_read_only_copies():
    points = np.eye(4, 3)
    mesh = ConvexMesh(points)
    points[0] = 9.0
    assert mesh == ConvexMesh(np.eye(4, 3)) and not mesh.vertices.flags.writeable


def test_adding_and_removing():
    more = SCENE.with_objects(CUP)
    assert more.names == (*SCENE.names, "cup")
    assert more.without("cup") == SCENE
    doors = {joint.name: joint.moves for joint in SCENE.articulations}
    less = SCENE.without(*doors["dagger_door_left"])
    assert {joint.name for joint in less.articulations} == doors.keys() - {"dagger_door_left"}


def test_an_environment_is_the_published_one():
    """The last cube and ball of number 0: their places depend on all draws before."""
    scene = random_scene(0)
    assert len(scene.objects) == len(scene.obstacles) == 16
    cube, ball = scene["cube_7"], scene["sphere_7"]
    there = pose((0.177543, -0.914188, -0.110277), 4.864654)
    np.testing.assert_allclose(cube.T_world_object, there, atol=1e-6)
    np.testing.assert_allclose(ball.T_world_object[:3, 3], (0.443136, 0.711137, -0.107952), 1e-5)
    assert (cube.shape, ball.shape) == (Box((0.2, 0.2, 0.2)), Sphere(0.15))


WRONG = [
    (partial(shape_vertices, Sphere(1.0)), "Sphere"),
    # before any cells are made
    (partial(map_of_points, ENDS, 1e-9), r"resolution is 1e-09 m; give 0\.001 m or more"),
    (partial(SceneObject, "cup", Sphere(0.1), np.eye(3)), "'cup': T_world_object"),
    (partial(SCENE.with_joint, "hitman_drawer_top", math.nan), r"\[0\.0, 0\.\d+\] m"),
    (partial(SCENE.with_joint, "lid", 0.0), "'lid'; valid choices: .*dagger_door_left"),
    (partial(SCENE.__getitem__, "window"), "'window'; valid choices: "),
    (partial(SCENE.without, "window"), "'window'; valid choices"),
    (partial(SCENE.with_objects, CUP, CUP), "'cup' occurs twice"),
    (partial(random_scene, -1), WHOLE),
    (partial(random_scene, 0.5), WHOLE),
    (partial(random_scene, True), WHOLE),
    (partial(random_scene, 0, n_cubes=-1), WHOLE),
    (partial(kitchen, door_angles={"fridge": 0.1}), r"'fridge'; valid choices: .*dagger_door_left"),
    (partial(kitchen, door_angles={"dagger_door_left": 0.1}), r"\[-1\.57, 0\.0\] rad"),
    *(
        (partial(kitchen, changes={name: value}), told)
        for name, value, told in (
            ("cabinet_width", -0.3, r"dimension cabinet_width is -0\.3; it must be"),
            ("range_y", math.nan, r"dimension range_y is nan; it must be a"),
            ("range_z", 1.0, r"'range_z'; valid choices: back_wall_x, .*mean 'range_"),
            ("drawer_length", 0.6, "drawer_length reaches through the back"),
            ("wall_cabinet_height", 0.2, "wall_cabinet_height is below the handle"),
        )
    ),
]


@pytest.mark.parametrize(("make", "named"), WRONG)
def test_wrong_values_are_refused_and_named(make, named):
    refused(named, make)
