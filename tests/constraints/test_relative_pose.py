"""Regions between two hands: F, J and bounds between states, on random pairs of arms and Baxter."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties.random_arms import ARMS, two_armed
from scipy.spatial.transform import Rotation

from cvqmpt_lab.benchmarks.two_arms import hold
from cvqmpt_lab.codec import from_plain, to_plain
from cvqmpt_lab.constraints.between_states import _between
from cvqmpt_lab.constraints.named import Region, relative_pose
from cvqmpt_lab.constraints.report import displacements, excess
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    TOLERANCE,
    RegionConstraint,
    TaskSpaceRegionChain,
)
from cvqmpt_lab.poses import pose
from cvqmpt_lab.robot.load import robot_from_source

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
    region = chain(robot, T0_w, Tw_e, Bw=np.tile((-WIDTH, WIDTH), (6, 1)), tilt=WIDTH)
    F, J = RegionConstraint(robot, (region,)).residual_and_jacobian(q, full=True)
    displaced = np.linalg.inv(T0_w) @ relative(robot, q[None])[0] @ np.linalg.inv(Tw_e)
    turn = Rotation.from_matrix(displaced[:3, :3]).as_rotvec()
    x = np.concatenate([displaced[:3, 3], turn, [np.arccos(displaced[2, 2].clip(-1.0, 1.0))]])
    np.testing.assert_allclose(F, x - x.clip(-WIDTH, WIDTH), atol=1e-6)
    if 0.1 < x[6] < 3.0 and np.linalg.norm(turn) < 3.0:  # where x is smooth
        near = q + 1e-6 * np.concatenate([np.eye(robot.dof), -np.eye(robot.dof)])
        forward, back = np.split(displacements(robot, region, near), 2)
        np.testing.assert_allclose(J, (forward - back).T / 2e-6, atol=2e-4)


def test_a_hand_turns_freely_about_an_axis_and_about_no_other(baxter):
    """Turned about it, F is 0; turned about another axis, F is the angle; projections spread."""
    left, right = baxter.end_effectors
    held = hold(baxter, "tray-over-table").constraint[0]
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
    assert np.abs(T[:, :3, 3]).max() <= 2 * TOLERANCE and (T[:, 2, 2] > 1.0 - 1e-6).all()
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
    """A rotation (3, 3) whose first column is a direction."""
    length = np.linalg.norm(direction)
    x = direction / length if length > 1e-9 else fallback
    return Rotation.align_vectors([x], [[1.0, 0.0, 0.0]])[0].as_matrix()


def bulging(robot, T, kind, rng):
    """A region whose bound both ends of poses T (k, 4, 4) keep, and the middle breaks most."""
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
    """The largest excess between two states, as a share of what the bound allows."""
    share = 0.0
    for states in stretches(robot, rng, step, tries):
        region = bulging(robot, relative(robot, states), kind, rng)
        x = displacements(robot, region, states)
        beyond = excess(region, x).max(axis=1)
        more, _ = _between(robot, region, states[[0, -1]], x[[0, -1]])
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
