"""Links without a collision body, placeholders, flat bodies, soft limits, and wrong zeros."""

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.certificate.certificate import FaultKind, Verdict, certify
from cvqmpt_lab.collision.carried import carried_pairs
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.features.motion.motion_check import DryRun
from cvqmpt_lab.features.motion.record import record, report_of
from cvqmpt_lab.features.motion.trajectory import Motion
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import load_robot, robot_from_source
from cvqmpt_lab.robot.source import ARMS
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject, pose
from cvqmpt_lab.scene.shapes import Box, Sphere
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.space import ConstrainedSpace

ELBOW = '<link name="elbow"><collision>'
ELBOW_END = '<cylinder radius="0.03" length="0.2"/></geometry></collision>'
LIFT_END = '<limit lower="-2" upper="2" effort="1" velocity="1"/>'
SAFETY = '<safety_controller k_velocity="1" soft_lower_limit="{}" soft_upper_limit="{}"/>'
SPHERE = '<geometry><sphere radius="0.04"/></geometry>'
WALL = Scene("wall", (SceneObject("wall", Box((0.02, 3.0, 3.0)), pose((1.4, 0.0, 0.0))),))


def only_visual(text):
    return text.replace("<collision>", "<visual>").replace("</collision>", "</visual>")


def still(robot, scene=WALL):
    """A problem that ends where it begins, and its path."""
    q = np.full(robot.dof, 0.1)
    problem = PlanningProblem("still", robot, scene, q, q[None])
    return problem, JointPath(np.stack([q, q]))


def test_links_with_a_visual_and_no_collision_body_are_named_everywhere(edited):
    urdf = edited((ELBOW, only_visual(ELBOW)), (ELBOW_END, only_visual(ELBOW_END)))
    robot = load_robot(urdf, "tool")
    assert robot.bodiless == ("elbow",)
    (note,) = robot.notes
    assert note.startswith("cannot collide: elbow, with a <visual> and no <collision>")
    problem, path = still(robot)
    certificate = certify(problem, path)
    assert certificate.valid
    motion = Motion(robot.joint_names, path.states)
    contents = record(problem, motion, DryRun(certificate, path.states))
    assert contents["compared"]["links_without_body"] == ["elbow"]
    lines = report_of(DryRun(certificate, path.states), contents).lines
    assert f"note        {note}" in lines
    taken = load_robot(urdf, "tool", visual_as_collision=True)
    assert taken.notes == ["visual bodies are taken: elbow"] and taken.bodiless == ()
    plain = load_robot(edited(), "tool")
    for piece, same in zip(taken.links, plain.links, strict=True):
        np.testing.assert_array_equal(piece.vertices_in_link, same.vertices_in_link)
    assert robot_from_source(taken.source).bodiless == ()


def test_a_robot_without_any_moving_body_is_not_certified_among_obstacles(slider_arm_urdf, edited):
    text = slider_arm_urdf.read_text()
    first = text.index('<link name="carriage">')
    rest = text[first:]
    robot = load_robot(edited((rest, only_visual(rest))), "tool")
    problem, path = still(robot)
    certificate = certify(problem, path)
    assert certificate.verdict is Verdict.NOT_PROVEN
    (fault,) = certificate.faults
    assert fault.kind is FaultKind.NOT_PROVEN
    cure = "none of the moving links has a collision body: --visual-as-collision takes"
    assert f"nothing is compared with 1 obstacles: {cure}" in fault.text
    # a load that is compared says nothing about the links
    can = Attachment("can", Sphere(0.02), pose((0.0, 0.0, 0.1)))
    carrying = problem.changed(attachments=(can,))
    (fault,) = certify(carrying, path).faults
    assert fault.kind is FaultKind.NOT_PROVEN
    assert f"only what it carries is compared with 1 obstacles: {cure}" in fault.text
    # nothing to collide with: the motion itself is proven, and the robot says what it lacks
    assert certify(*still(robot, Scene("empty", ()))).valid
    assert robot.notes[0].startswith("nothing can collide")


@pytest.mark.parametrize(
    "placeholder",
    [
        '<geometry><box size="0 0 0"/></geometry>',
        '<geometry><sphere radius="0"/></geometry>',
        '<geometry><cylinder radius="0" length="0"/></geometry>',
        "<geometry/>",
        "",
    ],
)
def test_placeholders_of_size_0_are_no_bodies(edited, placeholder):
    robot = load_robot(edited((SPHERE, placeholder)), "tool")
    assert "wrist_0" not in [piece.name for piece in robot.links]
    assert len(robot.links) == 5 and robot.notes == ["without size, no body: wrist"]


def test_a_flat_body_gets_a_thickness(edited):
    robot = load_robot(edited(('size="0.1 0.12 0.08"', 'size="0.1 0.12 0"')), "tool")
    (plate,) = (piece for piece in robot.links if piece.name == "carriage_0")
    np.testing.assert_allclose(np.ptp(plate.vertices, axis=0), (0.1, 0.12, 1e-4))
    assert robot.notes == []


