"""Export of a problem's robot and obstacles as URDF, so that other planners check the same bodies.

Joint axes of the file are the z axes of `Robot.kinematics`. It has a link for every convex piece of
the robot, and one for every obstacle, which is fixed to the world. Lengths are in metres.
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
from cvqmpt_lab.features.physics.mjcf import Body, bodies_of, numbers_text, unchecked_pairs
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
    """Return URDF and SRDF of robot and obstacles as text, and write meshes to a folder.

    Args:
        robot: robot, each piece of which becomes a separate link fixed to one of `link_0` to
            `link_n`.
        scene: scene, whose obstacles are fixed to the world, `link_0`.
        folder: folder for the STL files of the URDF.
        T_hand_tool: (4, 4) pose of the frame `tool` in the frame of the first hand [m].
        carried: loads; each becomes a link that is fixed to the link of its hand.
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
        # URDF requires velocity and effort, which path planners do not use
        SubElement(joint, "limit", {**limits, "velocity": "1.0", "effort": "1.0"})
    for body in bodies_of(robot, scene, carried):
        link = SubElement(root, "link", name=body.name)
        collision = SubElement(link, "collision", name=f"{body.name}_0")
        _urdf_shape(SubElement(collision, "geometry"), body, folder)
        checking = SubElement(link, "collision_checking")
        # pinocchio then uses the convex hull of the mesh
        SubElement(checking, "convex", name=f"{body.name}_0")
        _joint(root, f"link_{body.link}", body.name, body.T_link_body)
    row, T_link_hand = robot.hand()
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
