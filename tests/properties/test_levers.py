"""Levers between a hand and the frame of a region: second hands that hold, and what is tolerated.

Bodies are boxes. Poses, regions and overlaps are computed here and by `second_judge`.
"""

import numpy as np
import pytest
from judged_bodies import Body, moved, touching
from rigid_moves import moves
from scipy.spatial.transform import Rotation
from second_judge import Arm, triangles_of
from small_arms import box, carried, joint, pendulum, problem_of

from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.search.result import JointPath

MOST_PLAY = 0.02  # [m] by which points of a second hand may move against what it holds
SLACK = 5e-4  # [m, rad] to which certificates keep a region
HANDS = ("left", "right")
STATES, BETWEEN = 25, 8  # of a motion, and states judged from one to the next


def two_hands(size, centre):
    """A hand on a rail, and a hand of three rails and three hinges: a box around its centre."""
    parts = ["along", "across", "up", "yaw", "pitch"]
    links = [box(name, (0.01, 0.01, 0.01), (0.0, 0.0, -4.0 - k)) for k, name in enumerate(parts)]
    names = ["base", *parts, "right"]
    kinds = ["prismatic"] * 3 + ["revolute"] * 3
    axes = [*np.eye(3), *np.eye(3)[::-1]]
    joints = [
        joint(f"right_{k}", names[k], names[k + 1], kinds[k], axes[k].tolist(), limit=6.0)
        for k in range(6)
    ]
    return (
        '<robot name="hands">'
        + box("base", (0.02, 0.02, 0.02), (0.0, 0.0, -3.0))
        + box("left", (0.02, 0.02, 0.02), (0.0, 0.0, 3.0))
        + "".join(links)
        + box("right", size, centre)
        + joint("left_rail", "base", "left", "prismatic", (1, 0, 0))
        + "".join(joints)
        + "</robot>"
    )


def poses_in(x):
    """Displacements (k, 4, 4) of x (k, 6)."""
    T = np.tile(np.eye(4), (len(x), 1, 1))
    T[:, :3, 3], T[:, :3, :3] = x[:, :3], Rotation.from_rotvec(x[:, 3:]).as_matrix()
    return T


def random_pose(rng, far):
    """A rotation of any size, and a place within `far` of the origin along each axis."""
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.uniform(-far, far, 3)
    return T


def bounds_of(rng):
    """Half widths (6,) of a region between two hands, some of them 0 or free."""
    halves = np.repeat([rng.choice([0.0, 0.003, 0.008]), rng.choice([0.0, 0.005, 0.03, 0.2])], 3)
    if rng.random() < 0.6:
        halves[3 + rng.integers(3)] = np.pi
    return halves


def drawn_motion(rng):
    """Hand, region and states (m, 7) that begin in it; some leave it a little."""
    size, centre = rng.uniform(0.01, 0.1, 3), rng.uniform(-0.05, 0.05, 3)
    lever = rng.choice([0.0, 0.1, 0.3, 0.3])
    T0_w, Tw_e = random_pose(rng, 0.5), random_pose(rng, lever)
    if rng.random() < 0.5:
        Tw_e[:3, :3] = np.eye(3)
    halves = bounds_of(rng)
    reach = np.minimum(halves, 0.7) * rng.choice([-1.0, 0.0, 1.0], 6) * rng.uniform(0.4, 1.02)
    slide = np.linspace(0.0, rng.uniform(-0.1, 0.1), STATES)
    x = np.linspace(0.0, 1.0, STATES)[:, None] * reach
    hand = T0_w @ poses_in(x) @ Tw_e
    turns = Rotation.from_matrix(hand[:, :3, :3]).as_euler("ZYX")
    places = hand[:, :3, 3] + slide[:, None] * [1.0, 0.0, 0.0]
    states = np.concatenate([slide[:, None], places, np.unwrap(turns, axis=0)], axis=1)
    Bw = [[None, None] if half == np.pi else [-float(half), float(half)] for half in halves]
    region = {"T0_w": T0_w.tolist(), "Tw_e": Tw_e.tolist(), "Bw": Bw}
    region |= {"base": HANDS[0], "end_effector": HANDS[1]}
    return two_hands(size, centre), (size, centre), region, states


def plate_at(rng, T_left_hand, size, centre):
    """A thin box in the first hand: in the second hand, or up to 3 cm beside it."""
    edges = rng.uniform(0.01, 0.3, 3)
    away = rng.standard_normal(3)
    away /= np.linalg.norm(away)
    beside = (0.5 * np.linalg.norm([*size, *edges]) + rng.uniform(0.0, 0.03)) * (rng.random() < 0.3)
    middle = moved(T_left_hand, np.asarray(centre))
    return carried("plate", edges, middle + beside * away, "left", "right")


def way_of(points, poses):
    """Return the largest distance between two places of a point of (k, 3), at poses (m, 4, 4)."""
    there = np.array([moved(T, points) for T in poses])
    return np.linalg.norm(there[:, None] - there[None], axis=-1).max()


