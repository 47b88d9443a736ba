"""A problem's robot and obstacles as URDF and MJCF, so that other planners check the same bodies.

Both files have the joint axes of `Robot.kinematics` as z, a body for every convex piece of a link
and one for every obstacle, which is fixed to the world. Lengths in metres.
"""

import warnings
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from trimesh import Trimesh

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Shape, Sphere

HAND, TOOL = "hand", "tool"


class Body(NamedTuple):
    """A convex body, fixed to a link."""

    name: str
    link: int  # pose row that carries it, 0: the world
    T_link_body: np.ndarray  # (4, 4)
    shape: Shape


def bodies_of(robot: Robot, scene: Scene) -> list[Body]:
    """The robot's pieces in the order of `Robot.links`, then the obstacles.

    Raises InvalidInputError for an obstacle that is no convex solid.
    """
    found = [
        Body(f"piece_{k}", piece.link, piece.T_link_geometry, ConvexMesh(piece.vertices))
        for k, piece in enumerate(robot.links)
    ]
    for k, item in enumerate(scene.obstacles):
        if not isinstance(item.shape, Box | Cylinder | Sphere | ConvexMesh):
            raise InvalidInputError(
                f"obstacle {item.name!r} is of type {type(item.shape).__name__}: give boxes, "
                "cylinders, spheres or convex meshes"
            )
        found.append(Body(f"obstacle_{k}", 0, item.T_world_object, item.shape))
    return found


def unchecked_pairs(robot: Robot) -> Iterator[tuple[str, str]]:
    """Pairs of the robot's bodies that are not checked against each other, by name."""
    checked = {frozenset(pair) for pair in robot.self_collision_pairs}
    for pair in combinations(range(len(robot.links)), 2):
        if frozenset(pair) not in checked:
            yield f"piece_{pair[0]}", f"piece_{pair[1]}"


def urdf_of(robot: Robot, scene: Scene, folder: Path, T_hand_tool: np.ndarray) -> tuple[str, str]:
    """URDF and SRDF of robot and obstacles as text; meshes go into a folder.

    Args:
        robot: its pieces become links of their own, fixed to `link_0` to `link_n`.
        scene: its obstacles are fixed to the world, `link_0`.
        folder: where the URDF finds its STL files.
        T_hand_tool: (4, 4) pose of the frame `tool` in the hand [m].
    """
    root = Element("robot", name="arm")
    for k in range(robot.dof + 1):
        SubElement(root, "link", name=f"link_{k}")
    arm = robot.kinematics
    for j, name in enumerate(robot.joint_names):
        kind = "prismatic" if arm.prismatic[j] else "revolute"
        joint = _joint(
            root,
            f"link_{arm.parent[j]}",
            f"link_{j + 1}",
            arm.rotation[j],
            arm.translation[j],
            kind,
            name,
        )
        SubElement(joint, "axis", xyz="0 0 1")
        limits = {"lower": repr(float(arm.lower[j])), "upper": repr(float(arm.upper[j]))}
        # a URDF must have a velocity and an effort; planners of paths do not use them
        SubElement(joint, "limit", {**limits, "velocity": "1.0", "effort": "1.0"})
    for body in bodies_of(robot, scene):
        link = SubElement(root, "link", name=body.name)
        collision = SubElement(link, "collision", name=f"{body.name}_0")
        _urdf_shape(SubElement(collision, "geometry"), body, folder)
        checking = SubElement(link, "collision_checking")
        # pinocchio: the mesh is its convex hull
        SubElement(checking, "convex", name=f"{body.name}_0")
        T = body.T_link_body
        _joint(root, f"link_{body.link}", body.name, T[:3, :3], T[:3, 3])
    row, T_link_hand = robot.end_effector_link
    SubElement(root, "link", name=TOOL)
    T = T_link_hand @ T_hand_tool
    _joint(root, f"link_{row}", TOOL, T[:3, :3], T[:3, 3])
    srdf = Element("robot", name="arm")
    for first, second in unchecked_pairs(robot):
        SubElement(srdf, "disable_collisions", link1=first, link2=second, reason="Never")
    return tostring(root, encoding="unicode"), tostring(srdf, encoding="unicode")


