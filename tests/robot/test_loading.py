"""Loading robots: moving and held joints, mesh paths, and errors of one line."""

import os
import pickle
import struct

import coal
import numpy as np
import pytest
import trimesh
from command_line import python
from refusals import refused, table

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import CvqmptError
from cvqmpt_lab.base.poses import Pose, rigid
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.features.motion.frame_speeds import FrameSpeeds
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import load_robot, robot_from_source, with_gripper
from cvqmpt_lab.robot.reach import USUAL_REACH_M
from cvqmpt_lab.robot.source import ARMS
from cvqmpt_lab.scene.scene import pose

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
SPHERE = '<sphere radius="0.04"/>'
TWIST = 'name="twist" type="revolute"'
TWIST_AXIS = '<axis xyz="0 0 -1"/>'
MIMIC = (TWIST_AXIS, TWIST_AXIS + '<mimic joint="bend" multiplier="-2" offset="0.1"/>')
FLAT_MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
END = "</robot>"
FINGERS = """<link name="left"/><link name="right"/>
<joint name="grip" type="prismatic"><parent link="tool"/><child link="left"/><axis xyz="0 1 0"/>
  <limit lower="0.01" upper="0.04" effort="1" velocity="1"/></joint>
<joint name="follow" type="prismatic"><parent link="tool"/><child link="right"/><axis xyz="0 1 0"/>
  <limit lower="-1" upper="1" effort="1" velocity="1"/>\
<mimic joint="grip" multiplier="-1" offset="0.002"/></joint>
</robot>"""


def binary_stl(*triangles):
    """A binary STL file of triangles (3, 3)."""
    rows = (struct.pack("<12fH", 0, 0, 0, *np.ravel(corners), 0) for corners in triangles)
    return b"\0" * 80 + struct.pack("<I", len(triangles)) + b"".join(rows)


def test_a_tool_is_a_frame_of_its_own_and_the_link_stays(panda, edited):
    """The hand is the tool; the name of the link means the link, in regions and speed limits."""
    tool = {"xyz": [0.0, 0.02, 0.1], "rpy": [0.0, 0.0, 0.5]}
    robot = robot_from_source({"name": "panda", "tool": tool})
    link = panda.pose(HOME)
    T = link @ from_plain(Pose, tool, "tool")
    assert list(robot.end_effectors) == [robot.end_effector] == ["panda_hand/tool"]
    for name, there in ((None, T), ("panda_hand/tool", T), ("panda_hand", link)):
        np.testing.assert_allclose(robot.pose(HOME, name), there, atol=1e-12)
        region = TaskSpaceRegion(there, np.eye(4), np.zeros((6, 2)), end_effector=name)
        (_, (row, T_row_e)) = region.links(robot)
        rotations, translations = link_poses(robot.kinematics, HOME[None])
        found = rigid(rotations[0, row], translations[0, row]) @ T_row_e
        np.testing.assert_allclose(found, there, atol=1e-12)
        assert robot.frame(name) is robot.hand(name)
    assert robot.notes[-1] == (
        "the hand is panda_hand/tool, a tool at 0 0.02 0.1 m of panda_hand: constraint, goals and "
        "loads refer to it; the name panda_hand means the link"
    )
    limits = {name: {"speed": 0.25} for name in ("panda_hand", "panda_hand/tool")}
    limited = robot_from_source({"name": "panda", "tool": tool, "frame_limits": limits})
    rates = np.eye(7)[6:]
    about_hand, about_tool = FrameSpeeds(limited).speeds(HOME[None], rates)[0]
    assert about_hand == pytest.approx(0.0, abs=1e-9) and about_tool == pytest.approx(0.02)
    behind = robot_from_source({"name": "panda", "tool": {"xyz": [0.0, 0.0, -0.1]}})
    assert (behind.levers(0.3) >= panda.levers(0.3)).all() and behind.reach >= panda.reach
    assert with_gripper(robot).joint_names == with_gripper(panda).joint_names
    taken = edited(
        ('"tool"', '"hand"'),
        (
            END,
            '<link name="hand/tool"/><joint name="more" '
            'type="fixed"><parent link="hand"/><child link="hand/tool"/></joint></robot>',
        ),
    )
    refused("a frame 'hand/tool' already.*rename", load_robot, taken, "hand", tool=np.eye(4))
    several = {"name": "baxter", "end_effectors": ["left_gripper", "right_gripper"], "tool": tool}
    refused("robot.tool belongs to one end effector", robot_from_source, several)
    flat = {"name": "panda", "tool": np.diag([1.0, 1.0, 0.0, 1.0]).tolist()}
    refused("robot.tool is not a rigid pose", robot_from_source, flat)


