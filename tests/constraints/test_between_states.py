"""Bounds between path states, of hands and between hands; the share of bounds a path uses."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_arms import ARMS, two_armed
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.two_arms import hold
from cvqmpt_lab.certificate.between_states import evenly_spaced, largest_violation
from cvqmpt_lab.constraints.bounds_between import bound_between
from cvqmpt_lab.constraints.by_name.relative_pose import relative_pose
from cvqmpt_lab.constraints.named import Region
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.report import bound_usage
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    TaskSpaceRegion,
    TaskSpaceRegionChain,
    displacements,
    excess,
    symmetric_region,
    upright,
    upright_box,
)
from cvqmpt_lab.robot.load import robot_from_source

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])


def dense(robot, region, states, spacing=5e-4):
    """Return the largest violation of a region at very many states."""
    x = displacements(robot, region, evenly_spaced(states, spacing))
    lower, upper = region.bounds.T
    return float(np.maximum(lower - x, x - upper)[:, region.bounded_rows].max())


@pytest.mark.parametrize("tolerance", [1e-3, 0.1])
@pytest.mark.parametrize("kind", ["upright", "upright-box", "pose", "slider"])
def test_the_bound_holds_and_is_close(panda, slider_arm, kind, tolerance):
    robot = slider_arm if kind == "slider" else panda
    rng = np.random.default_rng(0)
    for _ in range(25):
        steps = rng.normal(0.0, 0.03, (4, robot.dof))
        states = robot.random_configurations(rng, 1) + np.cumsum(steps, axis=0)
        region = upright_box() if kind == "upright-box" else upright()
        if not kind.startswith("upright"):
            region = symmetric_region(robot.pose(states[0]), np.eye(4), [0.02] * 6)
        found = largest_violation(robot, (region,), states, 0.04, tolerance)
        truth = dense(robot, region, states)
        assert truth <= found.largest + 1e-9
        assert max(found.radians, found.metres) <= max(truth, 0.0) + 2e-3
        if truth <= 0.5 * tolerance:
            assert found.largest <= tolerance


def test_a_kink_between_two_good_states_is_found(panda):
    """Only the middle of a motion is tilted; both ends are upright to 1e-4 rad."""
    manifold = RegionConstraint(panda, (upright(0.0),))
    a, b = (manifold.project(HOME + (0.0, d, 0.0, 0.0, 0.0, d, 0.0)) for d in (-0.05, 0.05))
    bent = np.array([a, 0.5 * (a + b) + 2e-3 * np.eye(7)[5], b])
    assert largest_violation(panda, (upright(1e-4),), bent[[0, 2]], 1.0, 1e-3).largest <= 1e-3
    assert largest_violation(panda, (upright(1e-4),), bent, 1.0, 1e-3).largest > 1e-3


def test_flips_at_angle_pi_are_no_violation_of_symmetric_bounds(panda):
    """In a frame turned by pi about the vertical, the arm's rotation vector changes sign."""
    half_turn = np.diag([1.0, -1.0, -1.0, 1.0])
    region = replace(upright_box(0.02), T0_w=upright_box().T0_w @ half_turn)
    manifold = RegionConstraint(panda, (region,))
    states = [manifold.project(np.array([-0.8, 0.3, 0.0, -2.0, 0.0, 2.0, 0.8]))]
    for _ in range(40):
        states.append(manifold.project(states[-1] + 0.04 * np.eye(7)[0]))
    states = np.array(states)
    x = displacements(panda, region, states)
    assert np.abs(np.diff(x[:, 3])).max() > 6.0, "no flip, nothing tested"
    wider = replace(region, Bw=upright_box(0.021).Bw)
    assert largest_violation(panda, (wider,), states, 0.04, 1e-3).largest <= 1e-3


