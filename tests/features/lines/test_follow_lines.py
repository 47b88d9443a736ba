"""The hand follows straight lines within tolerances; where it cannot, place and reason are told."""

import json
from itertools import pairwise

import numpy as np
import pytest
from command_line import refused
from refusals import refused as called
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.certificate.certificate import CERTIFICATE_TOLERANCE
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.task_space_region import symmetric_region
from cvqmpt_lab.features.lines.along_line import AlongLine, Line
from cvqmpt_lab.features.lines.follow_lines import follow_lines, rests, timed
from cvqmpt_lab.features.motion.motion_check import certified_motion
from cvqmpt_lab.features.motion.timing import TimingSettings
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box

START = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8])


@pytest.fixture(scope="module")
def seam(panda):
    """Three poses: 0.2 m sideways, then up and forward with a turn of 0.4 rad."""
    first = panda.pose(START)
    second, third = first.copy(), first.copy()
    second[:3, 3] += (0.0, 0.2, 0.0)
    third[:3, 3] = second[:3, 3] + (0.08, 0.0, 0.06)
    third[:3, :3] = second[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, 0.4]).as_matrix()
    return [first, second, third]


@pytest.fixture(scope="module")
def legs(panda, seam):
    return follow_lines(panda, Scene("free", ()), seam, 0.002, 0.01, START)


def away(panda, line, states):
    """Distances and angles of densely sampled states from a line, by scipy and a fine search."""
    dense = np.concatenate([np.linspace(a, b, 10) for a, b in pairwise(states)])
    T, s = panda.poses(dense), np.linspace(0.0, 1.0, 2001)
    places = line.at(s)
    gaps = np.linalg.norm(T[:, None, :3, 3] - places[None, :, :3, 3], axis=2)
    nearest = places[gaps.argmin(axis=1)]
    off = nearest[:, :3, :3].transpose(0, 2, 1) @ T[:, :3, :3]
    return gaps.min(axis=1).max(), Rotation.from_matrix(off).magnitude().max()


def test_lines_are_followed_within_their_tolerances(panda, seam, legs):
    assert len(legs) == 2 and all(leg.certificate.valid for leg in legs)
    for leg, begin, end in zip(legs, seam[:-1], seam[1:], strict=True):
        metres, radians = away(panda, Line(begin, end), leg.path.states)
        assert metres <= 0.002 and radians <= 0.01
    np.testing.assert_array_equal(legs[0].path.states[-1], legs[1].path.states[0])
    np.testing.assert_allclose(panda.pose(legs[1].path.states[-1]), seam[2], atol=2e-4)


def test_what_the_certificate_allows_is_within_the_tolerances(panda, seam, legs):
    """A posture 2.2 mm off the line is off the constraint by more than what is allowed."""
    (leg, _) = legs
    aside = posture_above(panda, seam[0], 0.0022)
    assert np.abs(leg.line.residual(aside)).max() > CERTIFICATE_TOLERANCE
    near = posture_above(panda, seam[0], 0.0018)
    assert 0.0 < np.abs(leg.line.residual(near)).max() <= CERTIFICATE_TOLERANCE
    assert leg.line.describe() == "within 2 mm and 0.01 rad of a line of 0.2 m"


def posture_above(panda, T, off):
    """A posture whose hand is above a pose by `off` [m]."""
    above = T.copy()
    above[2, 3] += off
    region = symmetric_region(above, np.eye(4), [0.0] * 6)
    q = RegionConstraint(panda, (region,)).project(START)
    np.testing.assert_allclose(panda.pose(q)[:3, 3], above[:3, 3], atol=1.5e-4)
    return q


def test_fine_tolerances_are_kept_and_finer_ones_refused(panda, seam):
    (leg,) = follow_lines(panda, Scene("free", ()), seam[:2], 0.01, 0.0008, START)
    assert away(panda, Line(*seam[:2]), leg.path.states)[1] <= 0.0008
    for tolerances in ((0.01, 1e-5), (0.0005, 0.01), (0.01, 0.0), (float("nan"), 0.01)):
        told = "lines are certified to 0.0005 m and rad; give more than that for both"
        called(told, follow_lines, panda, Scene("free", ()), seam[:2], *tolerances, START)


@pytest.fixture(scope="module")
def corner(panda, seam):
    """Three poses: 0.04 m sideways, then 0.1 m forward; and the legs between them."""
    poses = [seam[0].copy() for _ in range(3)]
    poses[1][1, 3] += 0.04
    poses[2][:3, 3] = poses[1][:3, 3] + (0.1, 0.0, 0.0)
    return poses, follow_lines(panda, Scene("free", ()), poses, 0.002, 0.01, START)


def test_a_motion_passes_a_pose_within_the_tolerances_without_a_rest(panda, corner):
    seam, legs = corner
    motion = timed(legs, TimingSettings(speed=0.5))
    assert np.abs(motion.velocities[1:-1]).max(axis=1).min() > 1e-3 and rests(legs, motion) == []
    T = panda.poses(motion.curve(np.linspace(0.0, motion.duration, 2000)))
    gaps = np.linalg.norm(T[:, :3, 3] - seam[1][:3, 3], axis=1)
    middle = int(gaps.argmin())
    off = Rotation.from_matrix(seam[1][:3, :3].T @ T[middle, :3, :3]).magnitude()
    assert gaps[middle] <= 0.002 and off <= 0.01
    states = motion.curve(np.linspace(0.0, motion.duration, 60))
    both = [[away(panda, Line(*ends), np.stack([q, q])) for q in states] for ends in pairs(seam)]
    assert (np.array(both) <= (0.002, 0.01)).all(axis=2).any(axis=0).all()


