"""Robots: limits, kernel kinematics against pinocchio, and what is refused when loading."""

import pickle
import subprocess
import sys

import numpy as np
import pinocchio as pin
import pytest

from cvqmpt_lab.errors import CvqmptError, InvalidInputError, UnknownChoiceError
from cvqmpt_lab.kernels.manifold.kinematics import link_poses
from cvqmpt_lab.robot.hulls import hull_vertices
from cvqmpt_lab.robot.loading import load_robot, robot_from_source
from cvqmpt_lab.robot.loading import panda as load_panda

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
SPHERE = '<sphere radius="0.04"/>'
TWIST = 'name="twist" type="revolute"'
TWIST_AXIS = '<axis xyz="0 0 -1"/>'
MIMIC = (TWIST_AXIS, TWIST_AXIS + '<mimic joint="bend"/>')
FLAT_MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def random_configurations(robot, count, seed=0):
    return robot.random_configurations(np.random.default_rng(seed), count)


@pytest.fixture
def edited(slider_arm_urdf, tmp_path):
    """Writes the slider arm with some text replaced, and returns the path."""

    def write(*replacements, name="arm.urdf"):
        text = slider_arm_urdf.read_text()
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def refused(error, pattern, load, *args, **kwargs):
    """Assert that loading fails with one line that matches the pattern."""
    with pytest.raises(error, match=pattern) as caught:
        load(*args, **kwargs)
    assert "\n" not in str(caught.value)


def test_panda_limits_and_names(panda):
    np.testing.assert_array_equal(
        panda.lower, (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)
    )
    np.testing.assert_array_equal(panda.upper, (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973))
    assert panda.joint_names == tuple(f"panda_joint{i}" for i in range(1, 8))
    assert panda.end_effector == "panda_hand" and "panda_link0" in panda.frame_names


def test_panda_hand_pose_at_zero_is_the_data_sheet_s(panda):
    """Link lengths 0.333 + 0.316 + 0.384 - 0.107 up, 0.088 forward; the flange turns the hand by -45 degrees."""
    expected = np.diag([1.0, -1.0, -1.0, 1.0])
    cosine = np.sqrt(0.5)
    expected[:2, :2] = [[cosine, cosine], [cosine, -cosine]]
    expected[:3, 3] = (0.088, 0.0, 0.926)
    np.testing.assert_allclose(panda.pose(np.zeros(7)), expected, atol=1e-6)


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
        link, T_link_hand = robot.end_effector_link
        np.testing.assert_allclose(T[link] @ T_link_hand, robot.pose(q), atol=1e-12)
        pin.updateGeometryPlacements(robot.model, data, robot.collision_model, geometry_data, q)
        for piece, placement in zip(robot.links, geometry_data.oMg, strict=True):
            T_world_piece = T[piece.link] @ piece.T_link_geometry
            np.testing.assert_allclose(T_world_piece, placement.homogeneous, atol=1e-12, err_msg=piece.name)


def test_slider_moves_along_its_axis(slider_arm):
    assert slider_arm.joint_names == ("rail", "lift", "bend", "twist")
    assert slider_arm.kinematics.prismatic.tolist() == [True, False, False, False]
    q = np.zeros(4)
    before, after = slider_arm.pose(q), slider_arm.pose(q + (0.25, 0, 0, 0))
    rail = slider_arm.pose(q, "carriage")[:3, 1]
    np.testing.assert_allclose(after[:3, 3] - before[:3, 3], 0.25 * rail, atol=1e-12)
    np.testing.assert_allclose(after[:3, :3], before[:3, :3], atol=1e-12)


@pytest.mark.parametrize("name", ["panda", "slider_arm"])
def test_reach_is_never_exceeded(name, request):
    robot = request.getfixturevalue(name)
    rotations, translations = link_poses(robot.kinematics, random_configurations(robot, 300))
    for piece in robot.links:
        points = piece.vertices @ piece.T_link_geometry[:3, :3].T + piece.T_link_geometry[:3, 3]
        world = np.einsum("kij,nj->kni", rotations[:, piece.link], points) + translations[:, None, piece.link]
        assert np.linalg.norm(world, axis=-1).max() <= robot.reach