def test_a_stretch_through_half_a_turn_near_the_bound_is_shown_to_be_inside(panda):
    """Path of place problem 29: tilt 0.4 mrad inside the bounds where the rotation vector flips."""
    first = np.array([-1.14812, 0.38627, -0.63918, -1.13516, -1.36829, 1.75537, 2.18154])
    last = np.array([-1.19274, 0.36491, -0.61858, -1.12574, -1.38658, 1.74428, 2.15945])
    states = np.array([first, last])
    region = (upright_box(),)
    assert largest_violation(panda, region, evenly_spaced(states, 1e-4), 1.0, 1.0).radians == 0.0
    assert largest_violation(panda, region, states, 0.11, 5e-4).largest <= 5e-4
    # without regions there is no violation
    found = largest_violation(panda, (), np.array([HOME, HOME + 0.1]), 0.04, 1e-3)
    assert (found.radians, found.metres, found.largest, found.at) == (0.0, 0.0, 0.0, None)


def test_the_largest_tilt_of_a_path_is_found_against_its_bound(solution):
    problem, states = solution.problem, solution.path.states
    uses = bound_usage(problem.robot, problem.constraint, states)
    assert [(use.region, use.row, use.unit) for use in uses] == [(0, 4, "rad"), (0, 5, "rad")]
    tilts = np.abs(displacements(problem.robot, problem.constraint[0], states)[:, 4:6])
    assert [abs(use.value) for use in uses] == pytest.approx(tilts.max(axis=0))
    assert str(uses[0]) == f"rotation about y {tilts[:, 0].max():.3g} of 0.1 rad"


def test_a_bound_on_one_side_names_the_state_closest_to_it(panda):
    """The hand is above a table: the lowest state is named, however high the others are."""
    states = panda.random_configurations(np.random.default_rng(0), 20)
    Bw = np.array([[-np.inf, np.inf]] * 6)
    Bw[2, 0] = 0.0
    table = TaskSpaceRegion(pose((0.0, 0.0, -0.5)), np.eye(4), Bw)
    (use,) = bound_usage(panda, (upright(np.pi), table), states)
    lowest = min(panda.pose(q)[2, 3] for q in states) + 0.5
    assert use.value == pytest.approx(lowest) and (use.lower, use.upper) == (0.0, np.inf)
    assert str(use) == f"position z {lowest:.3g} of 0 to inf m"
    beside = TaskSpaceRegion(panda.pose(HOME) @ pose((0.1, 0.0, 0.0)), np.eye(4), np.zeros((6, 2)))
    found = displacements(panda, beside, HOME[None])[0]
    ahead = 0.5 * np.pi  # of the hand: its z axis points down
    np.testing.assert_allclose(found, [-0.1, *[0.0] * 6, 0.1, 0.1, ahead], atol=1e-12)


pairs = st.integers(0, ARMS - 1).map(two_armed)
seeds = st.integers(0, 2**32 - 1)
DENSE = 201  # states of a stretch
WIDTH = 0.01  # [m, rad] of bounds, half
LEANS = (0.0, 0.3, 0.5 * np.pi, 3.0, np.pi)  # [rad] of a hand in the middle of a motion


@pytest.fixture(scope="module")
def baxter():
    return robot_from_source({"name": "baxter"})


def relative(robot, q):
    """Poses (k, 4, 4) of the second hand in the frame of the first, by pinocchio."""
    left, right = robot.end_effectors
    return np.linalg.inv(robot.poses(q, left)) @ robot.poses(q, right)


def chain(robot, T0_w, Tw_e, **more):
    left, right = robot.end_effectors
    bounds = more.pop("Bw", np.tile((-FREE, FREE), (6, 1)))
    return TaskSpaceRegionChain(T0_w, Tw_e, bounds, left, end_effector=right, **more)