def _joint(
    root: Element,
    parent: str,
    child: str,
    rotation: np.ndarray,
    translation: np.ndarray,
    kind: str = "fixed",
    name: str = "",
) -> Element:
    joint = SubElement(root, "joint", name=name or f"{child}_joint", type=kind)
    # R = Rz(yaw) Ry(pitch) Rx(roll); scipy warns at a pitch of +-90 degrees that it sets yaw to 0
    with warnings.catch_warnings(action="ignore"):
        rpy = Rotation.from_matrix(rotation).as_euler("xyz")
    SubElement(joint, "origin", xyz=_numbers(translation), rpy=_numbers(rpy))
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    return joint


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


def _urdf_shape(geometry: Element, body: Body, folder: Path) -> None:
    match body.shape:
        case Box(size):
            SubElement(geometry, "box", size=_numbers(np.array(size)))
        case Cylinder(radius, height):
            SubElement(geometry, "cylinder", radius=repr(radius), length=repr(height))
        case Sphere(radius):
            SubElement(geometry, "sphere", radius=repr(radius))
        case ConvexMesh(vertices):
            path = folder / f"{body.name}.stl"
            Trimesh(vertices, ConvexHull(vertices).simplices, process=False).export(path)
            SubElement(geometry, "mesh", filename=str(path))


def mjcf_of(robot: Robot, scene: Scene) -> str:
    """MJCF of robot and obstacles as text; the hand is a site."""
    root = Element("mujoco", model="arm")
    SubElement(root, "compiler", angle="radian", autolimits="true")
    assets = SubElement(root, "asset")
    links = [SubElement(root, "worldbody")]
    arm = robot.kinematics
    for j, name in enumerate(robot.joint_names):
        link = _placed(links[arm.parent[j]], f"link_{j + 1}", arm.rotation[j], arm.translation[j])
        kind = "slide" if arm.prismatic[j] else "hinge"
        limits = _numbers(np.r_[arm.lower[j], arm.upper[j]])
        SubElement(link, "joint", name=name, type=kind, axis="0 0 1", range=limits)
        SubElement(link, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
        links.append(link)
    for body in bodies_of(robot, scene):
        T = body.T_link_body
        part = _placed(links[body.link], body.name, T[:3, :3], T[:3, 3])
        _mjcf_shape(part, assets, body)
    row, T_link_hand = robot.end_effector_link
    _placed(links[row], HAND, T_link_hand[:3, :3], T_link_hand[:3, 3], "site")
    contact = SubElement(root, "contact")
    for first, second in unchecked_pairs(robot):
        SubElement(contact, "exclude", body1=first, body2=second)
    return tostring(root, encoding="unicode")


def _placed(
    parent: Element,
    name: str,
    rotation: np.ndarray,
    translation: np.ndarray,
    tag: str = "body",
) -> Element:
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    quaternion = _numbers(np.array([w, x, y, z]))
    return SubElement(parent, tag, name=name, pos=_numbers(translation), quat=quaternion)


def _mjcf_shape(part: Element, assets: Element, body: Body) -> None:
    name = f"{body.name}_geom"
    match body.shape:
        case Box(size):
            SubElement(part, "geom", name=name, type="box", size=_numbers(0.5 * np.array(size)))
        case Cylinder(radius, height):
            sizes = _numbers(np.array([radius, 0.5 * height]))
            SubElement(part, "geom", name=name, type="cylinder", size=sizes)
        case Sphere(radius):
            SubElement(part, "geom", name=name, type="sphere", size=repr(radius))
        case ConvexMesh(vertices):
            SubElement(
                assets, "mesh", name=body.name, vertex=_numbers(vertices.ravel()), inertia="convex"
            )
            SubElement(part, "geom", name=name, type="mesh", mesh=body.name)
