"""A door or drawer as a joint of the robot, and robots of the user: collisions, plans, errors."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.errors import CvqmptError, InvalidProblemError, UnknownChoiceError
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.kitchen import kitchen
from cvqmpt_lab.benchmarks.place_task import (
    HANDLE_BAR,
    HANDLE_GRIP_M,
    SHELF_DOOR,
    door_problem,
    door_world,
)
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.features.motion.timing import time_path
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.planning.usable import check_problem
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import load_robot, robot_from_source
from cvqmpt_lab.robot.mechanism import ArticulatedObject, with_articulated_object
from cvqmpt_lab.scene.articulation import take_out
from cvqmpt_lab.scene.coal_shapes import coal_shape, shape_distance
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, PointCloud
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace

AWAY = np.array([2.8, 0.3, 0.0, -1.5, 0.0, 1.571, 0.785])  # the arm points away from the kitchen
DRAWER = "hitman_drawer_top"


def mechanism(panda, scene, name, **options):
    rest, item = take_out(scene, name, **options)
    return rest, robot_from_source({**panda.source, "articulated": to_plain(item)})


@pytest.fixture(scope="module")
def world():
    return door_world()


@pytest.fixture(scope="module")
def grasp():
    """A start of the door task: the hand holds the closed door's handle."""
    return door_problem(0).start


def pieces(robot, q):
    """World vertices of each piece by the kernels' poses."""
    (R,), (t,) = link_poses(robot.kinematics, np.array([q]))
    frames = ((p, p.T_link_geometry) for p in robot.links)
    in_link = ((p.name, p.link, p.vertices @ T[:3, :3].T + T[:3, 3]) for p, T in frames)
    return {name: vertices @ R[link].T + t[link] for name, link, vertices in in_link}


@pytest.mark.parametrize("name", [SHELF_DOOR, "dagger_door_right", DRAWER])
@pytest.mark.parametrize("taken_at", [0.0, 0.4])
def test_parts_move_as_in_the_scene(panda, name, taken_at):
    """The scene's own articulation is the reference, also for one taken out half open."""
    closed = kitchen()
    joint = closed.articulation(name)
    at = joint.lower + taken_at * (joint.upper - joint.lower)
    rest, robot = mechanism(panda, closed.with_joint(name, at), name)
    assert robot.dof == 8 and robot.joint_names[7] == name
    assert (robot.lower[7], robot.upper[7]) == (joint.lower, joint.upper)
    assert not [part for part in joint.moves if part in rest.names]
    for value in np.linspace(joint.lower, joint.upper, 7):
        there, q = closed.with_joint(name, float(value)), np.append(AWAY, value)
        placed = pieces(robot, q)
        for part in joint.moves:
            T = there[part].T_world_object
            np.testing.assert_allclose(robot.pose(q, part), T, atol=1e-9)
            np.testing.assert_allclose(placed[part].mean(axis=0), T[:3, 3], atol=1e-9)


@pytest.mark.parametrize("name", [SHELF_DOOR, "dagger_door_right", DRAWER, "indigo_door_right"])
def test_doors_and_drawers_move_freely_with_the_planners_margin(panda, name):
    """A door is free of collisions at all values, and door and casing overlap by < 0.1 mm."""
    whole = kitchen()
    joint = whole.articulation(name)
    scene, robot = mechanism(panda, whole, name)
    q = np.append(AWAY, 0.0)
    problem = PlanningProblem("test", robot, scene, q, q[None])
    spaces = [ConstrainedSpace.of(problem, backend) for backend in ("compiled", "exact")]
    casing = [whole[n] for n in whole.names if n not in scene.names and n not in joint.moves]
    for value in np.linspace(joint.lower, joint.upper, 40):
        assert all(space.valid(np.append(AWAY, value)) for space in spaces), value
        there = whole.with_joint(name, float(value))
        moved = [(coal_shape(there[n].shape), there[n].T_world_object) for n in joint.moves]
        for item in casing:
            at_rest = coal_shape(item.shape), item.T_world_object
            depth = min(shape_distance(*part, *at_rest) for part in moved)
            assert depth > -1e-4, (item.name, value, depth)
    start, end = (np.append(AWAY, value) for value in (joint.lower, joint.upper))
    assert motion_free(spaces[0].arrays, start, end)


def test_only_the_named_contact_is_allowed(panda, grasp):
    """Closed fingers collide with the bar unless `may_touch` has both; other pairs are checked."""
    source = {"name": "panda", "finger_opening": HANDLE_GRIP_M}
    scene, item = take_out(kitchen(), SHELF_DOOR)
    strict = with_articulated_object(robot_from_source(source), item)
    pair = CollisionChecker(strict, scene).colliding_pair(grasp)
    assert (
        pair.first.startswith("panda_") and "finger_3" in pair.first and pair.second == HANDLE_BAR
    )
    _, robot = door_world()
    allowed = set(map(tuple, robot.source["articulated"]["may_touch"]))
    gone = set(strict.self_collision_pairs) - set(robot.self_collision_pairs)
    assert {(strict.links[i].name, strict.links[k].name) for i, k in gone} == allowed
    assert len(gone) == 2
    scene, open_hand = door_world(0.04)
    assert CollisionChecker(open_hand, scene).clearance(grasp) > 5e-4