@given(robot=pairs, seed=seeds)
def test_F_is_what_pinocchio_says_and_J_is_its_slope(robot, seed):
    rng = np.random.default_rng(seed)
    q = robot.random_configurations(rng, 1)[0]
    T0_w, Tw_e = pose(rng.uniform(-0.3, 0.3, 3)), pose(rng.uniform(-0.3, 0.3, 3))
    T0_w[:3, :3], Tw_e[:3, :3] = Rotation.random(2, random_state=rng).as_matrix()
    bounds = {"Bw": np.tile((-WIDTH, WIDTH), (6, 1)), "tilt": WIDTH, "bearing": WIDTH}
    bounds |= {"distance": (5.0, None), "radius": (0.0, WIDTH)}
    region = chain(robot, T0_w, Tw_e, **bounds)
    F, J = RegionConstraint(robot, (region,)).residual_and_jacobian(q, full=True)
    displaced = np.linalg.inv(T0_w) @ relative(robot, q[None])[0] @ np.linalg.inv(Tw_e)
    turn = Rotation.from_matrix(displaced[:3, :3]).as_rotvec()
    x = np.concatenate([displaced[:3, 3], turn, [np.arccos(displaced[2, 2].clip(-1.0, 1.0))]])
    far, across = np.linalg.norm(x[:3]), np.linalg.norm(x[:2])
    bearing = np.arccos((-x[:3] @ displaced[:3, 2] / far).clip(-1.0, 1.0))
    x = np.array([*x, far, across, bearing])
    np.testing.assert_allclose(F, x - x.clip(*region.bounds.T), atol=1e-6)
    # where x is smooth
    if 0.1 < x[6] < 3.0 and np.linalg.norm(turn) < 3.0 and across > 0.05 and 0.1 < bearing < 3.0:
        near = q + 1e-6 * np.concatenate([np.eye(robot.dof), -np.eye(robot.dof)])
        forward, back = np.split(displacements(robot, region, near), 2)
        np.testing.assert_allclose(J, (forward - back).T / 2e-6, atol=2e-4)


def test_a_hand_turns_freely_about_an_axis_and_about_no_other(baxter):
    """A rotation about the axis gives F = 0, about another axis F is the angle."""
    left, right = baxter.end_effectors
    _, _, (held, *_) = hold(baxter, "tray-over-table")
    manifold = RegionConstraint(baxter, (held,))
    draws = baxter.random_configurations(np.random.default_rng(0), 60)
    q = next(found for start in draws if (found := manifold.project(start)) is not None)
    for axis, about in zip("xyz", np.eye(3), strict=True):
        for k, other in enumerate(np.eye(3)):
            turned = held.T0_w.copy()
            turned[:3, :3] = turned[:3, :3] @ Rotation.from_rotvec(0.7 * other).as_matrix()
            free = relative_pose(left, turned, about=axis).changed(end_effector=right)
            F = RegionConstraint(baxter, (free,)).residual(q)
            assert np.abs(F).max() == pytest.approx(0.0 if about[k] else 0.7, abs=0.02)
    free = relative_pose(left, held.T0_w, about="z").changed(end_effector=right)
    manifold = RegionConstraint(baxter, (free,))
    found = [q for start in draws if (q := manifold.project(start)) is not None]
    T = np.linalg.inv(held.T0_w) @ relative(baxter, np.array(found))
    assert np.abs(T[:, :3, 3]).max() <= 2 * PROJECTION_TOLERANCE and (T[:, 2, 2] > 1.0 - 1e-6).all()
    assert np.ptp(np.arctan2(T[:, 1, 0], T[:, 0, 0])) > 3.0


def test_regions_between_hands_survive_json_and_wrong_ones_are_refused(baxter):
    at = {"xyz": [0.0, 0.3, 0.0]}
    plain = {
        "relative-pose": {"base": "left_gripper", "at": at, "about": "-y", "position": 0.01},
        "end_effector": "right_gripper",
    }
    region = from_plain(Region, plain)
    again = from_plain(Region, json.loads(json.dumps(to_plain(region))))
    assert again.base == "left_gripper" and again.end_effector == "right_gripper"
    for name in ("T0_w", "Tw_e", "Bw"):
        np.testing.assert_array_equal(getattr(again, name), getattr(region, name))
    q = baxter.random_configurations(np.random.default_rng(0), 5)
    one, other = (RegionConstraint(baxter, (it,)).residual(q) for it in (region, again))
    np.testing.assert_array_equal(one, other)