def test_unusable_options_and_files_are_named(slider_arm_urdf, edited, tmp_path, panda):
    refused("frame of robot panda 'gripper'", panda.pose, HOME, "gripper")
    refused(r"none\.urdf.*No such file", load_robot, tmp_path / "none.urdf", "tool")
    refused(f"{tmp_path.name}.*directory", load_robot, tmp_path, "tool")
    texts = {"empty.stl": "", "solid.stl": "solid empty\nendsolid empty\n"}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    for name in ("nothing.stl", *texts):
        refused(name, load_robot, edited((SPHERE, f'<mesh filename="{name}"/>')), "tool")
    urdf = str(edited((SPHERE, '<mesh filename="file:///nothing.stl"/>')))
    source = {"urdf": urdf, "end_effector": "tool"}
    refused("--skip-missing-meshes plans without it", robot_from_source, source)
    robot = robot_from_source({**source, "skip_missing_meshes": True})
    assert "whose collision mesh is missing" in robot.notes[-1]


def test_the_unit_of_a_collada_mesh_counts_before_the_scale_in_the_urdf(edited, tmp_path):
    data = trimesh.creation.box((20.0, 30.0, 40.0)).export(file_type="dae")
    for unit in ("0.01", "0", "inch"):
        stated = b'<unit meter="%b"/><up_axis>' % unit.encode()
        (tmp_path / f"{unit}.dae").write_bytes(data.replace(b"<up_axis>", stated))
    robot = load_robot(edited((SPHERE, '<mesh filename="0.01.dae" scale="0.5 0.5 -1"/>')), "tool")
    sizes = [np.ptp(piece.vertices, axis=0) for piece in robot.links]
    assert any(np.allclose(size, (0.1, 0.15, 0.4)) for size in sizes)
    for unit in ("0", "inch"):
        urdf = edited((SPHERE, f'<mesh filename="{unit}.dae"/>'))
        refused(f"mesh '{unit}.dae': its unit is '{unit}' m", load_robot, urdf, "tool")


def test_joints_off_the_chain_are_held_and_followers_follow(edited):
    """Fingers are not planned: the first is held within its limits, the second mimics it."""
    robot = load_robot(edited((END, FINGERS)), "tool")
    assert robot.joint_names == ("rail", "lift", "bend", "twist")
    held = {joint.name: (joint.value, joint.reason) for joint in robot.held_joints}
    assert held["grip"] == (0.01, "not between the base and the end effector")
    assert held["follow"] == (pytest.approx(-0.008), "mimics grip")
    closed = load_robot(edited((END, FINGERS)), "tool", locked={"grip": 0.03})
    q = np.zeros(4)
    for finger, width in (("left", 0.03), ("right", 0.028)):
        apart = closed.pose(q, finger)[:3, 3] - closed.pose(q, "tool")[:3, 3]
        assert np.linalg.norm(apart) == pytest.approx(width)


def test_a_continuous_joint_turns_once_either_way(edited):
    limit = '<limit lower="-3" upper="3" effort="1" velocity="1"/>'
    continuous = (TWIST, TWIST.replace("revolute", "continuous"))
    for urdf in (edited(continuous), edited(continuous, (limit, ""))):
        robot = load_robot(urdf, "tool")
        assert (robot.lower[3], robot.upper[3]) == (-2.0 * np.pi, 2.0 * np.pi)
        q = np.array([0.1, 0.2, -0.3, 4.0])
        turned = load_robot(urdf, "tool", locked={"twist": 4.0})
        assert turned.joint_names == ("rail", "lift", "bend")
        np.testing.assert_allclose(turned.pose(q[:3]), robot.pose(q), atol=1e-12)


@pytest.mark.parametrize(("name", "value"), [("rail", 30.0), ("lift", -2.1)])
def test_joints_are_not_locked_outside_their_limits(edited, name, value):
    """A slider that was locked in millimetres moved its links out of the robot's reach."""
    message = (
        rf"joint '{name}' cannot be locked at {value:g}, outside its limits \[.*: give a value"
    )
    refused(message, load_robot, edited(), "tool", locked={name: value})


