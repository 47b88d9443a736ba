"""Regions and chains against pinocchio and scipy: residual, logarithm, sampling, names."""

import json

import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.kitchen import kitchen
from cvqmpt_lab.benchmarks.place_task import SHELF_DOOR
from cvqmpt_lab.constraints.named import Region
from cvqmpt_lab.constraints.region_constraint import RegionConstraint, stack_regions
from cvqmpt_lab.constraints.task_space_region import (
    TaskSpaceRegion,
    TaskSpaceRegionChain,
    upright,
    upright_box,
)
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.articulation import take_out

KINK = 1e-3  # rows this close to a bound, or to angle pi, have no derivative
FREE = (-np.inf, np.inf)
ROBOTS = ("panda", "slider_arm", SHELF_DOOR, "indigo_drawer_top")


@pytest.fixture
def robot_and_bases(request):
    """A robot and base frames of regions; an arm with a door or drawer: its parts and a link."""
    if request.param in ROBOTS[:2]:
        return request.getfixturevalue(request.param), [None]
    item = to_plain(take_out(kitchen(), request.param)[1])
    robot = robot_from_source({"name": "panda", "articulated": item})
    parts = [frame for frame in robot.frame_names if frame.startswith(f"{request.param}/")]
    return robot, [*parts, "panda_link3"]


def random_pose(rng, spread=0.5):
    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=rng).as_matrix()
    T[:3, 3] = rng.uniform(-spread, spread, 3)
    return T


def random_region(rng, base=None):
    """Return a region with random frames and bounds.

    A third of the rows are free or bounded on one side only; every second region bounds the tilt,
    and every second one distance, radius and bearing.
    """
    centre, width = rng.uniform(-1, 1, 6), rng.uniform(0, 1, 6)
    Bw = np.stack([centre - width, centre + width], axis=1)
    Bw[rng.random((6, 2)) < 0.2] = np.inf
    Bw[:, 0] = np.where(np.isinf(Bw[:, 0]), -np.inf, Bw[:, 0])
    frames = random_pose(rng), random_pose(rng)
    tilt = rng.uniform(0.1, 2.0) if rng.random() < 0.5 else None
    more = {"tilt": tilt}
    if rng.random() < 0.5:
        more |= {"distance": (rng.uniform(0.0, 1.0), 1.0), "radius": (0.3, None)}
        more["bearing"] = rng.uniform(0.1, 2.0)
    if base:
        return TaskSpaceRegionChain(*frames, Bw, base, **more)
    return TaskSpaceRegion(*frames, Bw, **more)


def box(half, **changes):
    """Return a region of half width `half` with the axes of the world."""
    values = {"T0_w": np.eye(4), "Tw_e": np.eye(4), "Bw": np.tile((-half, half), (6, 1))}
    return TaskSpaceRegion(**(values | changes))


def displacement(region, T_world_e):
    """Return displacement x (10,) of a pose in a region, by the definition."""
    T = np.linalg.inv(region.T0_w) @ T_world_e @ np.linalg.inv(region.Tw_e)
    chord = np.linalg.norm(T[:3, 2] - (0.0, 0.0, 1.0))
    tilt = 2.0 * np.arcsin(min(0.5 * chord, 1.0))
    d = np.linalg.norm(T[:3, 3])
    chord = np.linalg.norm(T[:3, 2] + T[:3, 3] / max(d, 1e-12))
    bearing = 2.0 * np.arcsin(min(0.5 * chord, 1.0)) if d > 0.0 else 0.0
    turn = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    return np.array([*T[:3, 3], *turn, tilt, d, np.hypot(*T[:2, 3]), bearing])


def of_hand(robot, region, q):
    """Return the displacement (10,) of the hand at q in the base frame of the region."""
    base = robot.pose(q, region.base) if isinstance(region, TaskSpaceRegionChain) else np.eye(4)
    return displacement(region, np.linalg.inv(base) @ robot.pose(q))


def outside(region, x):
    """Return the signed violation of bounds by displacements (10,), for bounded rows only."""
    lower, upper = region.bounds.T
    return (np.minimum(x - lower, 0.0) + np.maximum(x - upper, 0.0))[region.bounded_rows]


def random_cases(robot, bases, count):
    """(region, q) with the rotation away from angle pi."""
    rng = np.random.default_rng(5)
    while count:
        region = random_region(rng, bases[count % len(bases)])
        q = robot.random_configurations(rng, 1)[0]
        if np.linalg.norm(of_hand(robot, region, q)[3:6]) < np.pi - KINK:
            count -= 1
            yield region, q