def test_hull_vertices_contain_round_shapes(slider_arm):
    """Prisms and boxes that stand for cylinders and spheres are circumscribed, not inscribed."""
    for item, piece in zip(slider_arm.collision_model.geometryObjects, slider_arm.links, strict=True):
        np.testing.assert_array_equal(hull_vertices(item.geometry), piece.vertices)
        if hasattr(item.geometry, "radius"):
            directions = np.random.default_rng(0).standard_normal((200, 3))
            directions[:, 2] = 0.0
            directions /= np.linalg.norm(directions, axis=1)[:, None]
            assert (piece.vertices @ directions.T).max(axis=0).min() >= item.geometry.radius


def test_joint_outside_limits_names_the_worst_joint(panda):
    assert panda.joint_outside_limits(HOME) is None
    assert panda.joint_outside_limits(panda.upper) is None
    name, amount = panda.joint_outside_limits(HOME + np.array([0, 3.0, 0, 3.0, 0, 0, 0]))
    assert name == "panda_joint4" and amount == pytest.approx(-2.356 + 3.0 + 0.0698)


def test_random_configurations_stay_inside_and_repeat(panda):
    q = random_configurations(panda, 1000)
    assert (q >= panda.lower).all() and (q <= panda.upper).all()
    np.testing.assert_array_equal(q, random_configurations(panda, 1000))


@pytest.mark.parametrize("opening", [0.0, 0.013, 0.04])
def test_finger_opening_moves_the_fingers(opening):
    robot = load_panda(opening)
    hand = robot.pose(HOME)
    for finger, sign in (("panda_leftfinger", 1.0), ("panda_rightfinger", -1.0)):
        T_hand_finger = np.linalg.inv(hand) @ robot.pose(HOME, finger)
        assert T_hand_finger[1, 3] == pytest.approx(sign * opening, abs=1e-12)


@pytest.mark.parametrize("opening", [-0.001, 0.041, np.nan])
def test_finger_opening_out_of_range(opening):
    refused(InvalidInputError, rf"finger opening {opening} m.*0 to 0\.04", load_panda, opening)


def test_robots_can_be_pickled(panda, slider_arm_urdf):
    locked = load_robot(slider_arm_urdf, "tool", locked={"rail": 0.3})
    for robot in (panda, load_panda(0.01), locked):
        copy = pickle.loads(pickle.dumps(robot))
        assert copy.source == robot.source and copy.joint_names == robot.joint_names
        q = random_configurations(robot, 1)[0]
        np.testing.assert_array_equal(copy.pose(q), robot.pose(q))


def test_the_kinematics_digest_names_what_moves_how(panda, slider_arm, slider_arm_urdf, edited):
    """The hand does not matter, a limit, an axis and a placement do, and no process sees another digest."""
    assert panda.kinematics_digest == load_panda(0.01).kinematics_digest != slider_arm.kinematics_digest
    for old, new in (
        ('upper="0.7"', 'upper="0.8"'),
        ("0.6 0 0.8", "0.8 0 0.6"),
        ("0 0.02 0.35", "0 0.02 0.36"),
    ):
        assert load_robot(edited((old, new)), "tool").kinematics_digest != slider_arm.kinematics_digest
    script = (
        f"from cvqmpt_lab.robot.loading import load_robot; print(load_robot({str(slider_arm_urdf)!r}, 'tool')"
    )
    printed = subprocess.check_output([sys.executable, "-c", f"{script}.kinematics_digest)"], text=True)
    assert printed.strip() == slider_arm.kinematics_digest == "ccce46299e68f03c312831aa827b204d"