def test_all_joints_that_cannot_be_planned_for_are_named_with_their_options(edited):
    urdf = edited(
        ('name="lift" type="revolute"', 'name="lift" type="floating"'),
        ('name="bend" type="revolute"', 'name="bend" type="planar"'),
        ('lower="-0.5" upper="0.7"', 'lower="0.7" upper="0.7"'),
        MIMIC,
    )
    pattern = (
        r"'rail' has limits \[0.7, 0.7\], 'lift' is floating, 'bend' is planar; hold them: --lock "
        r"rail=0.7 --lock lift=0 --lock bend=0, or place"
    )
    refused(pattern, load_robot, urdf, "tool")
    locked = {"rail": 0.7, "lift": 0.0, "bend": 0.0}
    refused("no joint of arm.urdf moves 'tool'", load_robot, urdf, "tool", locked=locked)


def test_a_floating_base_is_fixed_at_a_pose(edited):
    float_on = f'{EARTH}<child link="base"/></joint></robot>'
    urdf, plain = edited((END, float_on)), edited(name="plain.urdf")
    place = pose((1.0, 2.0, 0.5), 0.7)
    refused("'float' is floating.*--lock float=0", load_robot, urdf, "tool")
    robot, there = (load_robot(file, "tool", base=place) for file in (urdf, plain))
    q = np.array([0.1, 0.2, -0.3, 0.4])
    expected = place @ load_robot(plain, "tool").pose(q)
    for other in (robot, there, robot_from_source(robot.source)):
        np.testing.assert_allclose(other.pose(q), expected, atol=1e-12)
        np.testing.assert_allclose(other.pose(q, "base"), place, atol=1e-12)
    assert robot.reach > load_robot(plain, "tool").reach + 1.0


