"""What a proof is about: robot, scene, limits and constraint, in the form of docs/proof.md."""

import base64
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.collision.directions import Convex, Directions, convex_of
from cvqmpt_lab.constraints.task_space_region import UNITS, TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.features.proof.cvqmpt_check import KINDS
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.robot.source import RobotSource, content_digest, mesh_path, read_source

MICRON = 1e-6  # to which points of obstacles and loads are rounded [m]
ALWAYS_OPEN = (
    "jerk",
    "effort",
    "speeds of frames",
    "jumps of velocity",
    "steps between states",
    "rest at the ends",
    "start and goal",
)


def claims(problem: PlanningProblem, directions: Directions, urdf: bytes) -> dict[str, Any]:
    """Return the fields of a proof that do not depend on the motion.

    Args:
        problem: robot, scene, constraint and clearance.
        directions: its bodies.
        urdf: content of the robot's URDF.

    Raises InvalidInputError for a robot that is more than its URDF: with the joint of a door, or
    expanded from a xacro file.
    """
    robot, given = problem.robot, read_source(problem.robot.source)
    if "articulated" in robot.source:
        raise InvalidInputError(
            f"the door of robot {robot.name} is a joint that no URDF has, so that nobody can check "
            "a proof of it: leave --proof out"
        )
    root = ElementTree.fromstring(urdf)
    if not {joint.get("name") for joint in root.findall("joint")} >= {*robot.joint_names}:
        raise InvalidInputError(
            f"{given.urdf} is no plain URDF: expand it, xacro {Path(given.urdf).name} > arm.urdf, "
            "and give that file as --robot"
        )
    movable = [
        joint.get("name")
        for joint in root.findall("joint")
        if joint.get("type") in ("revolute", "continuous", "prismatic")
    ]
    hulls, left_out = _hulls(directions, root, given)
    loads = [
        {"link": _link(problem, item.end_effector)[0], **each}
        for item, solids in zip(problem.carried, directions.loads, strict=True)
        for each in _bodies(solids, _link(problem, item.end_effector)[1])
    ]
    return {
        "joints": list(robot.joint_names),
        "held": {joint.name: joint.value for joint in robot.held_joints if joint.name in movable},
        "base": None if given.base is None else _pose(np.asarray(given.base)),
        "visual_as_collision": given.visual_as_collision,
        "limits": dict(zip(robot.joint_names, _limits(robot), strict=True)),
        "hulls": hulls,
        "bodies_left_out": left_out,
        "carried": loads,
        "obstacles": list(_bodies(directions.obstacles, np.eye(4))),
        "clearance": problem.clearance,
        "regions": [_region(problem, region) for region in problem.regions],
        "not_proven": [*ALWAYS_OPEN, *_not_proven(problem)],
    }


def _limits(robot: Robot) -> Iterator[dict[str, float | None]]:
    """Yield the limits of each planned joint by kind; None: none."""
    unknown = np.full(robot.dof, np.inf)
    velocity = np.where(robot.velocity_limits > 0.0, robot.velocity_limits, np.inf)
    acceleration = robot.limits.get("acceleration", unknown)
    for row in np.column_stack([robot.lower, robot.upper, velocity, acceleration]).tolist():
        yield {
            kind: value if math.isfinite(value) else None
            for kind, value in zip(KINDS, row, strict=True)
        }


