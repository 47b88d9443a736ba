"""A problem's robot and obstacles as URDF and MJCF, so that other planners check the same bodies
against each other.

Both files have the joint axes of `Robot.kinematics` as z, a body for every convex piece of a link
and one for every obstacle, which is fixed to the world. Lengths in metres.
"""

import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Shape, Sphere

HAND, TOOL = "hand", "tool"
UPTURNED = 1e-9  # cosine of a pitch that is 90 degrees
# velocity and effort in the URDF, which asks for them; planners of paths do not use them
TURNING = 1.0


class Body(NamedTuple):
    """A convex body, fixed to a link."""

    name: str
    link: int  # pose row that carries it, 0: the world
    T_link_body: np.ndarray  # (4, 4)
    shape: Shape


def bodies_of(problem: PlanningProblem) -> list[Body]:
    """The robot's pieces in the order of `Robot.links`, then the obstacles;
    InvalidInputError for what is no solid.
    """
    if problem.attachments:
        raise InvalidInputError(
            f"the hand carries {problem.attachments[0].name!r}: it must be empty"
        )
    found = [
        Body(f"piece_{k}", piece.link, piece.T_link_geometry, ConvexMesh(piece.vertices))
        for k, piece in enumerate(problem.robot.links)
    ]
    for k, item in enumerate(problem.scene.obstacles):
        if not isinstance(item.shape, Box | Cylinder | Sphere | ConvexMesh):
            raise InvalidInputError(
                f"obstacle {item.name!r} is of type {type(item.shape).__name__}: give boxes, "
                f"cylinders, spheres or "
                "convex meshes"
            )
        found.append(Body(f"obstacle_{k}", 0, item.T_world_object, item.shape))
    return found


def unchecked_pairs(problem: PlanningProblem) -> Iterator[tuple[str, str]]:
    """Pairs of the robot's bodies that are not checked against each other, by name."""
    checked = {frozenset(pair) for pair in problem.robot.self_collision_pairs}
    for pair in combinations(range(len(problem.robot.links)), 2):
        if frozenset(pair) not in checked:
            yield f"piece_{pair[0]}", f"piece_{pair[1]}"


def urdf_of(problem: PlanningProblem, folder: Path, T_hand_tool: np.ndarray) -> tuple[str, str]:
    """URDF and SRDF of robot and obstacles, with a frame (4, 4) in the hand, as text;
    meshes go into a folder.
    """
    root = ElementTree.Element("robot", name="arm")
    for k in range(problem.robot.dof + 1):
        ElementTree.SubElement(root, "link", name=f"link_{k}")
    for j, name in enumerate(problem.robot.joint_names):
        _moving_joint(root, problem.robot, j, name)
    for body in bodies_of(problem):
        link = ElementTree.SubElement(root, "link", name=body.name)
        collision = ElementTree.SubElement(link, "collision", name=f"{body.name}_0")
        _urdf_shape(ElementTree.SubElement(collision, "geometry"), body, folder)
        checking = ElementTree.SubElement(link, "collision_checking")
        # pinocchio: the mesh is its convex hull
        ElementTree.SubElement(checking, "convex", name=f"{body.name}_0")
        _fixed_joint(root, f"link_{body.link}", body.name, body.T_link_body)
    row, T_link_hand = problem.robot.end_effector_link
    ElementTree.SubElement(root, "link", name=TOOL)
    _fixed_joint(root, f"link_{row}", TOOL, T_link_hand @ T_hand_tool)
    srdf = ElementTree.Element("robot", name="arm")
    for first, second in unchecked_pairs(problem):
        ElementTree.SubElement(
            srdf, "disable_collisions", link1=first, link2=second, reason="Never"
        )
    return ElementTree.tostring(root, encoding="unicode"), ElementTree.tostring(
        srdf, encoding="unicode"
    )


def _moving_joint(root: ElementTree.Element, robot: Robot, j: int, name: str) -> None:
    arm = robot.kinematics
    kind = "prismatic" if arm.prismatic[j] else "revolute"
    joint = ElementTree.SubElement(root, "joint", name=name, type=kind)
    _origin(joint, arm.rotation[j], arm.translation[j])
    ElementTree.SubElement(joint, "parent", link=f"link_{arm.parent[j]}")
    ElementTree.SubElement(joint, "child", link=f"link_{j + 1}")
    ElementTree.SubElement(joint, "axis", xyz="0 0 1")
    limits = {"lower": repr(float(arm.lower[j])), "upper": repr(float(arm.upper[j]))}
    ElementTree.SubElement(
        joint, "limit", {**limits, "velocity": str(TURNING), "effort": str(TURNING)}
    )


def _fixed_joint(root: ElementTree.Element, parent: str, child: str, T: np.ndarray) -> None:
    joint = ElementTree.SubElement(root, "joint", name=f"{child}_joint", type="fixed")
    _origin(joint, T[:3, :3], T[:3, 3])
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)


