"""Joints that mimic a planned joint: their bodies move with it in every part of the package."""

import logging
import re
from itertools import pairwise

import numpy as np
import pytest
from random_arms import random_urdf
from refusals import refused

from cvqmpt_lab.certificate.certificate import FaultKind, certify
from cvqmpt_lab.collision.arrays import robot_swing
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.constraints.bounds_between import bound_between
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, displacements
from cvqmpt_lab.features.physics.mjcf import mjcf_of
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.dynamics import Dynamics
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import load_robot
from cvqmpt_lab.robot.robot import Follower
from cvqmpt_lab.scene.scene import Scene, SceneObject, pose
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.space import ConstrainedSpace

MASS = '<inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
CHAIN = '<mimic joint="rod" multiplier="-0.8" offset="0.1"/>'
MIMICS = (
    '<mimic joint="lift" multiplier="0.5" offset="0.02"/>',
    '<mimic joint="bar"/>',
    CHAIN,
)
WALL = Scene("wall", (SceneObject("wall", Box((0.1, 3.0, 3.0)), pose((0.5, 0.0, 0.0))),))
FOLLOWERS = {"stage": (0.5, 0.02), "rod": (1.0, 0.0), "tip": (-0.8, 0.1)}


def link(name, size, at):
    body = f'<origin xyz="{at}"/><geometry><box size="{size}"/></geometry>'
    mass = f"{MASS.replace('<mass', f'<origin xyz={chr(34)}{at}{chr(34)}/><mass')}</inertial>"
    return f'<link name="{name}">{mass}<collision>{body}</collision></link>'


def joint(name, kind, ends, at, axis, limits, mimic="", speed=2.0):
    lower, upper = limits
    parent, child = ends
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{at}"/><axis xyz="{axis}"/>'
        f'<limit lower="{lower}" upper="{upper}" effort="50" velocity="{speed}"/>{mimic}</joint>'
    )


def machine(stage=MIMICS[0], rod=MIMICS[1], tip=MIMICS[2]):
    """A lift of two stages, an arm on it with a rod beside it, and a hand that mimics the rod.

    The first stage mimics the second one, which lies behind it in the chain.
    """
    return "\n".join(
        [
            '<robot name="machine">',
            link("base", "0.2 0.2 0.02", "0 0 0"),
            link("column", "0.06 0.06 0.2", "0 0 0.2"),
            link("second", "0.05 0.05 0.1", "0 0 0.1"),
            link("first", "0.04 0.04 0.04", "0 0 -0.1"),
            link("upper", "0.3 0.03 0.03", "0.2 0 0"),
            link("rod_link", "0.3 0.02 0.02", "0.2 0 0"),
            link("hand", "0.08 0.02 0.02", "0.05 0 0"),
            joint("turn", "revolute", ("base", "column"), "0 0 0", "0 0 1", (-3, 3)),
            joint(
                "stage", "prismatic", ("column", "second"), "0 0 0.35", "0 0 1", (0, 0.17), stage, 1
            ),
            joint("lift", "prismatic", ("second", "first"), "0 0 0.35", "0 0 1", (0, 0.4)),
            joint("bar", "revolute", ("first", "upper"), "0 0 0", "0 1 0", (-1.5, 1.5)),
            joint("rod", "revolute", ("first", "rod_link"), "0 0 0.12", "0 1 0", (-2, 2), rod),
            joint("tip", "revolute", ("upper", "hand"), "0.4 0 0", "0 1 0", (-2, 2), tip),
            "</robot>",
        ]
    )


@pytest.fixture
def load(tmp_path):
    """A machine by its text, with the hand as end effector."""

    def loaded(text, **options):
        (tmp_path / "machine.urdf").write_text(text)
        return load_robot(tmp_path / "machine.urdf", "hand", **options)

    return loaded


@pytest.fixture
def robot(load):
    return load(machine())


@pytest.fixture
def parts(load, tmp_path):
    """The machine with six joints of their own, and its configuration where followers follow."""
    # the rod is planned, too: as a second hand
    (tmp_path / "machine.urdf").write_text(machine("", "", ""))
    free = load_robot(tmp_path / "machine.urdf", ["hand", "rod_link"])
    return free, lambda robot, q: expanded(free, robot, q)