def test_an_srdf_switches_the_comparison_of_links_off_and_on(edited, tmp_path):
    """Only the enabled pair is left of the wrist, and the elbow's body is gone."""
    srdf = tmp_path / "arm.srdf"
    srdf.write_text(
        '<robot name="slider_arm"><disable_default_collisions link="wrist"/>'
        '<disable_default_collisions link="elbow"/>'
        '<enable_collisions link1="wrist" link2="base"/>'
        '<enable_collisions link1="wrist" link2="carriage"/>'
        '<disable_collisions link1="wrist" link2="carriage" reason="Never"/></robot>'
    )
    robot = load_robot(edited(), "tool", srdf=srdf)
    names = [piece.name.removesuffix("_0") for piece in robot.links]
    pairs = {frozenset((names[i], names[k])) for i, k in robot.self_collision_pairs}
    assert [pair for pair in pairs if "wrist" in pair] == [{"wrist", "base"}]
    assert "elbow" not in names and {"shoulder", "tool"} in pairs
    assert robot.notes == [
        "compared with nothing, by the SRDF: elbow",
        "compared only with the links that the SRDF enables, not with obstacles: wrist",
    ]
    states = robot.random_configurations(np.random.default_rng(0), 300)
    # the wrist alone is 0.1 m large, beside it the tool
    place = robot.pose(states[0], "wrist") @ pose((0.0, 0.05, 0.0))
    dot = SceneObject("dot", Box((0.01, 0.01, 0.01)), place)
    plain = load_robot(edited(name="plain.urdf"), "tool")
    for arm, touches in ((plain, True), (robot, False)):
        checker = CollisionChecker(arm, Scene("dot", (dot,)))
        assert checker.in_collision(states[0]) == touches
        assert (checker.colliding_pair(states[0]) is not None) == touches
        space = ConstrainedSpace(World(arm, Scene("dot", (dot,))), RegionConstraint(arm, ()))
        assert space.valid_batch(states[:1])[0] != touches
        assert ("wrist_0" in str(checker.nearest_obstacle(states[0]).pair)) == touches
    # the pair of wrist and base is compared, and other links meet the obstacle
    wall = Scene("wall", (SceneObject("wall", Box((0.02, 3.0, 3.0)), pose((0.5, 0.0, 0.0))),))
    exact = CollisionChecker(robot, wall)
    space = ConstrainedSpace(World(robot, wall), RegionConstraint(robot, ()))
    truth = exact.in_collision_batch(states)
    pairs = [str(exact.colliding_pair(q)) for q in states[truth]]
    assert "tool_0 and wall" in pairs and "wrist_0 and wall" not in pairs
    wrong = np.flatnonzero(space.valid_batch(states) == truth)
    assert all(0.0 < exact.clearance(states[k]) < 1e-3 for k in wrong)
    carried = Attachment("load", Box((0.1, 0.1, 0.1)), np.eye(4))
    touched = [names[i] for i, _ in carried_pairs(robot, (carried,))]
    assert "wrist" not in touched and "shoulder" in touched


def test_unknown_parts_of_links_and_joints_are_named(edited):
    other = (SPHERE, SPHERE + '</collision><color name="a"></color><collision>' + SPHERE)
    (note,) = load_robot(edited(other), "tool").notes
    assert note == "unknown and skipped: <color> of wrist"


def test_parts_of_simulators_are_no_error(edited):
    other = (SPHERE, "<drake:proximity_properties/><verbose/>" + SPHERE)
    assert load_robot(edited(other), "tool").notes == []


ORIGIN = '<origin xyz="0 0 0.15" '


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (ORIGIN, ORIGIN.replace("origin", "orign"), "arm.urdf: joint 'lift' has .*mean <origin>"),
        (ORIGIN, ORIGIN.replace("origin", "Origin"), "unknown part <Origin>; did you mean <orig"),
        (
            SPHERE,
            SPHERE + '</collision><colision name="a"></colision><collision>' + SPHERE,
            "link 'wrist' has an unknown part <colision>; did you mean <collision>",
        ),
        (SPHERE, SPHERE.replace("geometry", "Geometry"), "wrist.*unknown part 'Geometry'; valid"),
        (SPHERE, "<pose>0 0 1 0 0 0</pose>" + SPHERE, "collision: unknown part 'pose'; valid"),
        ('<sphere radius="0.04"', '<sphere radius="0.04" unit="cm"', "attribute of its sphere 'un"),
        (
            SPHERE,
            '<geometry><mesh filename="a" Scale="2"/></geometry>',
            "its mesh 'Scale'; .*sca",
        ),
        (
            LIFT_END,
            LIFT_END + '<mimic joint="turn" multiplyer="2"/>',
            "attribute of its <mimic> 'multiplyer'; valid choices: joint, multiplier, offset",
        ),
    ],
)
def test_what_would_change_the_shape_of_the_robot_is_not_skipped(edited, old, new, message):
    """The body, its pose, its size or the ratio of a linkage was left out."""
    refused(message, load_robot, edited((old, new)), "tool")


