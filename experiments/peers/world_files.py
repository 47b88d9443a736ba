"""A problem's robot and obstacles as URDF, so that other planners check the same bodies.

The file has the joint axes of `Robot.kinematics` as z, a body for every convex piece of a link and
one for every obstacle, which is fixed to the world. Lengths in metres.
"""

import warnings
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from trimesh import Trimesh

from cvqmpt_lab.base.poses import rigid
from cvqmpt_lab.execution.mjcf import Body, bodies_of, numbers_text, unchecked_pairs
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Sphere

TOOL = "tool"


def urdf_of(
    robot: Robot,
    scene: Scene,
    folder: Path,
    T_hand_tool: np.ndarray,
    carried: Sequence[Attachment] = (),
) -> tuple[str, str]:
    """URDF and SRDF of robot and obstacles as text; meshes go into a folder.

    Args:
        robot: its pieces become links of their own, fixed to `link_0` to `link_n`.
        scene: its obstacles are fixed to the world, `link_0`.
        folder: where the URDF finds its STL files.
        T_hand_tool: (4, 4) pose of the frame `tool` in the first hand [m].
        carried: loads, bodies that are fixed to the link of the hand that each is fixed to.
    """
    root = Element("robot", name="arm")
    for k in range(robot.dof + 1):
        SubElement(root, "link", name=f"link_{k}")
    arm = robot.kinematics
    for j, name in enumerate(robot.joint_names):
        kind = "prismatic" if arm.prismatic[j] else "revolute"
        T = rigid(arm.rotation[j], arm.translation[j])
        joint = _joint(root, f"link_{arm.parent[j]}", f"link_{j + 1}", T, kind, name)
        SubElement(joint, "axis", xyz="0 0 1")
        limits = {"lower": repr(float(arm.lower[j])), "upper": repr(float(arm.upper[j]))}
        # a URDF must have a velocity and an effort; planners of paths do not use them
        SubElement(joint, "limit", {**limits, "velocity": "1.0", "effort": "1.0"})
    for body in bodies_of(robot, scene, carried):
        link = SubElement(root, "link", name=body.name)
        collision = SubElement(link, "collision", name=f"{body.name}_0")
        _urdf_shape(SubElement(collision, "geometry"), body, folder)
        checking = SubElement(link, "collision_checking")
        # pinocchio: the mesh is its convex hull
        SubElement(checking, "convex", name=f"{body.name}_0")
        _joint(root, f"link_{body.link}", body.name, body.T_link_body)
    row, T_link_hand = robot.end_effector_link
    SubElement(root, "link", name=TOOL)
    _joint(root, f"link_{row}", TOOL, T_link_hand @ T_hand_tool)
    srdf = Element("robot", name="arm")
    for first, second in unchecked_pairs(robot, carried):
        SubElement(srdf, "disable_collisions", link1=first, link2=second, reason="Never")
    return tostring(root, encoding="unicode"), tostring(srdf, encoding="unicode")


def _joint(
    root: Element, parent: str, child: str, T: np.ndarray, kind: str = "fixed", name: str = ""
) -> Element:
    joint = SubElement(root, "joint", name=name or f"{child}_joint", type=kind)
    # R = Rz(yaw) Ry(pitch) Rx(roll); scipy warns at a pitch of +-90 degrees that it sets yaw to 0
    with warnings.catch_warnings(action="ignore"):
        rpy = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    SubElement(joint, "origin", xyz=numbers_text(T[:3, 3]), rpy=numbers_text(rpy))
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    return joint


def _urdf_shape(geometry: Element, body: Body, folder: Path) -> None:
    match body.shape:
        case Box(size):
            SubElement(geometry, "box", size=numbers_text(np.array(size)))
        case Cylinder(radius, height):
            SubElement(geometry, "cylinder", radius=repr(radius), length=repr(height))
        case Sphere(radius):
            SubElement(geometry, "sphere", radius=repr(radius))
        case ConvexMesh(vertices):
            path = folder / f"{body.name}.stl"
            Trimesh(vertices, ConvexHull(vertices).simplices, process=False).export(path)
            SubElement(geometry, "mesh", filename=str(path))