def test_hulls_are_the_same_from_the_cache_which_is_written_anew_if_broken(
    edited, tmp_path, monkeypatch
):
    """Hulls of coal agree bit for bit, and the second load reads no mesh."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    trimesh.creation.icosphere(radius=0.05).export(tmp_path / "part.stl")
    mesh = '<mesh filename="part.stl" scale="1 1 -2"/>'
    urdf = edited((SPHERE, mesh), (BOX, f"<geometry>{mesh}</geometry>"))

    def hulls():
        pieces = load_robot(urdf, "tool").collision_model.geometryObjects
        shapes = [item.geometry for item in pieces if isinstance(item.geometry, coal.Convex)]
        assert len(shapes) == 2
        return [shape.saveToString() for shape in shapes]

    made = hulls()
    (kept,) = (tmp_path / "cache" / "cvqmpt_lab" / "hulls").iterdir()
    whole = kept.read_bytes()
    with monkeypatch.context() as patch:
        patch.delattr(coal, "MeshLoader")
        assert hulls() == made
    with np.load(kept) as arrays:
        known = dict(arrays)
    points, corners = known["0 points"], known["0 corners"]
    foreign = [{"0 points": points}, {**known, "0 points": points[:9]}, {"0 points": np.array(1.0)}]
    foreign += [{**known, "0 corners": -corners}, {**known, "0 points": points * np.nan}]
    for content in (b"", b"PK nothing", whole[:-900], *foreign):
        if isinstance(content, bytes):
            kept.write_bytes(content)
        else:
            np.savez(kept, **content)
        assert hulls() == made and kept.read_bytes() == whole


def test_a_robot_whose_files_changed_is_built_anew_and_its_pickles_are_refused(edited, tmp_path):
    """Changed content of URDF, mesh or SRDF rebuilds the robot; a changed file time does not."""
    urdf = edited((BOX, '<geometry><mesh filename="part.obj"/></geometry>'))
    mesh, srdf = tmp_path / "part.obj", tmp_path / "arm.srdf"
    trimesh.creation.box((0.1, 0.1, 0.1)).export(mesh)
    srdf.write_text("<robot/>")
    source = load_robot(urdf, "tool", srdf=srdf).source
    for file, old, new in (
        (urdf, 'upper="0.7"', 'upper="0.6"'),
        (mesh, "0.05", "0.06"),
        (srdf, "<robot/>", '<robot><disable_collisions link1="base" link2="tool"/></robot>'),
    ):
        robot = robot_from_source(source)
        kept = pickle.dumps(robot)
        file.write_text(file.read_text())
        os.utime(file, (1.0, 1.0))
        assert robot_from_source(source) is robot is pickle.loads(kept)
        file.write_text(file.read_text().replace(old, new))
        again = robot_from_source(source)
        assert again is not robot and again is robot_from_source(source)
        refused(f"pickled before a change of its file {file}", pickle.loads, kept)
    assert again.upper[0] == 0.6 and len(again.left_out_pairs) == 1
    assert np.abs(again.links[1].vertices).max() == pytest.approx(0.06)


EARTH = '<link name="earth"/><joint name="float" type="floating"><parent link="earth"/>'
BOX = '<geometry><box size="0.1 0.12 0.08"/></geometry>'


def test_a_file_that_is_no_robot_is_refused_with_one_line(edited, capfd):
    for row in table("wrong_urdfs"):
        urdf = edited((row["was"], row["now"]))
        refused(row["pattern"], load_robot, urdf, "tool", error=CvqmptError)
    assert capfd.readouterr() == ("", ""), "pinocchio's parser, which prints, must not run"


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0.5, 0]], dtype=float)


def fan(last):
    corners = np.vstack([CORNERS[:4], last])
    return corners[[0, 1, 2]], corners[[1, 3, 2]], corners[[0, 1, 4]]


LOADING = """import sys
from cvqmpt_lab.robot.load import load_robot
try: load_robot(sys.argv[1], "tool")
except Exception as e: print(type(e).__name__, e)"""


FLAT = [(fan((0.5, 0.5, height)), "") for height in (0.0, 1e-12)]
FAR = [(fan((0, 0, height)), f"{height} m") for height in (1e30, np.nan)]
SMALL = [([corner * 1e-6 for corner in fan((0.5, 0.5, 0.5))], "m thick")]


@pytest.mark.parametrize(("mesh", "pattern"), [*FLAT, *FAR, *SMALL])
def test_a_mesh_without_a_hull_ends_in_one_line_not_in_the_process(edited, tmp_path, mesh, pattern):
    """In a separate process: the hull of a flat mesh once crashed it."""
    (tmp_path / "m.stl").write_bytes(binary_stl(*mesh))
    urdf = edited((SPHERE, '<mesh filename="m.stl"/>'))
    printed = python(LOADING, urdf)
    if not pattern:  # a flat mesh gets a thickness
        assert not printed
        return
    assert printed.startswith("InvalidInputError collision mesh")
    assert "m.stl" in printed and pattern in printed


def test_a_mesh_is_found_in_package_folders_and_in_ros_s(edited, tmp_path, monkeypatch):
    package = tmp_path / "elsewhere" / "shapes"
    package.mkdir(parents=True)
    (package / "ball.stl").write_bytes(binary_stl(CORNERS[:3], [[0, 0, 0], [1, 0, 0], [0, 0, 1]]))
    urdf = edited((SPHERE, '<mesh filename="package://shapes/ball.stl"/>'))
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    unset = r"ROS_PACKAGE_PATH \(not set\), AMENT_PREFIX_PATH \(not set\)"
    told = (
        rf"no folder is called shapes, .* --package-dir \(not given\), {unset}, the folders above"
    )
    refused(f"shapes/ball.stl is not found: {told}", load_robot, urdf, "tool")
    for folder in (package.parent, package):
        assert load_robot(urdf, "tool", package_dirs=(folder,)).dof == 4
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere:{package.parent}")
    assert load_robot(urdf, "tool").dof == 4
    source = {"urdf": str(urdf), "end_effector": "tool"}
    assert robot_from_source(source).dof == 4
    monkeypatch.delenv("ROS_PACKAGE_PATH")
    refused("no folder is called shapes", robot_from_source, source)
    (package.parent / "share").mkdir()
    package.rename(package.parent / "share" / "shapes")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{package.parent}")
    assert robot_from_source(source).dof == 4


def test_a_package_is_found_by_the_name_in_its_package_xml(edited, tmp_path, monkeypatch):
    """Clones of a repository are often called otherwise than the package that they hold."""
    for name in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(name, raising=False)
    package = tmp_path / "work" / "src" / "clone"
    package.mkdir(parents=True)
    (package / "package.xml").write_text("<package><name>shapes</name></package>")
    (package / "ball.stl").write_bytes(binary_stl(CORNERS[:3], [[0, 0, 0], [1, 0, 0], [0, 0, 1]]))
    mesh = '<mesh filename="package://shapes/ball.stl"/>'
    urdf = edited((SPHERE, mesh))
    refused("no folder is called shapes", load_robot, urdf, "tool")
    for folder in (package, package.parent, package.parent.parent):
        assert load_robot(urdf, "tool", package_dirs=(folder,)).dof == 4
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(package.parent.parent))
    assert load_robot(urdf, "tool").dof == 4
    monkeypatch.delenv("ROS_PACKAGE_PATH")
    inside = edited((SPHERE, mesh), name="work/src/clone/arm.urdf")
    assert load_robot(inside, "tool").dof == 4
    (package / "ball.stl").rename(package / "other.stl")
    told = "package shapes is .*/clone, without ball.stl; give --package-dir DIR"
    refused(told, load_robot, inside, "tool")


def test_a_mesh_that_is_an_archive_is_refused(edited, tmp_path):
    """Archives of meshes, such as 3MF, have no bound on their size when they are unpacked."""
    (tmp_path / "ball.3mf").write_bytes(b"PK\3\4")
    urdf = edited((SPHERE, '<mesh filename="ball.3mf"/>'))
    refused("arm.urdf: mesh 'ball.3mf' is a zip archive; give an STL", load_robot, urdf, "tool")


def test_xml_is_read_as_programs_of_ros_read_it(edited, slider_arm):
    """A default namespace, prefixes that are not bound and blanks before the declaration."""
    plain = '<robot name="slider_arm">'
    more = "<gazebo:plugin gz:version='1'/><transmission/>"
    for number, replacements in enumerate(
        (
            [(plain, f'<robot name="slider_arm" xmlns="http://example.org/urdf">{more}')],
            [("<?xml", "\n  <?xml"), (plain, plain + more)],
            [("<?xml", "\ufeff<?xml")],
            [("<?xml", "<!-- A licence <?xml -->\n<!-- and more -->\n<?xml")],
        )
    ):
        robot = load_robot(edited(*replacements, name=f"{number}.urdf"), "tool")
        assert robot.joint_names == slider_arm.joint_names
        assert robot.kinematics_digest == slider_arm.kinematics_digest
    srdf = edited((plain, plain), name="arm.srdf")
    srdf.write_text('\n<?xml version="1.0"?><robot name="a" xmlns="http://example.org/srdf"/>')
    assert load_robot(edited(name="0.urdf"), "tool", srdf=srdf).dof == slider_arm.dof


@pytest.mark.parametrize(
    "pairs", ['<xacro:arm prefix="a"/>', '<disable_collisions link1="${prefix}base" link2="tool"/>']
)
def test_an_srdf_with_elements_of_xacro_is_refused(edited, tmp_path, pairs):
    """Its pairs of links were left out, and robots collided with themselves everywhere."""
    srdf = tmp_path / "arm.srdf"
    srdf.write_text(f'<robot name="slider_arm">{pairs}</robot>')
    told = r"arm.srdf has unexpanded elements of xacro, <.*: xacro arm.srdf > expanded.srdf"
    refused(told, load_robot, edited(), "tool", srdf=srdf)


def test_options_given_with_the_name_of_an_arm_override_those_of_the_arm():
    for name in ("ur5", "xarm7", "so-arm", "talos-left-arm"):
        robot = robot_from_source({"name": name})
        assert robot.end_effector == ARMS[name].end_effector and 5 <= robot.dof <= 8
        assert (robot.upper > robot.lower).all() and 0.4 < robot.reach < USUAL_REACH_M
        states = robot.random_configurations(np.random.default_rng(0), 20)
        assert all(np.linalg.norm(robot.pose(q)[:3, 3]) <= robot.reach for q in states)
    source = {"name": "ur5", "locked": {"elbow_joint": 1.0}, "end_effector": "ee_link"}
    robot = robot_from_source(source | {"acceleration_limits": 3.0})
    assert robot.source == source | {"acceleration_limits": 3.0}
    assert robot.end_effector == "ee_link" and robot.limits["acceleration"].tolist() == [3.0] * 5