def test_a_load_is_checked_against_door_and_casing(world, grasp):
    rod = Attachment("rod", Box((0.02, 0.02, 0.6)), pose((0.0, 0.0, 0.4)))
    nothing, ends = Scene("nothing", ()), (grasp, grasp[None])
    problem = PlanningProblem("rod", world[1], nothing, *ends, attachments=(rod,))
    checker = problem.collision_checker()
    assert checker.colliding_pair(grasp).first.startswith((SHELF_DOOR, "dagger"))
    assert checker.in_collision(grasp) and not ConstrainedSpace.of(problem).valid(grasp)


def test_an_unknown_door_and_a_door_of_measured_points_are_refused():
    scene = kitchen()
    part = scene.articulation(SHELF_DOOR).moves[0]
    measured = replace(scene[part], shape=PointCloud(np.zeros((3, 3)), 0.01))
    objects = tuple(measured if item.name == part else item for item in scene.objects)
    message = f"'{part}', a part of '{SHELF_DOOR}', consists of measured points"
    refused(r"'fridge'.*dagger_door_left", take_out, scene, "fridge", error=UnknownChoiceError)
    refused(message, take_out, replace(scene, objects=objects), SHELF_DOOR)


def test_bad_objects_are_refused(panda, world):
    robot = world[1]
    item = from_plain(ArticulatedObject, robot.source["articulated"])
    refused("has an articulated object already", with_articulated_object, robot, item)
    for changes, message in (
        ({"may_touch": (("palm", HANDLE_BAR),)}, r"'palm'.*panda_hand_0"),
        ({"may_touch": (("panda_hand_0", "knob"),)}, f"'knob'.*{HANDLE_BAR}"),
        ({"name": "panda_hand"}, "'panda_hand' already"),
    ):
        bad = replace(item, **changes)
        refused(message, with_articulated_object, panda, bad, error=CvqmptError)


NOTHING = Scene("nothing", ())
ENOUGH = Budget(iterations=20_000)
TOOL_BOX = 'size="0.02 0.06 0.02"'


ONE_JOINT = """<robot name="one"><link name="base"/><link name="arm">\
<collision><origin xyz="0.3 0 0.3"/><geometry><box size="0.4 0.05 0.05"/></geometry></collision>
</link><joint name="only" type="{kind}"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


CAN = Attachment("can", Box((0.05, 0.05, 0.1)), pose((0.6, 0.0, 0.3)))
WALLS = {"revolute": (0.0, 0.5, 0.3), "prismatic": (0.4, 0.0, 1.0)}


@pytest.mark.parametrize("backend", ["compiled", "exact"])
@pytest.mark.parametrize("carried", [(), (CAN,)])
@pytest.mark.parametrize(("kind", "wall"), WALLS.items())
def test_robots_of_one_joint_are_planned_for(tmp_path, kind, wall, carried, backend):
    (tmp_path / "one.urdf").write_text(ONE_JOINT.format(kind=kind))
    robot = load_robot(tmp_path / "one.urdf", "arm", acceleration_limits=[1.0])
    scene = Scene("wall", (SceneObject("wall", Box((0.1, 0.1, 0.1)), pose(wall)),))
    start, goal = np.array([-0.5]), np.array([[0.4]])
    bounds = np.array([(-2.0, 2.0), (-0.5, 2.0), *[(-2.0, 2.0)] * 4])
    for region in ((), (TaskSpaceRegion(np.eye(4), np.eye(4), bounds),)):
        problem = PlanningProblem("one", robot, scene, start, goal, region, attachments=carried)
        solution = solve(problem, planner_named("birrt"), ENOUGH, seed=0, backend=backend)
        assert solution.certificate.reasons == ()
        assert 0.0 < solution.certificate.obstacle_clearance.at_least_m < 0.5
        assert time_path(solution.path.states, robot.joint_limits).duration > 0.0
    told = "1 joints and 6 bounded rows"
    refused(told, solve, problem, planner_named("atlas-rrt"), ENOUGH, seed=0)


def test_an_srdf_that_keeps_overlapping_pairs_is_named_by_the_pair(slider_arm_urdf, tmp_path):
    """The SRDF decides which pairs are skipped; a tool of 0.9 m always overlaps the upper arm."""
    urdf, srdf = tmp_path / "bulky.urdf", tmp_path / "bulky.srdf"
    urdf.write_text(slider_arm_urdf.read_text().replace(TOOL_BOX, 'size="0.9 0.9 0.9"'))
    srdf.write_text('<?xml version="1.0"?>\n<robot name="slider_arm"/>\n')
    robot = load_robot(urdf, "tool", srdf=srdf)
    assert robot.left_out_pairs == ()
    problem = PlanningProblem("bulky", robot, NOTHING, np.zeros(4), [[0.1, 0.05, -0.1, 0.2]])
    message = r"start is in collision: .*_0 and tool_0"
    refused(message, check_problem, problem, error=InvalidProblemError)
    assert not ConstrainedSpace.of(problem).valid(problem.start)