def stretches(robot, rng, step, tries):
    """Dense states of straight motions: of two joints at one speed, and of all."""
    for _ in range(tries):
        middle = robot.random_configurations(rng, 1)[0]
        two = np.eye(robot.dof)[rng.integers(robot.dof, size=2)].sum(axis=0)
        for way in (two, rng.standard_normal(robot.dof)):
            half = 0.5 * step * way / np.abs(way).max()
            yield middle + np.linspace(-1.0, 1.0, DENSE)[:, None] * half


def along(direction, fallback):
    """Return a rotation (3, 3) whose first column is a direction."""
    length = np.linalg.norm(direction)
    x = direction / length if length > 1e-9 else fallback
    return Rotation.align_vectors([x], [[1.0, 0.0, 0.0]])[0].as_matrix()


def bulging(robot, T, kind, rng):
    """Return a region that both ends of poses T (k, 4, 4) satisfy and the middle violates most."""
    ends, middle = T[[0, -1]], T[len(T) // 2]
    if kind == "position":
        centre = ends[:, :3, 3].mean(axis=0)
        Q = along(middle[:3, 3] - centre, np.eye(3)[0])
        w = pose(centre - WIDTH * Q[:, 0])
        w[:3, :3] = Q
        Bw = np.array([[-WIDTH, WIDTH]] + [[-FREE, FREE]] * 5)
        return chain(robot, w, np.eye(4), Bw=Bw)
    if kind == "rotation":
        first, last = Rotation.from_matrix(ends[:, :3, :3])
        halfway = first * Rotation.from_rotvec(0.5 * (first.inv() * last).as_rotvec())
        Q = along((halfway.inv() * Rotation.from_matrix(middle[:3, :3])).as_rotvec(), np.eye(3)[0])
        w, back = np.eye(4), np.eye(4)
        w[:3, :3] = (halfway * Rotation.from_rotvec(-WIDTH * Q[:, 0])).as_matrix() @ Q
        back[:3, :3] = Q.T
        return chain(robot, w, back, Bw=np.array([[-FREE, FREE]] * 3 + [[-WIDTH, WIDTH]] * 3))
    rate = T[len(T) // 2 + 1, :3, 2] - T[len(T) // 2 - 1, :3, 2]
    axis = np.cross(middle[:3, 2], np.cross(middle[:3, 2], rate))
    w = middle.copy()
    lean = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 1e-9 else middle[:3, 0]
    w[:3, :3] = Rotation.from_rotvec(rng.choice(LEANS) * lean).as_matrix() @ w[:3, :3]
    return chain(robot, w, np.eye(4), tilt=WIDTH)


def require_bound(robot, kind, step, rng, tries):
    """Return the largest violation between two states, as a fraction of the proven bound."""
    share = 0.0
    for states in stretches(robot, rng, step, tries):
        region = bulging(robot, relative(robot, states), kind, rng)
        x = displacements(robot, region, states)
        beyond = excess(region, x).max(axis=1)
        more, _ = bound_between(robot, region, states[[0, -1]], x[[0, -1]])
        rise = beyond.max() - max(beyond[0], beyond[-1])
        assert rise <= more[0] + 1e-9
        share = max(share, rise / max(more[0], 1e-12))
    return share


@given(
    robot=pairs,
    kind=st.sampled_from(["position", "rotation", "tilt"]),
    step=st.sampled_from([0.01, 0.1, 1.0]),
    seed=seeds,
)
def test_the_bound_between_states_holds_while_both_hands_move(robot, kind, step, seed):
    require_bound(robot, kind, step, np.random.default_rng(seed), tries=3)


@pytest.mark.parametrize("kind", ["position", "rotation", "tilt"])
def test_the_bound_between_states_holds_on_baxter_and_is_no_empty_one(baxter, kind):
    rng = np.random.default_rng(0)
    shares = [require_bound(baxter, kind, step, rng, tries=40) for step in (0.01, 0.1, 0.5)]
    assert max(shares) > 0.02