def _hulls(
    directions: Directions, root: ElementTree.Element, given: RobotSource
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Return the hulls of the URDF's meshes, and why links have no body.

    Args:
        directions: the bodies.
        root: root element of the URDF.
        given: files of the robot.
    """
    named = dict(zip(directions.names, directions.shapes, strict=True))
    hulls: dict[tuple[str, str], dict[str, Any]] = {}
    left_out: dict[str, str] = {}
    for link in root.findall("link"):
        name, shapes = link.get("name", ""), link.findall("collision")
        if given.visual_as_collision and not shapes:
            shapes = link.findall("visual")
        kinds = [kind for kind in (shape.find("geometry/*") for shape in shapes) if _real(kind)]
        if kinds and f"{name}_0" not in named and f"{name}_0.0" not in named:
            left_out[name] = "its mesh is missing, or the SRDF compares it with nothing"
            continue
        for number, kind in enumerate(kinds):
            assert kind is not None
            parts = [n for n in named if n.rpartition(".")[0] == f"{name}_{number}"]
            parts = parts or [f"{name}_{number}"]
            if parts[0] not in named:
                raise InvalidInputError(
                    f"link {name} of {given.urdf} lacks the mesh of one of its bodies, so that no "
                    "proof can be checked: leave --skip-missing-meshes or --proof out"
                )
            if kind.tag != "mesh":
                continue
            file, scale = kind.get("filename", ""), kind.get("scale", "1 1 1")
            pieces = [_hull(convex_of(named[part])) for part in parts]
            path = mesh_path(file, Path(given.urdf), [Path(p) for p in given.package_dirs])
            hulls[file, scale] = {
                "mesh": file,
                "scale": scale,
                "sha256": content_digest(str(path)),
                "pieces": pieces,
            }
    return list(hulls.values()), left_out


def _real(kind: ElementTree.Element | None) -> bool:
    """Return whether a body is no placeholder of size 0."""
    if kind is None:
        return False
    words = " ".join(kind.get(key, "") for key in ("size", "radius", "length")).split()
    return kind.tag == "mesh" or any(float(word) for word in words)


def _hull(convex: Convex) -> dict[str, Any]:
    """Return a hull whose corners are whole numbers; its radius contains what rounding moved."""
    # a unit of few digits, so that every reader has the same number
    unit = float(f"{max(np.abs(convex.points).max() / 32000.0, 1e-9):.2e}")
    whole = np.rint(convex.points / unit).astype("<i2")
    moved = np.linalg.norm(convex.points - unit * whole, axis=1).max()
    text = base64.b64encode(whole.tobytes()).decode()
    radius = round(convex.radius + float(moved) + 5e-10, 9)
    return {"unit": unit, "points": text, "radius": radius, "disc": 0.0}


def _bodies(solids: Sequence[Any], T: np.ndarray) -> Iterator[dict[str, Any]]:
    """Yield pieces of obstacles, or of loads whose hand has the pose T (4, 4) in its link."""
    counts: dict[str, int] = {}
    names = [solid.name for solid in solids]
    for solid in solids:
        number = counts[solid.name] = counts.get(solid.name, -1) + 1
        several = names.count(solid.name) > 1
        convex, T_solid = convex_of(solid.shape), T @ solid.T_parent_shape
        points = convex.points @ T_solid[:3, :3].T + T_solid[:3, 3]
        rounded = np.round(points, 6)
        yield {
            "name": f"{solid.name}/{number}" if several else solid.name,
            "points": rounded.tolist(),
            # a corner moves by at most sqrt(3) / 2 microns; the axis of a disc may turn, too
            "radius": round(convex.radius + MICRON * (1.0 if convex.disc == 0.0 else 5.0), 9),
            "disc": round(convex.disc + 5e-10, 9) if convex.disc else 0.0,
        }


def _link(problem: PlanningProblem, frame: str | None) -> tuple[str, np.ndarray]:
    """Return the link of a frame of the robot, and the pose (4, 4) of the frame in it."""
    robot, given = problem.robot, read_source(problem.robot.source)
    name = frame or robot.end_effector
    if given.tool is not None and name == robot.end_effector:
        return given.end_effector, np.asarray(given.tool)
    return name, np.eye(4)


def _region(problem: PlanningProblem, region: TaskSpaceRegion) -> dict[str, Any]:
    """Return a region of the constraint: two frames, and bounds of how they stand to each other."""
    link, T_link_e = _link(problem, region.end_effector)
    base, T_base_w = "", region.T0_w
    if isinstance(region, TaskSpaceRegionChain):
        base, T_link_base = _link(problem, region.base)
        T_base_w = T_link_base @ region.T0_w
    frames = (link, T_link_e @ np.linalg.inv(region.Tw_e)), (base, T_base_w)
    bounded = np.isin(np.arange(len(UNITS)), region.bounded_rows)[:, None]
    rows = np.where(bounded & np.isfinite(region.bounds), region.bounds, np.nan)
    return {
        "name": region.end_effector or problem.robot.end_effector,
        "frames": [{"link": name, **_pose(T)} for name, T in frames],
        "bounds": [[None if math.isnan(x) else x for x in row] for row in rows.tolist()],
    }


def _pose(T: np.ndarray) -> dict[str, str]:
    """Return a pose (4, 4) as in the <origin> of a URDF, with all digits."""
    R = T[:3, :3]
    pitch = math.atan2(-R[2, 0], math.hypot(R[2, 1], R[2, 2]))
    roll, yaw = math.atan2(R[2, 1], R[2, 2]), math.atan2(R[1, 0], R[0, 0])
    if math.hypot(R[2, 1], R[2, 2]) < 1e-9:  # x points up or down: roll and yaw are one angle
        roll, yaw = 0.0, math.atan2(-R[0, 1], R[1, 1])
    rows = {"xyz": T[:3, 3].tolist(), "rpy": [roll, pitch, yaw]}
    return {key: " ".join(map(repr, row)) for key, row in rows.items()}


def _not_proven(problem: PlanningProblem) -> Iterator[str]:
    """Yield what a proof of this problem does not have."""
    if problem.robot.followers:
        yield "limits of joints that follow others"
    for function in problem.manifold.functions:
        yield f"constraint {function.describe()}"
