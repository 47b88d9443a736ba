"""A second hand holds an object only where the constraint bounds the way of its points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.poses import pose, rigid
from cvqmpt_lab.constraints.by_name.relative_pose import relative_pose
from cvqmpt_lab.constraints.holding import play_of_hand
from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegionChain
from cvqmpt_lab.problem import really_held
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.scene.shapes import Box

RIGID = [0.0] * 6


@pytest.fixture(scope="module", params=["baxter", "talos"])
def robot(request):
    return robot_from_source({"name": request.param})


def tie(robot, bounds, T0_w=None, Tw_e=None, **fields):
    """Return a region between both hands with symmetric bounds (6,)."""
    left, right = robot.end_effectors
    Bw = np.array([[-bound, bound] for bound in bounds])
    T0_w, Tw_e = (np.eye(4) if T is None else T for T in (T0_w, Tw_e))
    return TaskSpaceRegionChain(T0_w, Tw_e, Bw, base=left, end_effector=right, **fields)


def holds(robot, region, reverse=False):
    """Return whether the second hand holds what the first one carries; reverse: the other way."""
    carrier, other = reversed([*robot.end_effectors]) if reverse else robot.end_effectors
    tray = Attachment(
        "tray", Box((0.1, 0.1, 0.1)), np.eye(4), end_effector=carrier, also_held_by=(other,)
    )
    return really_held(robot, (tray,), (region,))[0].also_held_by == (other,)


@pytest.mark.parametrize("reverse", [False, True])
def test_a_hand_on_a_lever_does_not_hold(robot, reverse):
    """The frame w turns freely, or by 0.2 rad, about an axis 0.155 m beside the second hand."""
    beside = pose((0.0, -0.155, 0.0))
    ends = {"T0_w": np.linalg.inv(beside)} if reverse else {"Tw_e": beside}
    assert holds(robot, tie(robot, RIGID, **ends), reverse)
    for free in ([0, 0, 0, 0, 0, FREE], [0, 0, 0, 0, 0, 0.1], [0, 0, 0, 0.1, 0.1, 0.1]):
        # a turn about one axis through the hand is no way
        assert holds(robot, tie(robot, free), reverse) == (np.count_nonzero(free) == 1)
        assert not holds(robot, tie(robot, free, **ends), reverse)
    along = np.linalg.inv(pose((0.0, 0.0, 0.3))) if reverse else pose((0.0, 0.0, 0.3))
    ends = dict.fromkeys(ends, along)
    assert holds(robot, tie(robot, [0, 0, 0, 0, 0, FREE], **ends), reverse)
    # the axis itself leans, and has a lever
    assert not holds(robot, tie(robot, [0, 0, 0] + [FREE] * 3, tilt=0.05, **ends), reverse)


def test_the_frame_of_a_region_is_not_the_hand_that_holds():
    """The region bounds another frame of the second hand's link, 0.1 m beside the hand's origin."""
    robot = robot_from_source({"name": "baxter"})
    _, right = robot.end_effectors
    frames = [name for name in robot.frame_names if robot.frame(name)[0] == robot.hand(right)[0]]
    T_hand = np.linalg.inv(robot.hand(right)[1])
    apart = {name: np.linalg.norm((T_hand @ robot.frame(name)[1])[:2, 3]) for name in frames}
    far = max(apart, key=apart.get)
    turning = tie(robot, [0, 0, 0, 0, 0, FREE])
    assert apart[far] > 0.02 and holds(robot, turning)
    assert not holds(robot, turning.changed(end_effector=far))


def test_hands_that_hold_rigidly_or_around_a_round_handle_hold(robot):
    left, right = robot.end_effectors
    at = rigid(Rotation.from_euler("xyz", (0.3, 1.0, -2.0)).as_matrix(), (0.1, -0.4, 0.2))
    for fields, expected in (
        ({}, True),
        ({"position": 0.002, "rotation": 0.005}, True),
        ({"position": 0.02}, False),  # by 69 mm from corner to corner
        ({"about": "y"}, True),
        ({"about": "y", "rotation": 0.2}, False),
    ):
        region = relative_pose(left, at, **fields).changed(end_effector=right)
        assert holds(robot, region) is expected


def test_no_point_of_the_hand_moves_further_than_the_bound(robot):
    """Random regions: offsets of both frames, bounds that are not symmetric, one axis free."""
    left, right = robot.end_effectors
    rng, checked = np.random.default_rng(0), 0
    row, T_link_hand = robot.hand(right)
    corners = np.concatenate([p.vertices_in_link for p in robot.links if p.link == row])[::20]
    points = (corners - T_link_hand[:3, 3]) @ T_link_hand[:3, :3]
    for trial in range(60):
        centre = rng.choice([0.0, 0.3]) * rng.normal(size=(6, 1))
        width = np.repeat([0.01, rng.choice([0.0, 0.02, 0.3])], 3)[:, None]
        Bw = np.sort(centre + width * rng.uniform(-1.0, 1.0, (6, 2)), axis=1)
        free = trial % 4
        if free:
            Bw[2 + free] = -FREE, FREE
        T0_w, Tw_e = (
            rigid(Rotation.random(random_state=rng).as_matrix(), rng.choice([0, 0.2], 3))
            for _ in range(2)
        )
        region = TaskSpaceRegionChain(T0_w, Tw_e, Bw, base=left, end_effector=right)
        lower, upper = np.clip(Bw, -np.pi, np.pi).T
        x = np.where(rng.random((1000, 6)) < 0.5, lower, upper)
        x[::2] = lower + rng.random((500, 6)) * (upper - lower)
        x = x[np.linalg.norm(x[:, 3:], axis=1) <= np.pi]
        T = np.tile(np.eye(4), (len(x), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = Rotation.from_rotvec(x[:, 3:]).as_matrix(), x[:, :3]
        T = T0_w @ T @ Tw_e
        there = T[:, None, :3, 3] + (0.0 if free else points @ T[:, :3, :3].swapaxes(1, 2))
        way = np.linalg.norm(there - there[0], axis=2).max(initial=0.0)
        assert way <= play_of_hand(robot, (region,), left, right) + 1e-9
        checked += len(x) > 1
    assert checked > 40