@pytest.mark.parametrize(
    ("name", "wrong"),
    [("upper", "uper"), ("lower", "Lower"), ("velocity", "velocty"), ("effort", "efort")],
)
def test_misspelled_limits_are_refused(edited, name, wrong):
    """An end counted as 0, so that the joint moved within half of its range."""
    urdf = edited((LIFT_END, LIFT_END.replace(name, wrong)))
    message = f"joint 'lift' of arm.urdf: .*attribute of its <limit> '{wrong}'; .*mean '{name}'"
    refused(message, load_robot, urdf, "tool")


def test_private_attributes_of_limits_are_accepted(edited):
    """ANYmal's file has gear_velocity and command_effort."""
    private = LIFT_END.replace("/>", ' gear_velocity="10" acceleration="2" command_effort="9"/>')
    robot = load_robot(edited((LIFT_END, private)), "tool")
    assert (robot.lower[1], robot.upper[1]) == (-2.0, 2.0)


def test_joints_are_planned_within_their_soft_limits(edited):
    soft = (LIFT_END, LIFT_END + SAFETY.format(-0.5, 5))
    robot = load_robot(edited(soft), "tool")
    np.testing.assert_allclose((robot.lower[1], robot.upper[1]), (-0.5, 2.0))
    assert robot.soft_limited == ("lift",)
    assert robot.notes == ["within the soft limits of lift; --hard-limits plans to the others"]
    there = np.array([0.0, -0.6, 0.0, 0.0])
    pattern = "goal 0 is outside the limits: lift by 0.1.*--hard-limits"
    empty = Scene("empty", ())
    refused(pattern, PlanningProblem, "soft", robot, empty, 0.0 * there, there[None])
    hard = load_robot(edited(soft), "tool", hard_limits=True)
    np.testing.assert_allclose((hard.lower[1], hard.upper[1]), (-2.0, 2.0))
    assert hard.notes == [] and robot_from_source(hard.source).soft_limited == ()
    # limits that are not stated, or empty, are placeholders
    unset = load_robot(edited((LIFT_END, LIFT_END + SAFETY.format(0, 0))), "tool")
    assert unset.soft_limited == ()


def test_soft_limits_of_robots_by_name():
    narrow = {"pr2", "tiago", "tiago-no-hand", "tiago-dual", "tiago-pro"}
    narrow |= {name for name in ARMS if name.rpartition("-")[0] in narrow}
    for name in ("panda", "talos", "pr2", "tiago-pro"):
        robot = robot_from_source({"name": name})
        assert bool(robot.soft_limited) == (name in narrow)
    hard = robot_from_source({"name": "pr2", "hard_limits": True})
    soft = robot_from_source({"name": "pr2"})
    assert (hard.upper >= soft.upper).all() and (hard.upper > soft.upper + 0.01).any()


def test_a_velocity_of_0_is_refused_with_the_place_to_give_one(edited):
    robot = load_robot(
        edited((LIFT_END, LIFT_END.replace('velocity="1"', 'velocity="0"'))),
        "tool",
        acceleration_limits=2.0,
    )
    pattern = r"slider_arm has velocity limits of 0 for lift: give each <limit> of the URDF"
    refused(pattern, lambda: robot.joint_limits)
    given = robot_from_source({**robot.source, "velocity_limits": [4.0, 3.0, 2.0, 1.0]})
    np.testing.assert_allclose(given.joint_limits.velocity, (4.0, 3.0, 2.0, 1.0))


def test_links_that_only_the_srdf_names_are_named(edited, tmp_path):
    srdf = tmp_path / "arm.srdf"
    srdf.write_text('<robot><disable_collisions link1="tool0" link2="wrist"/></robot>')
    notes = load_robot(edited(), "tool", srdf=srdf).notes
    assert notes == ["named by the SRDF, but no links of the URDF: tool0"]


def test_elements_of_an_srdf_without_effect_are_named(edited, tmp_path):
    """A misspelt element or attribute left no pair out, and nothing said so."""
    srdf = tmp_path / "arm.srdf"
    srdf.write_text(
        '<robot><disable_default_collision link="wrist"/><group name="arm"/>'
        '<disable_collisions link="elbow" link2="wrist"/></robot>'
    )
    notes = load_robot(edited(), "tool", srdf=srdf).notes
    assert notes == [
        "elements of the SRDF that are not known and have no effect: disable_default_collision",
        "elements of the SRDF without effect: <disable_collisions> without link1",
    ]
