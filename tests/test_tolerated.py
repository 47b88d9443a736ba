"""What certificates report as tolerated, against brute force: each number alone is a promise."""

import numpy as np
import pytest
from rigid_moves import moves
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.certificate.tolerated import least_width, lever_of
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    TaskSpaceRegion,
    TaskSpaceRegionChain,
    displacements,
    excess,
)
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import JointPath

STARTS = {
    "panda": np.array([0.0, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8]),
    "ur5": np.array([0.0, -1.2, 1.4, -0.5, 0.6, 0.3]),
    "baxter": np.array([0.4, 0.3, -0.8, 1.4, 1.1, -0.8, -2.6, 1.1, 0.1, 0.6, 1.1, -2.9, 1.4, -2.2]),
}


def corners_of(robot, hand):
    """Return the corners (k, 3) of the pieces of a hand's link, in the hand's frame."""
    row, T = robot.hand(hand)
    corners = np.concatenate([piece.vertices_in_link for piece in robot.links if piece.link == row])
    return (corners - T[:3, 3]) @ T[:3, :3]


def held(robot, start, lever, bounds, two=False):
    """Return a region around a start, with a lever from the hand."""
    Bw = np.array([[-x, x] for x in bounds])
    Tw_e = pose(lever)
    if not two:
        return TaskSpaceRegion(robot.pose(start) @ np.linalg.inv(Tw_e), Tw_e, Bw)
    left, right = robot.end_effectors
    at = np.linalg.inv(robot.pose(start, left)) @ robot.pose(start, right)
    return TaskSpaceRegionChain(at @ np.linalg.inv(Tw_e), Tw_e, Bw, left, end_effector=right)


@pytest.mark.parametrize(
    ("name", "lever"),
    [
        ("panda", (0.0, 0.0, -0.5)),
        ("panda", (0.0, 0.0, 0.0)),
        ("ur5", (0.3, -0.2, 0.1)),
        ("ur5", (0.0, 0.05, -1.0)),
        ("baxter", (0.2, 0.0, 0.3)),
    ],
)
def test_each_number_alone_is_a_promise(name, lever):
    robot, start, two = robot_from_source({"name": name}), STARTS[name], name == "baxter"
    rng = np.random.default_rng(0)
    region = held(robot, start, lever, [0.02, 0.02, 0.02, FREE, FREE, FREE], two)
    states = np.array([start, start + 1e-7])
    problem = PlanningProblem(
        "t", robot, Scene("empty", ()), start, states[1:], constraint=(region,)
    )
    said = certify(problem, JointPath(states), exact_clearance=True).tolerated
    assert said.points_m > 0.0 and said.hand_rad > 0.0 and said.joints > 0.0
    hands = list(robot.end_effectors)

    def violation(first, second):
        """Return how far hands are outside, moved by first (k, 4, 4), and second (k, 4, 4)."""
        poses = {hand: robot.pose(start, hand) for hand in hands}
        if not two:
            T = np.linalg.inv(region.T0_w) @ poses[hands[0]] @ first @ np.linalg.inv(region.Tw_e)
        else:
            w = poses[hands[0]] @ second @ region.T0_w
            T = np.linalg.inv(w) @ poses[hands[1]] @ first @ np.linalg.inv(region.Tw_e)
        return np.abs(T[:, :3, 3]).max() - 0.02

    bodies = [corners_of(robot, hand) for hand in (hands[-1], hands[0])]
    offs = [moves(np.random.default_rng(5), body, said.points_m, 400) for body in bodies]
    count = min(map(len, offs))
    assert violation(*(off[:count] for off in offs)) <= 0.0
    twice = [moves(np.random.default_rng(5), body, 4.0 * said.points_m, 400) for body in bodies]
    assert two or violation(*(off[:200] for off in twice)) > 0.0  # the promise is not far too small
    turns = Rotation.from_rotvec(
        min(said.hand_rad, 1.0)
        * (v := rng.standard_normal((400, 3)))
        / np.linalg.norm(v, axis=1)[:, None]
    )
    T = np.tile(np.eye(4), (400, 1, 1))
    T[:, :3, :3] = turns.as_matrix()
    assert violation(T, np.eye(4)) <= 0.0
    off = said.joints * rng.choice([-1.0, 1.0], (400, robot.dof))
    assert excess(region, displacements(robot, region, start + off)).max() <= 0.0
    checker = problem.collision_checker()
    assert not checker.in_collision_batch(start + off[:50]).any()


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_joints_that_are_off_keep_bounds_of_every_row(name):
    """Rotation, tilt and distance beside positions; frames with levers."""
    robot, start = robot_from_source({"name": name}), STARTS[name]
    rng = np.random.default_rng(1)
    states = np.array([start, start + 1e-3])
    for _ in range(6):
        bounds = rng.choice([0.03, FREE], 3).tolist() + rng.choice([0.05, FREE], 3).tolist()
        region = held(robot, start, rng.uniform(-0.6, 0.6, 3), bounds)
        region = region.changed(tilt=0.08, distance=(0.0, 0.03))
        problem = PlanningProblem(
            "t", robot, Scene("empty", ()), start, states[1:], constraint=(region,)
        )
        said = certify(problem, JointPath(states), exact_clearance=True).tolerated
        off = said.joints * rng.choice([-1.0, 1.0], (2, 500, robot.dof))
        assert said.joints > 0.0
        for q, change in zip(states, off, strict=True):
            assert excess(region, displacements(robot, region, q + change)).max() <= 0.0


def test_the_least_width_and_the_lever_of_a_box_are_bounds():
    corners = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.03, 0.03) for z in (0.0, 0.02)])
    assert 0.0594 < least_width(corners) <= 0.06
    lever = lever_of(corners, np.array([0.5, 0.0, 0.01]))
    assert 1.0 + 2.0 * 0.4 / 0.06 <= lever.way < 1.02 * (1.0 + 2.0 * 0.4 / 0.06)
    inside = lever_of(corners, np.array([0.05, 0.01, 0.005]))
    assert inside.way == pytest.approx(1.0, abs=1e-3)
    assert lever_of(corners[:0], np.zeros(3)).way == np.inf
    assert lever_of(np.zeros((1, 3)), np.zeros(3)).way == 1.0
    assert lever_of(np.zeros((1, 3)), np.ones(3)).way == np.inf