def test_a_robot_with_package_folders_can_be_pickled(edited, tmp_path):
    (tmp_path / "meshes" / "shapes").mkdir(parents=True)
    (tmp_path / "meshes" / "shapes" / "tetrahedron.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    urdf = edited((SPHERE, '<mesh filename="package://shapes/tetrahedron.obj"/>'))
    robot = load_robot(urdf, "tool", package_dirs=(tmp_path / "meshes",))
    assert len(pickle.loads(pickle.dumps(robot)).links) == len(robot.links)


def test_locked_joint_keeps_its_value(slider_arm, slider_arm_urdf):
    locked = load_robot(slider_arm_urdf, "tool", locked={"bend": -0.4})
    assert locked.joint_names == ("rail", "lift", "twist")
    np.testing.assert_allclose(
        locked.pose(np.array([0.1, 0.2, 0.3])), slider_arm.pose(np.array([0.1, 0.2, -0.4, 0.3])), atol=1e-12
    )


def test_unknown_names_are_listed(slider_arm_urdf, panda):
    refused(UnknownChoiceError, "frame 'gripper'.*wrist, tool", load_robot, slider_arm_urdf, "gripper")
    refused(
        UnknownChoiceError,
        "lock 'slide'.*rail, lift",
        load_robot,
        slider_arm_urdf,
        "tool",
        locked={"slide": 0.0},
    )
    refused(UnknownChoiceError, "robot 'ur5'.*panda", robot_from_source, {"name": "ur5"})
    refused(InvalidInputError, "no frame 'gripper'", panda.pose, HOME, "gripper")
    refused(InvalidInputError, "'end_effector' is missing", robot_from_source, {"urdf": str(slider_arm_urdf)})


@pytest.mark.parametrize("kind", ["mimic", "floating", "continuous", "planar"])
def test_unsupported_joint_is_named_and_locking_cures_it(edited, kind):
    urdf = edited(MIMIC if kind == "mimic" else (TWIST, f'name="twist" type="{kind}"'))
    cure = {"mimic": "<mimic>", "continuous": "revolute with limits"}.get(kind, "fixed")
    pattern = (
        rf"joint 'twist' of arm.urdf is {kind}.*{cure}.*--lock twist=0, in Python locked={{'twist': 0.0}}"
    )
    refused(InvalidInputError, pattern, load_robot, urdf, "tool")
    assert load_robot(urdf, "tool", locked={"twist": 0.0}).joint_names == ("rail", "lift", "bend")


def test_missing_mesh_is_named(edited):
    urdf = edited((SPHERE, '<mesh filename="meshes/nothing.stl"/>'))
    refused(InvalidInputError, r"arm\.urdf.*nothing\.stl", load_robot, urdf, "tool")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "solid empty\nendsolid empty\n",
        pytest.param(
            FLAT_MESH,
        ),
    ],
)
def test_empty_or_flat_mesh_is_named(edited, tmp_path, text):
    name = "flat.obj" if text == FLAT_MESH else "empty.stl"
    (tmp_path / name).write_text(text)
    urdf = edited((SPHERE, f'<mesh filename="{name}"/>'))
    refused(InvalidInputError, name, load_robot, urdf, "tool")


def test_unreadable_urdf_is_named(edited, tmp_path):
    refused(InvalidInputError, r"none\.urdf.*No such file", load_robot, tmp_path / "none.urdf", "tool")
    refused(InvalidInputError, f"{tmp_path.name}.*directory", load_robot, tmp_path, "tool")
    cut = edited(("</robot>", ""))
    refused(InvalidInputError, r"arm\.urdf.*no element found", load_robot, cut, "tool")
    other = edited(("<robot ", "<root "), ("</robot>", "</root>"))
    refused(InvalidInputError, r"arm\.urdf.*not contain a valid URDF", load_robot, other, "tool")
    limits = edited(('lower="-3" upper="3"', 'lower="3" upper="3"'))
    refused(InvalidInputError, r"'twist' of arm\.urdf has limits \[3\.0, 3\.0\]", load_robot, limits, "tool")


@pytest.mark.parametrize(
    "options",
    [
        {"locked": {"mount": 0.0}},
        {"locked": {"rail": np.nan}},
        {"locked": {"rail": "wide"}},
        {"srdf": "none.srdf"},
    ],
    ids=["lock a fixed joint", "lock at NaN", "lock at a word", "missing srdf"],
)
def test_unusable_options_are_named(slider_arm_urdf, options):
    refused(CvqmptError, "mount|rail|none.srdf", load_robot, slider_arm_urdf, "tool", **options)


@pytest.mark.parametrize(
    "source",
    [
        {"name": "panda", "finger_opening": "wide"},
        {"name": "panda", "finger_opening": [0.01]},
        {"name": ["panda"]},
        {"urdf": 5, "end_effector": "tool"},
        {"urdf": "arm.urdf", "end_effector": "tool", "locked": 3},
    ],
    ids=str,
)
def test_malformed_sources_are_named(source):
    with pytest.raises(CvqmptError):
        robot_from_source(source)


def test_overlaps_at_rest_are_skipped_and_reported(edited):
    """Without an SRDF, neighbours are skipped, and so are pairs that overlap at rest."""
    wide = load_robot(edited(('size="0.02 0.06 0.02"', 'size="0.9 0.9 0.9"')), "tool")
    names = [piece.name for piece in wide.links]
    pairs = {frozenset((names[a], names[b])) for a, b in wide.self_collision_pairs}
    overlaps = {frozenset(pair) for pair in wide.resting_overlaps}
    assert frozenset(("shoulder_0", "tool_0")) in overlaps and not overlaps & pairs
    assert frozenset(("base_0", "carriage_0")) not in pairs | overlaps