def expanded(free, robot, q):
    """Configurations (k, 6) of the machine with joints of its own, from (k, 3)."""
    values = dict(zip(robot.joint_names, np.transpose(q), strict=True))
    for name, (multiplier, offset) in FOLLOWERS.items():
        leader = "lift" if name == "stage" else "bar"
        values[name] = multiplier * values[leader] + offset
    return np.transpose([values[name] for name in free.joint_names])


def drawn(robot, count, seed=0):
    return robot.random_configurations(np.random.default_rng(seed), count)


def test_followers_are_found_through_chains_and_their_limits_count(robot):
    assert robot.joint_names == ("turn", "lift", "bar") and robot.held_joints == ()
    assert robot.followers == (
        Follower("stage", "lift", 0.5, 0.02),
        Follower("rod", "bar", 1.0, 0.0),
        Follower("tip", "bar", -0.8, 0.1),
    )
    # the stage goes to 0.17 m at 1 m/s where the lift goes to 0.3 m at 2 m/s
    np.testing.assert_allclose(robot.upper, [3.0, 0.3, 1.5])
    np.testing.assert_allclose(robot.lower, [-3.0, 0.0, -1.5])
    np.testing.assert_allclose(robot.velocity_limits, [2.0, 2.0, 2.0])


def test_every_frame_and_piece_stands_where_joints_of_their_own_would_put_it(robot, parts):
    free, of = parts
    q = drawn(robot, 20)
    for frame in robot.frame_names:
        np.testing.assert_allclose(
            robot.poses(q, frame), free.poses(of(robot, q), frame), atol=1e-12
        )
    wall = SceneObject("wall", Box((0.3, 0.02, 0.5)), pose((0.45, 0.3, 0.7)))
    scene, states = Scene("wall", (wall,)), drawn(robot, 200, seed=1)
    truth = CollisionChecker(free, scene).in_collision_batch(of(robot, states))
    assert 20 < truth.sum() < 180
    exact = CollisionChecker(robot, scene)
    np.testing.assert_array_equal(exact.in_collision_batch(states), truth)
    compiled = ConstrainedSpace(World(robot, scene), RegionConstraint(robot, ()))
    wrong = np.flatnonzero(compiled.valid_batch(states) == truth)
    # the compiled checks keep 0.1 mm away
    assert all(0.0 < exact.clearance(states[k]) < 1e-3 for k in wrong)


def test_the_jacobian_adds_what_followers_move(robot):
    region = TaskSpaceRegion(pose((0.3, 0.1, 0.9), 0.3), np.eye(4), np.zeros((6, 2)), tilt=1e-9)
    constraint, step = RegionConstraint(robot, (region,)), 1e-6
    q = drawn(robot, 30)
    _, jacobian = constraint.residual_and_jacobian(q, full=True)
    for j in range(robot.dof):
        change = step * np.eye(robot.dof)[j]
        after, _ = constraint.residual_and_jacobian(q + change, full=True)
        before, _ = constraint.residual_and_jacobian(q - change, full=True)
        np.testing.assert_allclose(jacobian[..., j], (after - before) / (2.0 * step), atol=1e-6)


def test_bounds_of_motions_hold_with_followers(robot):
    rng, space = np.random.default_rng(3), Scene("empty", ())
    checker = CollisionChecker(robot, space)
    region = TaskSpaceRegion(np.eye(4), np.eye(4), np.array([[-6.0, 6.0]] * 6))
    swing, levers, worst = robot_swing(robot), robot.levers(), 0.0
    for a in drawn(robot, 30):
        b = np.clip(a + rng.normal(scale=0.15, size=3), robot.lower, robot.upper)
        between = a + np.linspace(0.0, 1.0, 40)[:, None] * (b - a)
        far = 0.0
        for piece in robot.links:
            name = piece.name.removesuffix("_0")
            corners = np.c_[piece.vertices_in_link, np.ones(len(piece.vertices))]
            points = robot.poses(between, name) @ np.linalg.inv(robot.link_of(name)[1]) @ corners.T
            far = max(far, np.linalg.norm((points - points[:1])[:, :3], axis=1).max())
        bound = checker.moved(a, b[None])
        assert far <= bound <= 3.0 * far + 0.05
        assert far <= swing @ np.abs(b - a) and far <= levers @ np.abs(b - a)
        x = displacements(robot, region, between)
        most, _ = bound_between(robot, region, between[[0, -1]], x[[0, -1]])
        excess = (np.abs(x[:, :6]) - np.abs(x[[0, -1], :6]).max(axis=0)).max()
        assert excess <= most[0]
        worst = max(worst, excess / most[0])
    assert worst > 0.0


