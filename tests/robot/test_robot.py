"""Robots: limits; kinematics against pinocchio; sines against numpy; bounds; left-out pairs."""

import numpy as np
import pinocchio as pin
import pytest
from numba import njit
from refusals import refused

from cvqmpt_lab.collision.motion_bounds import Sweep
from cvqmpt_lab.robot.hulls import hull_vertices
from cvqmpt_lab.robot.kinematics import link_poses, sine_and_cosine
from cvqmpt_lab.robot.left_out import OVERLAP
from cvqmpt_lab.robot.load import load_robot, robot_from_source
from cvqmpt_lab.robot.load import panda as load_panda

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])


def random_configurations(robot, count, seed=0):
    return robot.random_configurations(np.random.default_rng(seed), count)


@pytest.mark.parametrize("name", ["panda", "slider_arm"])
def test_kernel_poses_equal_pinocchio_s(name, request):
    """End effector and every collision piece, on random configurations."""
    robot = request.getfixturevalue(name)
    data, geometry_data = robot.model.createData(), pin.GeometryData(robot.collision_model)
    configurations = random_configurations(robot, 100)
    rotations, translations = link_poses(robot.kinematics, configurations)
    for q, R, t in zip(configurations, rotations, translations, strict=True):
        T = np.tile(np.eye(4), (robot.dof + 1, 1, 1))
        T[:, :3, :3], T[:, :3, 3] = R, t
        link, T_link_hand = robot.hand()
        np.testing.assert_allclose(T[link] @ T_link_hand, robot.pose(q), atol=1e-12)
        pin.updateGeometryPlacements(robot.model, data, robot.collision_model, geometry_data, q)
        for piece, placement in zip(robot.links, geometry_data.oMg, strict=True):
            found, expected = T[piece.link] @ piece.T_link_geometry, placement.homogeneous
            np.testing.assert_allclose(found, expected, atol=1e-12, err_msg=piece.name)


def test_finger_opening_moves_the_fingers():
    robot = load_panda(0.013)
    for finger, sign in (("panda_leftfinger", 1.0), ("panda_rightfinger", -1.0)):
        T_hand_finger = np.linalg.inv(robot.pose(HOME)) @ robot.pose(HOME, finger)
        assert T_hand_finger[1, 3] == pytest.approx(sign * 0.013, abs=1e-12)


def test_the_kinematics_digest_depends_on_joints_and_not_on_the_hand(panda, slider_arm, edited):
    """Limits, axis and placement of a joint change the digest; it is the same in all processes."""
    digest = slider_arm.kinematics_digest
    assert digest == "ccce46299e68f03c312831aa827b204d"
    assert panda.kinematics_digest == load_panda(0.01).kinematics_digest != digest
    changes = {'upper="0.7"': 'upper="0.8"', "0.6 0 0.8": "0.8 0 0.6", "0 0.02 0.35": "0 0 0.36"}
    for change in changes.items():
        assert load_robot(edited(change), "tool").kinematics_digest != digest


@njit
def sines_and_cosines(angles):
    out = np.empty((2, len(angles)))
    for i in range(len(angles)):
        out[0, i], out[1, i] = sine_and_cosine(angles[i])
    return out


def test_sine_and_cosine_are_numpys():
    """Includes multiples of pi / 4, where the quadrant changes, and the doubles next to them."""
    exact, rng = np.arange(-12_000, 12_001) * (np.pi / 4.0), np.random.default_rng(0)
    widths = 1e-8, 1.0, np.pi, 100.0, 1e4, 1e5
    spread = [rng.uniform(-width, width, 100_000) for width in widths]
    beside = np.nextafter(exact, np.inf), np.nextafter(exact, -np.inf)
    for angles in (*spread, exact, *beside, np.zeros(1)):
        both = np.sin(angles), np.cos(angles)
        for value, expected in zip(sines_and_cosines(angles), both, strict=True):
            worst = np.argmax(np.abs(value - expected))
            assert np.abs(value - expected)[worst] <= 1e-15, angles[worst]
    assert np.isnan(sines_and_cosines(np.array([np.nan, np.inf, -np.inf]))).all()


def placed(robot, geometry, q):
    """World points (k, 3) of every piece, by pinocchio."""
    data, results = robot.model.createData(), pin.GeometryData(geometry)
    pin.updateGeometryPlacements(robot.model, data, geometry, results, q)
    items = zip(geometry.geometryObjects, results.oMg, strict=True)
    return [hull_vertices(item.geometry) @ T.rotation.T + T.translation for item, T in items]


@pytest.mark.parametrize("name", ["panda", "slider_arm"])
def test_no_point_moves_further_than_the_bound(request, name):
    robot = request.getfixturevalue(name)
    geometry = robot.collision_model
    joints = [item.parentJoint for item in geometry.geometryObjects]
    links = sorted({k for k in joints if k > 0})
    sweep = Sweep(robot, geometry, links)
    rng, used = np.random.default_rng(0), []
    for size in 10.0 ** rng.uniform(-3.0, -0.7, 40):
        q = robot.random_configurations(rng, 1)[0]
        hull = q + size * rng.standard_normal((3, robot.dof))
        (bounds,) = sweep.in_world(q[None], hull[None])
        (between,) = sweep.between(q[None], hull[None], sweep.poses(q[None]))
        before = placed(robot, geometry, q)
        for weights in rng.dirichlet(np.ones(4), 10):
            after = placed(robot, geometry, weights @ np.vstack([hull, q]))
            for piece, joint in enumerate(joints):
                if joint > 0 and np.isfinite(bound := bounds[links.index(joint)]):
                    moved = np.linalg.norm(after[piece] - before[piece], axis=1).max()
                    assert moved <= bound + 1e-9
                    used.append(moved / bound)
            for pair, bound in zip(geometry.collisionPairs, between, strict=True):
                corners = ((p[pair.first][:8], p[pair.second][:8]) for p in (before, after))
                was, now = (np.linalg.norm(one[:, None] - other, axis=2) for one, other in corners)
                assert np.abs(now - was).max() <= bound + 1e-9
    assert max(used) > 0.6


@pytest.mark.slow
def test_mirrored_arms_leave_out_the_same_overlaps():
    """Hulls overlap by 1.3 mm; with margin 0 coal found 99.95 % of it left, but 0.1 % right."""
    arms = (robot_from_source({"name": f"tiago-dual-{side}"}) for side in ("left", "right"))
    overlaps = ([pair for pair in arm.left_out_pairs if OVERLAP in pair.reason] for arm in arms)
    left, right = ({(pair.first, pair.second) for pair in pairs} for pairs in overlaps)
    assert ("arm_right_6_link", "wrist_right_ft_link") in right
    assert {tuple(name.replace("left", "right") for name in pair) for pair in left} == right


def test_a_file_that_is_no_srdf_is_named(slider_arm_urdf, tmp_path):
    for text, pattern in (("<robot", "cannot read SRDF"), ("<a/>", "root <a>")):
        (tmp_path / "bad.srdf").write_text(text)
        refused(pattern, load_robot, slider_arm_urdf, "tool", srdf=tmp_path / "bad.srdf")


def test_every_body_frame_is_a_valid_choice_of_a_frame(panda):
    told = refused("frame of robot panda 'tool0'", panda.frame, "tool0")
    assert "panda_hand" in told and "panda_link5" in told