def _origin(element: ElementTree.Element, rotation: np.ndarray, translation: np.ndarray) -> None:
    ElementTree.SubElement(
        element, "origin", xyz=_numbers(translation), rpy=_numbers(_rpy(rotation))
    )


def _rpy(rotation: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw [rad] of a rotation (3, 3): R = Rz(yaw) Ry(pitch) Rx(roll);
    yaw 0 at a pitch of +-90 degrees.
    """
    across = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], across)
    if across < UPTURNED:
        return np.array([np.arctan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    return np.array([np.arctan2(rotation[2, 1], rotation[2, 2]), pitch, yaw])


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


def _urdf_shape(geometry: ElementTree.Element, body: Body, folder: Path) -> None:
    match body.shape:
        case Box(size):
            ElementTree.SubElement(geometry, "box", size=_numbers(np.array(size)))
        case Cylinder(radius, height):
            ElementTree.SubElement(geometry, "cylinder", radius=repr(radius), length=repr(height))
        case Sphere(radius):
            ElementTree.SubElement(geometry, "sphere", radius=repr(radius))
        case ConvexMesh(vertices):
            path = folder / f"{body.name}.stl"
            path.write_bytes(_stl(vertices))
            ElementTree.SubElement(geometry, "mesh", filename=str(path))


def _stl(points: np.ndarray) -> bytes:
    """The convex hull of points (n, 3) as a binary STL."""
    hull = ConvexHull(points)
    triangles = points[hull.simplices]  # (f, 3, 3), turned so that normals point outwards
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inwards = np.einsum("fi,fi->f", normals, hull.equations[:, :3]) < 0.0
    triangles[inwards] = triangles[inwards][:, ::-1]
    records = np.zeros(len(triangles), dtype=[("floats", "<f4", 12), ("attribute", "<u2")])
    records["floats"] = np.concatenate([hull.equations[:, :3], triangles.reshape(-1, 9)], axis=1)
    return bytes(80) + struct.pack("<I", len(triangles)) + records.tobytes()


def mjcf_of(problem: PlanningProblem) -> str:
    """MJCF of robot and obstacles as text; the hand is a site."""
    root = ElementTree.Element("mujoco", model="arm")
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    assets = ElementTree.SubElement(root, "asset")
    links = [ElementTree.SubElement(root, "worldbody")]
    arm, bodies = problem.robot.kinematics, bodies_of(problem)
    for j, name in enumerate(problem.robot.joint_names):
        link = _placed(links[arm.parent[j]], f"link_{j + 1}", arm.rotation[j], arm.translation[j])
        kind, limits = (
            ("slide" if arm.prismatic[j] else "hinge"),
            _numbers(np.r_[arm.lower[j], arm.upper[j]]),
        )
        ElementTree.SubElement(link, "joint", name=name, type=kind, axis="0 0 1", range=limits)
        ElementTree.SubElement(link, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
        links.append(link)
    for body in bodies:
        part = _placed(
            links[body.link], body.name, body.T_link_body[:3, :3], body.T_link_body[:3, 3]
        )
        _mjcf_shape(part, assets, body)
    row, T_link_hand = problem.robot.end_effector_link
    _placed(links[row], HAND, T_link_hand[:3, :3], T_link_hand[:3, 3], "site")
    contact = ElementTree.SubElement(root, "contact")
    for first, second in unchecked_pairs(problem):
        ElementTree.SubElement(contact, "exclude", body1=first, body2=second)
    return ElementTree.tostring(root, encoding="unicode")


def _placed(
    parent: ElementTree.Element,
    name: str,
    rotation: np.ndarray,
    translation: np.ndarray,
    tag: str = "body",
) -> ElementTree.Element:
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    quaternion = _numbers(np.array([w, x, y, z]))
    return ElementTree.SubElement(
        parent, tag, name=name, pos=_numbers(translation), quat=quaternion
    )


def _mjcf_shape(part: ElementTree.Element, assets: ElementTree.Element, body: Body) -> None:
    name = f"{body.name}_geom"
    match body.shape:
        case Box(size):
            ElementTree.SubElement(
                part, "geom", name=name, type="box", size=_numbers(0.5 * np.array(size))
            )
        case Cylinder(radius, height):
            sizes = _numbers(np.array([radius, 0.5 * height]))
            ElementTree.SubElement(part, "geom", name=name, type="cylinder", size=sizes)
        case Sphere(radius):
            ElementTree.SubElement(part, "geom", name=name, type="sphere", size=repr(radius))
        case ConvexMesh(vertices):
            ElementTree.SubElement(
                assets, "mesh", name=body.name, vertex=_numbers(vertices.ravel()), inertia="convex"
            )
            ElementTree.SubElement(part, "geom", name=name, type="mesh", mesh=body.name)