def test_the_certificate_sees_a_rod_that_goes_through_a_beam(robot):
    # the rod comes down from 0.84 to 0.74 m there, the arm stays below 0.74 m
    beam = SceneObject("beam", Box((0.02, 0.1, 0.02)), pose((0.33, 0.0, 0.79)))
    scene, goal = Scene("beam", (beam,)), np.array([[0.0, 0.0, 0.3]])
    problem = PlanningProblem("p", robot, scene, np.zeros(3), goal)
    path = JointPath(np.linspace(problem.start, problem.goals[0], 8))
    verdict = certify(problem, path)
    assert [fault.kind for fault in verdict.faults] == [FaultKind.COLLISION]
    assert "rod_link_0 and beam" in str(verdict.faults[0])


def test_efforts_are_those_of_the_motors_that_move_the_followers(robot, parts):
    free, of = parts
    q, v, a = (drawn(robot, 5, seed) for seed in (4, 5, 6))
    still = of(robot, np.zeros((1, 3)))
    rates = of(robot, v) - still, of(robot, a) - still
    efforts = Dynamics.of(free).efforts(of(robot, q), *rates)
    # work of all joints over the same small motion
    for j in range(3):
        share = (of(robot, np.eye(3)[j : j + 1]) - still)[0]
        expected = efforts @ share
        np.testing.assert_allclose(Dynamics.of(robot).efforts(q, v, a)[:, j], expected, atol=1e-9)


def test_a_held_leader_holds_its_followers_and_a_lock_says_what_it_breaks(load, caplog):
    held = {joint.name: joint for joint in load(machine(), locked={"bar": 0.5}).held_joints}
    assert held["rod"].value == 0.5 and held["rod"].reason == "mimics bar"
    assert held["tip"].value == pytest.approx(-0.3)
    assert not caplog.records
    with caplog.at_level(logging.WARNING, logger="cvqmpt"):
        robot = load(machine(), locked={"rod": 0.2})
    assert [joint.name for joint in robot.followers] == ["stage"]
    text = "joint 'rod' is locked at 0.2, where its link 'rod_link' stays; without this lock it "
    assert text + "would follow 1 * bar +0" in caplog.text
    # the hand mimics the rod, which stands still
    assert {joint.name: joint.value for joint in robot.held_joints}["tip"] == pytest.approx(-0.06)


def test_a_leader_beside_the_chain_is_planned(load):
    """The hand hangs on a joint that mimics a crank, which carries nothing."""
    text = machine(tip='<mimic joint="crank" multiplier="2"/>')
    crank = joint("crank", "revolute", ("base", "wheel"), "0 0 0", "0 1 0", (-0.5, 0.5))
    robot = load(text.replace("</robot>", f'<link name="wheel"/>{crank}</robot>'))
    assert "crank" in robot.joint_names
    q = np.zeros((2, robot.dof))
    q[1, robot.joint_names.index("crank")] = 0.4
    T = robot.poses(q)
    assert np.arccos((np.trace(T[0, :3, :3].T @ T[1, :3, :3]) - 1.0) / 2.0) == pytest.approx(0.8)


def test_wrong_mimics_are_refused_by_name(load):
    circle = machine(rod='<mimic joint="tip"/>')
    refused("mimic each other in a circle: rod -> tip -> rod", load, circle)
    refused(
        "'tip' of machine.urdf.*multiplier nan", load, machine(tip=CHAIN.replace("-0.8", "nan"))
    )
    never = machine(tip='<mimic joint="rod" offset="9"/>')
    refused(r"'tip' of machine.urdf has limits \[-2, 2\], in which 1 \* bar \+9 never", load, never)
    refused(
        "'tip' mimics nobody; hold them: --lock tip=0", load, machine(tip='<mimic joint="nobody"/>')
    )