@pytest.mark.parametrize("robot_and_bases", ROBOTS, indirect=True)
def test_residual_is_the_signed_distance_outside(robot_and_bases):
    signs, robot = set(), robot_and_bases[0]
    for region, q in random_cases(*robot_and_bases, 200):
        residual = RegionConstraint(robot, (region,)).residual(q)
        np.testing.assert_allclose(residual, outside(region, of_hand(robot, region, q)), atol=1e-9)
        signs |= set(np.sign(residual))
    assert signs == {-1.0, 0.0, 1.0}


def test_batches_and_intersections_stack_what_each_member_says_of_each_configuration(panda):
    rng = np.random.default_rng(6)
    members = random_region(rng), upright()
    batch = panda.random_configurations(rng, 20)
    both, *each = (
        RegionConstraint(panda, regions) for regions in (members, members[:1], members[1:])
    )
    for full in (False, True):
        together = both.residual_and_jacobian(batch, full)
        alone = [[one.residual_and_jacobian(q, full) for one in each] for q in batch]
        for k in range(2):
            expected = [np.concatenate([answer[k] for answer in answers]) for answers in alone]
            np.testing.assert_array_equal(together[k], expected)
    residual, jacobian = RegionConstraint(panda, ()).residual_and_jacobian(np.zeros((3, 7)))
    assert residual.shape == (3, 0) and jacobian.shape == (3, 0, 7)


def test_bounded_rows_leave_out_what_cannot_be_violated():
    turn = (-np.pi, np.pi)
    Bw = np.array([FREE, (0, np.inf), (-np.inf, 1), turn, (-4, 4), (-np.pi, 3)])
    np.testing.assert_array_equal(box(1, Bw=Bw).bounded_rows, [1, 2, 5])
    np.testing.assert_array_equal(upright_box().bounded_rows, [4, 5])
    np.testing.assert_array_equal(upright().bounded_rows, [6])
    assert len(upright(np.pi).bounded_rows) == 0


def test_shrunken_bounds_lie_inside(panda):
    region = box(0.1, Bw=np.array([FREE, (0, 1), (2, np.inf), FREE, (0.5, 0.5), (0, 0.004)]))
    arrays = stack_regions(panda, (region,), shrink=1e-3)
    np.testing.assert_allclose(arrays.lower, [1e-3, 2.001, 0.5, 4e-4])
    np.testing.assert_allclose(arrays.upper, [0.999, np.inf, 0.5, 3.6e-3])


def test_sampled_poses_lie_inside():
    rng = np.random.default_rng(8)
    for _ in range(50):
        centre, width = rng.uniform(-0.8, 0.8, 6), rng.uniform(0, 0.8, 6)
        bounds = np.stack([centre - width, centre + width], axis=1)
        region = TaskSpaceRegion(random_pose(rng), random_pose(rng), bounds)
        x = np.array([displacement(region, T)[:6] for T in region.sample_poses(rng, 20)])
        assert (x >= region.Bw[:, 0] - 1e-9).all() and (x <= region.Bw[:, 1] + 1e-9).all()
        assert (np.ptp(x, axis=0) >= 0.5 * np.ptp(region.Bw, axis=1)).all()


def test_sampled_poses_fill_a_cone():
    """Cones of any width; large tilts are more frequent than small ones."""
    rng = np.random.default_rng(8)
    for tilt in (1e-3, 0.3, 2.5):
        bounds = np.array([(0.0, 0.1)] * 3 + [FREE, FREE, (-1.0, 2.0)])
        region = TaskSpaceRegion(random_pose(rng), random_pose(rng), bounds, tilt=tilt)
        x = np.array([displacement(region, T) for T in region.sample_poses(rng, 200)])
        lower, upper = region.bounds.T
        assert (x >= lower - 1e-9).all() and (x <= upper + 1e-9).all()
        assert (x[:, 6] > 0.5 * tilt).sum() > 110 and np.ptp(x[:, 5]) > 2.0
        assert (x[:, 3:5].min(axis=0) < 0.0).all() and (x[:, 3:5].max(axis=0) > 0.0).all()


