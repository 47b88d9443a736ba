"""A door or drawer as a robot joint: poses, collisions in both checkers, casing, files, errors."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.door_task import BAR, GRIP, bar_pose, door_problem, door_world
from cvqmpt_lab.benchmarks.place_task import DOOR
from cvqmpt_lab.codec import from_plain, to_plain
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.mechanism import ArticulatedObject, with_articulated_object
from cvqmpt_lab.scene.articulation import DEEPEST, take_out
from cvqmpt_lab.scene.coal_shapes import coal_shape, shape_distance
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, PointCloud
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.space import ConstrainedSpace

AWAY = np.array([2.8, 0.3, 0.0, -1.5, 0.0, 1.571, 0.785])  # the arm looks away from the kitchen
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


@pytest.mark.parametrize("name", [DOOR, "dagger_door_right", DRAWER])
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


@pytest.mark.parametrize("name", [DOOR, "dagger_door_right", DRAWER, "indigo_door_right"])
def test_doors_and_drawers_move_freely_with_the_planners_margin(panda, name):
    """At rest there is no collision, and excused pairs never overlap."""
    whole = kitchen()
    joint = whole.articulation(name)
    scene, robot = mechanism(panda, whole, name)
    spaces = [space_of(robot, scene, backend) for backend in ("compiled", "exact")]
    casing = [whole[n] for n in whole.names if n not in scene.names and n not in joint.moves]
    for value in np.linspace(joint.lower, joint.upper, 40):
        assert all(space.valid(np.append(AWAY, value)) for space in spaces), value
        there = whole.with_joint(name, float(value))
        for item in casing:
            depth = min(
                shape_distance(
                    coal_shape(there[part].shape),
                    there[part].T_world_object,
                    coal_shape(item.shape),
                    item.T_world_object,
                )
                for part in joint.moves
            )
            assert depth > -DEEPEST, (item.name, value, depth)
    start, end = (np.append(AWAY, value) for value in (joint.lower, joint.upper))
    assert motion_free(spaces[0].arrays, start, end)


def space_of(robot, scene, backend="compiled"):
    q = np.append(AWAY, 0.0)
    return ConstrainedSpace(PlanningProblem("test", robot, scene, q, q[None]), backend)


def test_only_the_named_contact_is_allowed(panda, grasp):
    """Closed fingers collide with the bar unless pads and bar are named; others stay checked."""
    source = {"name": "panda", "finger_opening": GRIP}
    scene, item = take_out(kitchen(), DOOR)
    strict = with_articulated_object(robot_from_source(source), item)
    pair = CollisionChecker(strict, scene).colliding_pair(grasp)
    assert pair.first.startswith("panda_") and "finger_3" in pair.first and pair.second == BAR
    _, robot = door_world()
    allowed = set(map(tuple, robot.source["articulated"]["may_touch"]))
    gone = set(strict.self_collision_pairs) - set(robot.self_collision_pairs)
    assert {(strict.links[i].name, strict.links[k].name) for i, k in gone} == allowed
    assert len(gone) == 2
    scene, wide = door_world(0.04)
    assert CollisionChecker(wide, scene).clearance(grasp) > 5e-4, (
        "open fingers are clear of the bar"
    )


def test_a_load_is_checked_against_door_and_casing(world, grasp):
    from cvqmpt_lab.scene.scene import Attachment

    _, robot = world
    rod = Attachment("rod", Box((0.02, 0.02, 0.6)), pose((0.0, 0.0, 0.4)))
    checker = CollisionChecker(robot, Scene("nothing", ()), (rod,))
    assert checker.colliding_pair(grasp).first.startswith((DOOR, "dagger"))
    assert checker.in_collision(grasp)
    problem = PlanningProblem(
        "rod", robot, Scene("nothing", ()), grasp, grasp[None], attachments=(rod,)
    )
    assert not ConstrainedSpace(problem).valid(grasp)


def test_a_door_of_measured_points_is_refused():
    scene = kitchen()
    part = scene.articulation(DOOR).moves[0]
    measured = replace(scene[part], shape=PointCloud(np.zeros((3, 3)), 0.01))
    spoilt = replace(
        scene, objects=tuple(measured if item.name == part else item for item in scene.objects)
    )
    refused(f"'{part}', a part of '{DOOR}', is measured points", take_out, spoilt, DOOR)


def test_what_is_no_door_or_an_angle_outside_its_range_is_refused(grasp):
    refused(r"'fridge'.*dagger_door_left", take_out, kitchen(), "fridge", error=UnknownChoiceError)
    for angle in (-1.6, 0.1):
        refused(rf"value {angle} of hinge '{DOOR}'.*\[-1.57, 0.0\] rad", bar_pose, angle)
        with pytest.raises(InvalidInputError, match=f"start is outside the limits: {DOOR} by"):
            replace(door_problem(0), start=np.append(grasp[:7], angle))


def test_bad_objects_are_refused(panda, world):
    _, robot = world
    item = from_plain(ArticulatedObject, robot.source["articulated"])
    data = to_plain(item)
    refused("has an articulated object already", with_articulated_object, robot, item)
    with pytest.raises(UnknownChoiceError, match=r"'palm'.*panda_hand_0"):
        with_articulated_object(panda, replace(item, may_touch=(("palm", BAR),)))
    with pytest.raises(UnknownChoiceError, match=f"'knob'.*{BAR}"):
        with_articulated_object(panda, replace(item, may_touch=(("panda_hand_0", "knob"),)))
    with pytest.raises(InvalidInputError, match="'panda_hand' already"):
        with_articulated_object(panda, replace(item, name="panda_hand"))
    flat = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    for changes, message in [
        ({"kind": "ball"}, "'ball'.*hinge, slider"),
        ({"lower": 0.0}, r"range \[0.0, 0.0\]"),
        ({"upper": None}, "articulated.upper is None"),
        ({"parts": []}, "moves nothing"),
        ({"velocity": 0.0}, "velocity is 0.0"),
        ({"T_world_joint": [[1.0]]}, "T_world_joint has shape"),
        ({"may_touch": ["x"]}, "may_touch.*must be a list"),
        ({"casing": data["parts"]}, "occurs twice"),
        ({"parts": [{"name": "p", "T": np.eye(4).tolist(), "vertices": [[0, 0, 0]]}]}, "m thick"),
        (
            {"parts": [{"name": "p", "T": np.eye(4).tolist(), "vertices": flat}], "may_touch": []},
            "0 m thick",
        ),
        ([1], "must be an object"),
        ({"name": "door", "kind": None}, "kind"),
    ]:
        with pytest.raises((InvalidInputError, UnknownChoiceError), match=message):
            wrong = data | changes if isinstance(changes, dict) else changes
            robot_from_source({**panda.source, "articulated": wrong})