def pairs(poses):
    return [*pairwise(poses)]


def test_a_circle_of_poses_takes_less_than_half_of_the_time_with_rests(panda):
    angles = np.linspace(0.0, 2.0 * np.pi, 31)
    poses = [panda.pose(START) for _ in angles]
    for T, a in zip(poses, angles, strict=True):
        T[:2, 3] += 0.05 * np.cos(a) - 0.05, 0.05 * np.sin(a)
    legs = follow_lines(panda, Scene("free", ()), poses)
    settings = TimingSettings(speed=0.5)
    rested = sum(certified_motion(leg.problem, leg.path, settings).duration for leg in legs[:3])
    motion = timed(legs, settings)
    assert motion.duration < 0.5 * len(legs) / 3 * rested and rests(legs, motion) == []
    T = panda.poses(motion.curve(np.linspace(0.0, motion.duration, 500)))
    centre = panda.pose(START)[:3, 3] - (0.05, 0.0, 0.0)
    radii = np.linalg.norm(T[:, :2, 3] - centre[:2], axis=1)
    assert np.abs(radii - 0.05).max() < 0.002 and np.abs(T[:, 2, 3] - centre[2]).max() < 0.002


def test_a_motion_rests_at_a_pose_where_no_motion_through_it_is_certified(panda, corner):
    """A block that the first leg alone knows is in the way of the motion along both."""
    seam, legs = corner
    block = SceneObject("block", Box((0.02, 0.02, 0.02)), pose(seam[2][:3, 3]))
    first = legs[0].problem
    first = first.changed(scene=first.scene.with_objects(block))
    motion = timed([legs[0]._replace(problem=first), legs[1]], TimingSettings(speed=0.5))
    assert rests(legs, motion) == [1]
    middle = int(np.abs(panda.poses(motion.positions)[:, :3, 3] - seam[1][:3, 3]).sum(1).argmin())
    assert np.abs(motion.velocities[middle]).max() == 0.0


@pytest.mark.parametrize("several", [False, True])
def test_bounds_between_states_are_true(panda, seam, several):
    lines = [Line(*ends) for ends in pairs([*seam, seam[0]])] if several else Line(*seam[1:])
    rng, line = np.random.default_rng(0), AlongLine(panda, lines, 0.0, 0.0)
    for _ in range(20):
        ends = (
            START
            + rng.normal(scale=0.3, size=7)
            + np.array([[0.0], [1.0]]) * rng.normal(scale=0.05, size=7)
        )
        F = np.abs(line.residual(np.linspace(*ends, 50))).max(axis=1)
        assert F.max() <= max(F[0], F[-1]) + line.bound_between(ends)[0] + 1e-12


def test_several_lines_are_as_far_as_the_best_of_them(panda, seam):
    lines = [Line(*ends) for ends in pairs([*seam, seam[0]])]
    rng = np.random.default_rng(0)
    q = START + rng.normal(scale=0.1, size=(50, 7))
    each = [AlongLine(panda, line, 0.01, 0.05).residual(q).max(axis=1) for line in lines]
    found = AlongLine(panda, lines, 0.01, 0.05).residual(q).max(axis=1)
    np.testing.assert_allclose(found, np.min(each, axis=0), atol=1e-12)


def test_a_line_that_cannot_be_followed_is_told_with_place_and_reason(
    tmp_path, capsys, panda, seam
):
    far = seam[0].copy()
    far[:3, 3] += (0.6, 0.0, 0.0)
    wall = SceneObject("wall", Box((1.0, 0.02, 1.0)), pose(seam[0][:3, 3] + (0.0, 0.15, 0.0)))
    for poses, scene, words in (
        ([seam[0], far], Scene("free", ()), "(no posture within|joints would jump)"),
        (seam[:2], Scene("room", (wall,)), "wall"),
    ):
        told = f"from pose 0 to 1 .*of it: .*{words}"
        called(told, follow_lines, panda, scene, poses, start=START)
    (tmp_path / "p.csv").write_text("x,y,z,roll,pitch,yaw\n0.4,0,0.5,3.14,0,0\n0.4,0,0.5\n")
    assert "line 3 has 3 numbers" in refused(capsys, "follow", tmp_path / "p.csv")
    (tmp_path / "p.csv").write_text("0.4,0,0.5,3.14,0,0\n")
    assert "1 pose is no line" in refused(capsys, "follow", tmp_path / "p.csv")
    (tmp_path / "p.csv").write_text("0.4,0,0.5,3.14,0,0\n0.4,0,0.5,3.14,0,0\n")
    assert "pose 1 repeats pose 0" in refused(capsys, "follow", tmp_path / "p.csv")
    (tmp_path / "p.csv").write_text("0.4,O,0.5,3.14,0,0\n0.4,0,0.5,3.14,0,0\n")
    assert "line 1 is ['0.4', 'O'" in refused(capsys, "follow", tmp_path / "p.csv")
    (tmp_path / "p.csv").write_text("400,0,500,3.14,0,0\n")
    assert "p.csv: line 1 is 500 m away" in refused(capsys, "follow", tmp_path / "p.csv")


def test_the_command_writes_path_and_motion(tmp_path, cvqmpt):
    (tmp_path / "p.csv").write_text("0.45,-0.1,0.5,3.14,0,0\n0.45,0.1,0.5,3.14,0,0.2\n")
    out, motion = tmp_path / "path.csv", tmp_path / "motion.json"
    told = cvqmpt("follow", tmp_path / "p.csv", "--out", out, "--trajectory", motion)
    assert "certified within 2 mm and 0.01 rad of a line of 0.2 m" in told
    assert out.read_text().startswith("panda_joint1,") and len(
        json.loads(motion.read_text())["points"]
    )