def mimicked(text, rng):
    """A random arm in which about a third of the joints mimic earlier ones; and what follows what.

    Limits are wide, so that those of followers narrow none.
    """
    text = re.sub(r'lower="[^"]*" upper="[^"]*"', 'lower="-1.5" upper="1.5"', text)
    leaders, rules = [], {}
    for name in re.findall(r'<joint name="(\w+)" type="(?:revolute|continuous|prismatic)"', text):
        if not leaders or rng.random() < 0.6:
            leaders.append(name)
            continue
        rules[name] = str(rng.choice([*leaders, *rules])), rng.uniform(-0.9, 0.9), 0.1
        leader, multiplier, offset = rules[name]
        tag = f'<mimic joint="{leader}" multiplier="{multiplier}" offset="{offset}"/>'
        text = re.sub(rf'(<joint name="{name}".*?)(</joint>)', rf"\1{tag}\2", text)
    return text, rules


@pytest.mark.parametrize("seed", range(6))
def test_random_followers_move_as_joints_of_their_own(seed, tmp_path):
    """Poses, Jacobian, bounds and certificate against the same arm without <mimic>."""
    rng = np.random.default_rng(seed)
    text, rules = mimicked(random_urdf(seed).decode(), rng)
    path, plain = tmp_path / "arm.urdf", tmp_path / "plain.urdf"
    path.write_text(text)
    plain.write_text(re.sub("<mimic[^>]*>", "", text))
    robot = load_robot(path, "tool")
    leaves = ["tool", *re.findall(r'<link name="(side\d+)"', text)]
    free = load_robot(plain, leaves)

    def own(q):
        """Configurations (k, m) of the arm without followers; joints off its chain are at 0."""
        values = {name: np.zeros(len(q)) for name in free.joint_names}
        values |= dict(zip(robot.joint_names, q.T, strict=True))
        for name, (leader, multiplier, offset) in rules.items():
            values[name] = multiplier * values[leader] + offset
        return np.transpose([values[name] for name in free.joint_names])

    q = drawn(robot, 10, seed)
    for frame in robot.frame_names:
        np.testing.assert_allclose(robot.poses(q, frame), free.poses(own(q), frame), atol=1e-12)
    region = TaskSpaceRegion(robot.pose(q[0]), np.eye(4), np.full((6, 2), (-0.3, 0.3)))
    exact, truth = (CollisionChecker(arm, WALL) for arm in (robot, free))
    for a, b in pairwise(q):
        states = a + np.linspace(0.0, 0.2, 60)[:, None] * (b - a)
        x = displacements(robot, region, states)
        most, _ = bound_between(robot, region, states[[0, -1]], x[[0, -1]])
        # near the angle pi the rotation vector changes its sign
        rows = slice(0, 6 if np.linalg.norm(x[:, 3:6], axis=1).max() < 3.0 else 3)
        ends = np.abs(x[[0, -1], rows]).max(axis=0)
        assert (np.abs(x[:, rows]) - ends).max() <= most[0] + 1e-9
        clear = exact.clear_of_obstacles(
            a[None], states[None, [0, -1]], np.zeros(1, dtype=int)
        ).free
        if clear[0] == exact.links:
            pairs = [truth.colliding_pair(row) for row in own(states)]
            assert not any(pair and pair.second == "wall" for pair in pairs)


def test_mujoco_places_followers_as_kinematics_does(robot):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(mjcf_of(robot, Scene("empty", ())))
    data = mujoco.MjData(model)
    q = drawn(robot, 1)
    for name, value in zip(robot.moving_joints, robot.kinematics.joint_values(q)[0], strict=True):
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_forward(model, data)
    _, translations = link_poses(robot.kinematics, q)
    for j in range(len(robot.moving_joints)):
        place = data.body(f"link_{j + 1}").xpos
        np.testing.assert_allclose(place, translations[0, j + 1], atol=1e-9)
    # three equations, which these values satisfy
    assert model.neq == 3
    equations = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    np.testing.assert_allclose(data.efc_pos[equations], 0.0, atol=1e-12)