def test_a_tilt_of_zero_is_kept_as_turns_of_zero_which_are_smooth():
    """A bound of 0 on the tilt has no derivative at 0, so it is stored as two rotations of 0."""
    region = box(1.0, tilt=0.0)
    assert region.tilt is None and "tilt" not in to_plain(region)
    np.testing.assert_array_equal(region.Bw[3:5], np.zeros((2, 2)))
    off = np.array([FREE] * 3 + [(0.1, 0.2), FREE, FREE])
    refused(r"tilt is 0, and Bw\[3\] or Bw\[4\].*leaves out 0", box, 1.0, Bw=off, tilt=0.0)
    turned_away = box(1.0, Bw=np.tile((0.5, 0.6), (6, 1)), tilt=0.1)
    refused("its tilt", turned_away.sample_poses, np.random.default_rng(0), 1)


def test_fields_are_read_only_and_free_positions_are_not_sampled():
    region = upright()
    for field in ("T0_w", "Tw_e", "Bw"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(region, field)[0, 0] = 1.0
    refused("unbounded: bound Bw rows 0-2", region.sample_poses, np.random.default_rng(0), 1)


@pytest.mark.parametrize("away", [0.0, 1e-9, 1e-6, 2e-4, 0.1])
@pytest.mark.parametrize("near", [0.0, np.pi])
def test_rotation_vectors_at_no_turn_and_at_half_a_turn(panda, near, away):
    """exp(log R) = R; for a rotation by pi, both signs of the axis are correct."""
    rng, angle = np.random.default_rng(0), abs(near - away)
    for axis in (*np.eye(3), *rng.standard_normal((20, 3))):
        turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
        q, T = panda.random_configurations(rng, 1)[0], np.eye(4)
        T[:3, :3] = turn.as_matrix().T
        region = box(0.0, T0_w=panda.pose(q) @ T)
        found = Rotation.from_rotvec(RegionConstraint(panda, (region,)).residual(q)[3:6])
        assert (found * turn.inv()).magnitude() < 1e-9


def region(data):
    return from_plain(Region, data, "constraint")


def inside(data, T_world_e):
    """Return whether an end-effector pose (4, 4) satisfies a region, by the definition."""
    r = region(data)
    x = displacement(r, T_world_e)
    return bool(((x >= r.bounds[:, 0] - 1e-9) & (x <= r.bounds[:, 1] + 1e-9)).all())


def turned(xyz, rotvec):
    T = pose(xyz)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    return T


@pytest.mark.parametrize(("name", "kind"), [("upright", upright), ("upright-box", upright_box)])
def test_a_short_form_is_the_first_field_and_what_is_written_is_read_again(name, kind):
    in_full = {name: {"tilt": 0.1, "axis": "x"}}
    assert region({name: 0.1}) == region(in_full) == kind(0.1) != kind(0.2)
    assert region(to_plain(kind(0.2), Region)) == kind(0.2)


def test_the_box_is_the_papers_constraint_and_is_written_as_before_there_were_cones():
    np.testing.assert_array_equal(upright_box(0.2).Bw[4:], [[-0.2, 0.2]] * 2)
    assert set(to_plain(upright_box(0.2))) == {"T0_w", "Tw_e", "Bw"}
    assert to_plain(upright(0.2))["tilt"] == 0.2


@pytest.mark.parametrize("axis", ["x", "-x", "y", "-y", "z", "-z"])
def test_upright_keeps_any_axis_of_the_hand_up_and_leaves_yaw_free(axis):
    """The tilt is bounded in every direction; bounds on single rotations allow larger tilts."""
    rng, fields, seen = np.random.default_rng(0), {"tilt": 0.2, "axis": axis}, set()
    zero = [region({name: {**fields, "tilt": 0.0}}) for name in ("upright", "upright-box")]
    direction = np.eye(3)["xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1)
    for _ in range(200):
        up = Rotation.align_vectors([[0, 0, 1]], [direction])[0]
        way = rng.uniform(-np.pi, np.pi)
        about = np.array([np.cos(way), np.sin(way), 0.0])
        tilt = Rotation.from_rotvec(rng.uniform(0.0, 0.5) * about)
        rotation = tilt * Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]) * up
        T = pose(rng.uniform(-1, 1, 3))
        T[:3, :3] = rotation.as_matrix()
        angle = np.arccos(np.clip((rotation.as_matrix() @ direction)[2], -1, 1))
        in_cone, in_box = inside({"upright": fields}, T), inside({"upright-box": fields}, T)
        assert in_cone == (angle <= 0.2)
        assert angle < 1.42 * 0.2 if in_box else angle > 0.63 * 0.2
        seen.add((in_cone, in_box))
        level = np.eye(4)
        level[:3, :3] = (tilt.inv() * rotation).as_matrix()
        assert all(np.abs(displacement(one, level)[one.bounded_rows]).max() < 1e-9 for one in zero)
    assert {(True, True), (False, True), (False, False)} <= seen


