"""Drawn bodies are where the URDF has them, and where the collision bodies of their links are."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from cvqmpt_lab.base.poses import pose, rigid, rotation_of_rpy
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.features.physics.mjcf import bodies_of
from cvqmpt_lab.features.pictures.bodies import robot_bodies
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.dynamics import Dynamics
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.source import ARMS, read_source
from cvqmpt_lab.robot.urdf import read_urdf
from cvqmpt_lab.scene.coal_shapes import loads_of
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Sphere
from cvqmpt_lab.search.space import ConstrainedSpace

BASE = rigid(rotation_of_rpy(0.1, -0.2, 0.7), (0.3, -0.4, 0.5))
TOOL = rigid(rotation_of_rpy(0.4, 0.3, -1.2), (0.02, -0.05, 0.17))
LIMITS = ("acceleration_limits", "jerk_limits", "effort_limits", "torque_rate_limits")
HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
# their collision meshes have the form of the visual ones
ALIKE = ("panda", "xarm7", "finger", *(name for name in ARMS if name.startswith("ur")))
EMPTY = Scene("none", ())


class OwnKinematics:
    """Poses of the links of a robot's URDF, from its text alone."""

    def __init__(self, robot):
        root = ElementTree.parse(read_source(robot.source).urdf).getroot()
        self.links = {link.get("name"): link for link in root.findall("link")}
        self.joints = {joint.get("name"): joint for joint in root.findall("joint")}
        self.above = {joint.find("child").get("link"): joint for joint in self.joints.values()}
        self.held = {joint.name: joint.value for joint in robot.held_joints}

    def body(self, name, kind):
        """Element <visual> or <collision> of the body LINK_NUMBER."""
        link, _, number = name.rpartition("_")
        return self.links[link].findall(kind)[int(number)]

    def value(self, joint, values):
        name, mimic = joint.get("name"), joint.find("mimic")
        if name in values or name in self.held:
            return values.get(name, self.held.get(name))
        leader = self.value(self.joints[mimic.get("joint")], values)
        return float(mimic.get("multiplier", 1.0)) * leader + float(mimic.get("offset", 0.0))

    def pose(self, link, values):
        """T_root_link (4, 4); values: of the planned joints, by name."""
        joint = self.above.get(link)
        if joint is None:
            return np.eye(4)
        T = self.pose(joint.find("parent").get("link"), values) @ origin_of(joint)
        if joint.get("type") in ("fixed", "floating", "planar"):
            return T
        axis = np.array(joint.find("axis").get("xyz").split(), dtype=float)
        axis, moved = axis / np.linalg.norm(axis), self.value(joint, values)
        if joint.get("type") == "prismatic":
            return T @ pose(moved * axis)
        cross = np.cross(np.eye(3), axis)
        R = np.eye(3) + np.sin(moved) * cross + (1.0 - np.cos(moved)) * cross @ cross
        return T @ rigid(R, np.zeros(3))


def origin_of(element):
    """Pose (4, 4) of the <origin> of an element."""
    origin = element.find("origin")
    given = {} if origin is None else origin.attrib
    x, y, z = map(float, given.get("xyz", "0 0 0").split())
    return rigid(rotation_of_rpy(*map(float, given.get("rpy", "0 0 0").split())), (x, y, z))


def source_of(name):
    """Source of a named arm, its base moved, its last joint held; a tool if it has one hand."""
    source = {"name": name, "base": BASE.tolist()} | dict.fromkeys(LIMITS, 100.0)
    given = read_source(source)
    if len(given.end_effectors) == 1:
        source["tool"] = TOOL.tolist()
    chain = read_urdf(Path(given.urdf)).chain(given.end_effector)
    last = [joint for joint in chain if joint.kind in ("revolute", "continuous", "prismatic")][-1]
    return source | {"locked": {last.name: last.neutral}}


@pytest.mark.parametrize("name", ARMS)
def test_bodies_are_drawn_where_the_urdf_has_them_and_where_they_collide(name):
    robot = robot_from_source(source_of(name))
    own = OwnKinematics(robot)
    q = robot.random_configurations(np.random.default_rng(0), 1)
    values = dict(zip(robot.joint_names, q[0].tolist(), strict=True))
    drawn = robot_bodies(PlanningProblem("drawn", robot, EMPTY, q[0], q), q)
    rotations, translations = link_poses(robot.kinematics, q)
    hulls = {}
    for piece in robot.links:
        T = rigid(rotations[0, piece.link], translations[0, piece.link]) @ piece.T_link_geometry
        link = piece.name.rpartition("_")[0]
        there = BASE @ own.pose(link, values) @ origin_of(own.body(piece.name, "collision"))
        np.testing.assert_allclose(T, there, atol=1e-12, err_msg=piece.name)
        hulls.setdefault(link, []).append(piece.vertices @ T[:3, :3].T + T[:3, 3])
    assert len(drawn) >= robot.dof
    for body in drawn:
        link = body.name.rpartition("_")[0]
        kind = "collision" if own.links[link].find("visual") is None else "visual"
        there = BASE @ own.pose(link, values) @ origin_of(own.body(body.name, kind))
        np.testing.assert_allclose(body.poses[0], there, atol=1e-12, err_msg=body.name)
        if name in ALIKE and link in hulls:
            corners = body.at().corners.reshape(-1, 3)
            planes = [ConvexHull(vertices).equations for vertices in hulls[link]]
            outside = [(corners @ p[:, :3].T + p[:, 3]).max(axis=1) for p in planes]
            assert np.min(outside, axis=0).max() < 0.003, body.name


@pytest.mark.parametrize("hand", [None, "panda_hand/tool", "panda_hand"])
def test_a_load_is_drawn_checked_weighed_and_executed_where_its_hand_is(hand):
    """By default it hangs on the tool; a load of `panda_hand` hangs on the link."""
    source = {"name": "panda", "base": BASE.tolist()}
    plain, robot = (robot_from_source(each) for each in (source, source | {"tool": TOOL.tolist()}))
    T = pose((0.03, 0.02, 0.2), 0.3)
    T_link_load = T if hand == "panda_hand" else TOOL @ T
    there = plain.pose(HOME) @ T_link_load
    load = Attachment("load", Box((0.03, 0.04, 0.05)), T, mass=2.0, end_effector=hand)
    # a ball at a corner of the load
    corner = there @ [0.014, 0.019, 0.024, 1.0]
    scene = Scene("ball", (SceneObject("ball", Sphere(0.002), pose(corner[:3])),))
    problem = PlanningProblem("hung", robot, scene, HOME, HOME[None], attachments=(load,))
    drawn, executed = robot_bodies(problem, HOME[None])[-1], bodies_of(robot, scene, (load,))[-1]
    np.testing.assert_allclose(drawn.poses[0], there, atol=1e-12)
    R, t = (found[0, executed.link] for found in link_poses(robot.kinematics, HOME[None]))
    np.testing.assert_allclose(rigid(R, t) @ executed.T_link_body, there, atol=1e-12)
    assert CollisionChecker(robot, scene, (load,)).contact(HOME) == "load and ball"
    assert not CollisionChecker(robot, scene).in_collision(HOME)
    for carried in ((load,), ()):
        space = ConstrainedSpace.of(problem.changed(attachments=carried))
        assert space.valid(HOME) == (not carried)
    on_link = Attachment("load", load.shape, T_link_load, mass=2.0)
    weights = [
        Dynamics.of(each, loads_of([item])).gravity(HOME[None])
        for each, item in ((robot, load), (plain, on_link))
    ]
    np.testing.assert_allclose(*weights, atol=1e-9)