@pytest.mark.promise(
    "on certified motions, a second hand moves by at most 2 cm against what it holds, or does not "
    "touch it",
    "cases",
    ci=12,
    long=2000,
)
def test_second_hands_on_levers(trials, tmp_path):
    certified, wrong = 0, {}
    for number in range(trials):
        rng = np.random.default_rng(number)
        text, (size, centre), region, states = drawn_motion(rng)
        first = np.array(region["T0_w"]) @ np.array(region["Tw_e"])
        plate = plate_at(rng, first, size, centre)
        problem = problem_of(tmp_path, text, states, HANDS, [plate], [region])
        found = certify(problem, JointPath(states))
        if not found.valid:
            continue
        certified += 1
        source = {"urdf": "arm.urdf", "srdf": None, "end_effectors": HANDS}
        arm = Arm(source, tmp_path, problem.robot.joint_names)
        shares = np.arange(1 + BETWEEN * (STATES - 1)) / BETWEEN
        dense = np.array([np.interp(shares, np.arange(STATES), q) for q in states.T]).T
        left, right = (arm.poses(dense)[arm.frames[name][0]] for name in HANDS)
        against = np.linalg.inv(left) @ right
        corners = Body("", 0, triangles_of({"type": "box", "size": size}, None) + centre).points
        Tw_e, reach = np.array(region["Tw_e"]), np.linalg.norm(corners, axis=1).max()
        # around a round handle, an axis of w through the hand stays, and the hand turns about it
        axes = [np.array([-reach, 0.0, reach])[:, None] * axis for axis in Tw_e[:3, :3]]
        way = min(way_of(points, against) for points in (corners, *axes))
        if way <= MOST_PLAY + 4.0 * SLACK * (1.0 + np.linalg.norm(Tw_e[:3, 3]) + reach):
            continue
        (thing,) = arm.carried([plate], tmp_path)
        hand = next(body for body in arm.bodies if body.name == "right")
        T = np.linalg.inv(right) @ left
        wrong |= {number: way} if any(touching(hand, thing, each) for each in T) else {}
    assert wrong == {} and certified >= 0.3 * trials


def a_hand(rng):
    """A pendulum whose hand is a box somewhere on it, and the corners (8, 3) of that box."""
    size, centre = rng.uniform(0.01, 0.2, 3), rng.uniform(-0.2, 0.2, 3)
    text, small = pendulum(), box("part_2", (0.01, 0.01, 0.01), (0, 0, -4.0))
    assert small in text
    corners = centre + 0.5 * size * (2.0 * np.indices((2, 2, 2)).reshape(3, 8).T - 1.0)
    return text.replace(small, box("part_2", size, centre)), corners


def outside(region, limits, T):
    """Return how far hands at T (k, 4, 4) leave rows of position, and any row [m, rad]."""
    D = np.linalg.inv(np.array(region["T0_w"])) @ T @ np.linalg.inv(np.array(region["Tw_e"]))
    x = np.concatenate([D[:, :3, 3], Rotation.from_matrix(D[:, :3, :3]).as_rotvec()], axis=1)
    over = np.abs(x) - limits
    return over[:, :3].max(), over.max()


@pytest.mark.promise(
    "what is tolerated of points, hand or joints, each alone, keeps bounds through levers",
    "cases",
    ci=10,
    long=2000,
)
def test_each_tolerated_number_alone(trials, tmp_path):
    broken, told = {}, 0
    for number in range(trials):
        rng = np.random.default_rng(number)
        text, corners = a_hand(rng)
        limits = rng.uniform((0.005,) * 3 + (0.05,) * 3, 0.2)
        limits[3:] = limits[3:] if rng.random() < 0.5 else np.inf
        Tw_e = random_pose(rng, rng.choice([0.0, 0.1, 0.8]))
        states = np.array([[0.0, 0.0, 0.0], [0.0, 0.002, 0.0]])
        bounds = [[-b, b] if b < np.inf else [None, None] for b in limits.tolist()]
        region = {"T0_w": np.linalg.inv(Tw_e).tolist(), "Tw_e": Tw_e.tolist(), "Bw": bounds}
        problem = problem_of(tmp_path, text, states, ("part_2",), constraint=[region])
        found = certify(problem, JointPath(states), exact_clearance=True)
        said = found.tolerated
        told += found.valid and said.points_m > 0.0
        off = moves(rng, corners, min(said.points_m, 1.0), 40)
        turns = rng.standard_normal((40, 3))
        turns *= min(said.hand_rad, 3.0) / np.linalg.norm(turns, axis=1)[:, None]
        turned = poses_in(np.concatenate([np.zeros((40, 3)), turns], axis=1))
        q = states[0] + min(said.joints, 1.0) * rng.choice([-1.0, 1.0], (40, 3))
        by_joints = poses_in(np.zeros((40, 6)))
        by_joints[:, :3, :3] = Rotation.from_euler("ZYX", q).as_matrix()
        beyond = (
            outside(region, limits, off)[0] if len(off) else 0.0,
            outside(region, limits, turned)[1],
            outside(region, limits, by_joints)[1],
        )
        broken |= {number: beyond} if max(beyond) > 1e-9 else {}
    assert broken == {} and told >= 0.8 * trials