def test_a_fixed_orientation_leaves_the_position_free():
    data = {"fixed-orientation": {"rpy": [0.1, 0.2, 0.3], "tolerance": 0.05}}
    there = Rotation.from_euler("xyz", [0.1, 0.2, 0.3])
    assert inside(data, turned((3.0, -2.0, 1.0), there.as_rotvec()))
    off = there * Rotation.from_rotvec([0.06, 0, 0])
    assert not inside(data, turned((3.0, -2.0, 1.0), off.as_rotvec()))


def test_planes_and_lines_hold_the_position_and_leave_the_rotation_free():
    plane = {"plane": {"point": [0, 0, 0.5], "normal": [0, 3, 4], "tolerance": 0.01}}
    across, along = np.array([0.0, 0.6, 0.8]), np.array([0.0, 0.8, -0.6])
    assert inside(plane, turned((5.0, 0.0, 0.5) + 2.0 * along, [1, 2, 0]))
    assert not inside(plane, turned((0.0, 0.0, 0.5) + 0.02 * across, [0, 0, 0]))
    line = {"line": {"point": [0, 0, 0.5], "direction": [0, 3, 4], "tolerance": 0.01}}
    assert inside(line, turned((0.0, 0.0, 0.5) - 7.0 * across, [1, 2, 0]))
    assert not inside(line, turned((0.02, 0.0, 0.5), [0, 0, 0]))


@pytest.mark.parametrize("length", [1e-300, 1.0, 1e300])
def test_a_normal_may_have_any_length(length):
    with np.errstate(all="raise"):
        found = region({"plane": {"point": [0, 0, 0.5], "normal": [0, 0.6 * length, 0.8 * length]}})
    np.testing.assert_allclose(found.T0_w[:3, 2], [0.0, 0.6, 0.8], atol=1e-15)


def test_a_pose_may_leave_the_yaw_free():
    data = {"pose": {"at": {"xyz": [0.4, 0, 0.6], "rpy": [np.pi, 0, 0]}, "yaw": 3.15}}
    there = turned((0.4, 0.0, 0.6), [np.pi, 0, 0])
    assert inside(data, there)
    yawed = turned((0.4, 0, 0.6), [0, 0, 2.0]) @ np.linalg.inv(pose((0.4, 0, 0.6)))
    assert inside(data, yawed @ there)
    assert not inside(data, there @ turned((0, 0, 0), [0.1, 0, 0]))
    assert not inside(data, pose((0.0, 0.001, 0.0)) @ there)
    assert len(region({"pose": {"at": {"xyz": [0.4, 0, 0.6]}}}).bounded_rows) == 6


def test_a_camera_looks_at_a_point_and_hands_stay_on_spheres_and_cylinders(panda):
    """Each kind at the bound and beyond, also of a frame that is no hand."""
    q = np.array([0.3, -0.5, 0.2, -2.0, 0.1, 1.8, 0.4])
    for frame in ("panda_hand", "panda_link5"):
        T = panda.pose(q, frame)
        ahead, here = T[:3, 2], T[:3, 3]
        point = (here + 0.4 * ahead + 0.04 * T[:3, 0]).tolist()  # 0.1 rad off the axis
        far = float(np.hypot(0.4, 0.04))
        kinds = {
            "look-at": {"point": point, "angle": np.arctan(0.1) + 1e-9, "distance": [far, None]},
            "distance": {"bounds": [0.0, far - 1e-9], "point": point},
            "on-sphere": {"centre": point, "radius": far},
            "on-cylinder": {"direction": ahead.tolist(), "point": point, "radius": 0.04},
        }
        for name, fields in kinds.items():
            made = region({name: fields, "end_effector": frame})
            F = RegionConstraint(panda, (made,)).residual(np.array([q, q + 0.02, q - 0.02]))
            assert np.abs(F[0]).max() < 1e-8 < 1e-4 < np.abs(F[1:]).max()
            again = region(json.loads(json.dumps(to_plain(made))))
            assert again == made and made.inset(1e-4, 1e-4).bounded_rows.tolist()
    refused("cannot sample poses of a distance", made.sample_poses, np.random.default_rng(0), 1)
    refused(r"look-at: bearing is 0", region, {"look-at": {"point": point, "angle": 0.0}})
    refused("distance is .*lower <= upper", region, {"distance": [0.5, 0.4]})
    still = box(1.0, end_effector="panda_link0")
    refused("'panda_link0' stands still", still.links, panda)
