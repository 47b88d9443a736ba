"""MoveIt's request of a motion, and the judgement of a motion by it.

Read are `MotionPlanRequest`, the messages that hold one, and `Constraints` alone, which then hold
along the path. Positions become regions; so do orientations whose tolerances are entries of a
rotation vector. Orientations whose tolerances are Euler angles, MoveIt's default,

    R_desired^T R_link = R_x(a) R_y(b) R_z(c),    |a|, |b|, |c| <= tolerances,

are `EulerBounds`. Joint positions are checked here.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import (
    InvalidInputError,
    at,
    few,
    known_fields,
    located,
    mapping,
    require_choice,
    shown,
)
from cvqmpt_lab.base.polyline import cut, nearest_places
from cvqmpt_lab.base.poses import pose, ros_vector
from cvqmpt_lab.base.readers import field_of, listed, plain_readers, read_by_suffix
from cvqmpt_lab.base.values import other_units, scalar
from cvqmpt_lab.certificate.between_states import largest_violation
from cvqmpt_lab.certificate.certificate import (
    CERTIFICATE_TOLERANCE,
    CHECK_SPACING_RAD,
    Fault,
    FaultKind,
)
from cvqmpt_lab.constraints.report import angle_asked, binds_no_angle
from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegion
from cvqmpt_lab.features.motion.judge import Judgement, judge
from cvqmpt_lab.features.motion.limit_use import Ends
from cvqmpt_lab.features.motion.trajectory import Motion
from cvqmpt_lab.features.moveit_requests.euler_bounds import EulerBounds
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.joint_states import joint_state_values, log
from cvqmpt_lab.robot.load import gripper_joints, robot_from_source
from cvqmpt_lab.robot.pairs import srdf_root
from cvqmpt_lab.robot.robot import FrameLimit, Robot
from cvqmpt_lab.robot.source import read_source
from cvqmpt_lab.scene.moveit_frames import frame_name, standing_frame
from cvqmpt_lab.scene.moveit_scenes import read_pose, read_primitive, refuse_attached
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, Cylinder, Sphere


class JointBounds(NamedTuple):
    """Bounds on one joint [rad or m]."""

    joint: str
    lower: float
    upper: float


@dataclass(frozen=True)
class Conditions:
    """What a `Constraints` message asks of a configuration, all of it at once."""

    regions: tuple[TaskSpaceRegion, ...] = ()
    joints: tuple[JointBounds, ...] = ()
    eulers: tuple[EulerBounds, ...] = ()

    def broken(self, robot: Robot, q: np.ndarray) -> str:
        """Return which condition q (n,) breaks, in words; "" if it meets all."""
        for name, lower, upper in self.joints:
            value = q[robot.joint_names.index(name)]
            if not lower - 1e-6 <= value <= upper + 1e-6:
                return f"{name} is at {value:.4g}, asked are {lower:.4g} to {upper:.4g}"
        for region in self.regions:
            given = (robot, (region,), q[None], CHECK_SPACING_RAD, CERTIFICATE_TOLERANCE)
            found = largest_violation(*given)
            if found.largest > CERTIFICATE_TOLERANCE:
                off = f"{found.metres:.2g} m, {found.radians:.2g} rad"
                return f"{region.end_effector} is {off} outside its region"
        for bounds in self.eulers:
            over = float(bounds.excess(robot, q[None])[0][0])
            if over > CERTIFICATE_TOLERANCE:
                return f"{bounds.link} is turned {over:.2g} rad beyond its tolerance"
        return ""


@dataclass(frozen=True)
class MotionRequest:
    """What a `MotionPlanRequest` asks of a motion."""

    start: Mapping[str, float] = field(default_factory=dict)  # values of joints [rad or m]
    path: Conditions = field(default_factory=Conditions)
    goals: tuple[Conditions, ...] = ()  # one of them must be met at the end; none: anywhere
    speed: float = 1.0  # factor on the velocity limits
    acceleration: float = 1.0  # factor on the acceleration limits
    frame_limits: Mapping[str, FrameLimit] = field(default_factory=dict)
    fingers: Mapping[str, float] = field(default_factory=dict)  # held elsewhere by the robot


def read_request(path: Path, robot: Robot) -> MotionRequest:
    """Read the request of a json or yaml file; InvalidInputError names what cannot be judged."""
    return read_by_suffix(plain_readers(_request), path, "request", robot)


def judge_request(
    motion: Motion, request: MotionRequest, robot: Robot, scene: Scene, exact: bool = False
) -> tuple[PlanningProblem, Judgement]:
    """Judge a motion by a request.

    Args:
        motion: the path or trajectory.
        request: start, path constraints, goals and factors on limits.
        robot: the robot.
        scene: obstacles.
        exact: whether least distances are measured.

    Returns:
        The problem that the motion was judged for, and the judgement.
    """
    robot = _limited(robot, request)
    motion = motion.of_joints(robot.joint_names)
    states = motion.positions
    usable = states.ndim == 2 and states.shape[1] == robot.dof and np.isfinite(states).all()
    if not usable or not len(states):
        raise InvalidInputError(
            f"the motion has states of shape {states.shape}; give finite ones of {robot.dof} joints"
        )
    # states outside the limits are faults of the motion, not of the problem
    first, last = np.clip(states[[0, -1]], robot.lower, robot.upper)
    problem = PlanningProblem("request", robot, scene, first, last[None], request.path.regions)
    current = first.copy()
    for name, value in request.start.items():
        current[robot.joint_names.index(name)] = value

    def asked(rows: np.ndarray) -> Iterator[Fault]:
        yield from _goal_faults(request, robot, states[-1], len(rows) - 1.0)
        yield from _path_faults(request.path, robot, rows)

    return problem, judge(
        motion, problem, ends=Ends(current=current), exact_clearance=exact, more_faults=asked
    )


def _limited(robot: Robot, request: MotionRequest) -> Robot:
    """Return the robot with the limits that a request asks for, and its opening of the hand."""
    changed: dict[str, Any] = {}
    if request.fingers:
        changed["locked"] = {**(robot.source.get("locked") or {}), **request.fingers}
    if request.frame_limits:
        limits = dict(robot.frame_limits)
        for name, limit in request.frame_limits.items():
            limits[name] = limit.within(limits.get(name, limit))
        changed["frame_limits"] = {name: vars(limit) for name, limit in limits.items()}
    if request.speed < 1.0:
        changed["velocity_limits"] = (request.speed * robot.velocity_limits).tolist()
    if request.acceleration < 1.0 and "acceleration" in robot.limits:
        slower = request.acceleration * robot.limits["acceleration"]
        changed["acceleration_limits"] = slower.tolist()
    return robot_from_source({**robot.source, **changed}) if changed else robot


def _goal_faults(
    request: MotionRequest, robot: Robot, end: np.ndarray, at_end: float
) -> Iterator[Fault]:
    """Yield a fault if the end (n,) of a motion meets none of the goals."""
    broken = [goal.broken(robot, end) for goal in request.goals]
    if broken and all(broken):
        yield Fault(FaultKind.GOAL, f"does not end at a goal: {broken[0]}", at_end)


def _path_faults(path: Conditions, robot: Robot, states: np.ndarray) -> Iterator[Fault]:
    """Yield faults of joints and Euler angles on straight motions between states (m, n).

    Joints are extreme at states.
    """
    for name, lower, upper in path.joints:
        values = states[:, robot.joint_names.index(name)]
        over = np.maximum(lower - values, values - upper)
        k = int(over.argmax())
        if over[k] > 1e-6:
            text = f"{name} is at {values[k]:.4g}, the request allows {lower:.4g} to {upper:.4g}"
            yield Fault(FaultKind.LIMITS, text, float(k))
    if not path.eulers or len(states) < 2:  # a single state is a fault of the certificate
        return
    turns = np.abs(np.diff(robot.kinematics.joint_values(states), axis=0)).sum(axis=1)
    dense = cut(states, np.maximum(np.ceil(turns / (0.5 * CERTIFICATE_TOLERANCE)), 1.0).astype(int))
    for bounds in path.eulers:
        over, proven = bounds.excess(robot, dense)
        k = int(over.argmax())
        place = float(nearest_places(states, dense[k][None])[0][0])
        if over[k] > CERTIFICATE_TOLERANCE:
            text = f"{bounds.link} is turned {over[k]:.2g} rad beyond its tolerance of Euler angles"
            yield Fault(FaultKind.MANIFOLD, text, place)
        elif proven.max(initial=0.0) > CERTIFICATE_TOLERANCE:
            text = (
                f"Euler angles of {bounds.link} are within their tolerance at checked states, not "
                "proven between them"
            )
            yield Fault(FaultKind.NOT_PROVEN, text, place)


def _request(message: Any, robot: Robot) -> MotionRequest:
    fields = mapping(message, "", "goal_constraints, path_constraints, start_state")
    for key in ("motion_plan_request", "request"):
        if key in fields:
            known_fields(fields, "the message", (key, "planning_options"))
            _refuse_diff(field_of(fields.get("planning_options"), "planning_scene_diff"))
            return _request(fields[key], robot)
    if not fields:
        raise InvalidInputError("the request is empty: any motion would meet it")
    if "goal_constraints" not in fields and "path_constraints" not in fields:
        return MotionRequest(path=_asking(fields, robot, ""))
    unused = (
        "workspace_parameters pipeline_id planner_id num_planning_attempts allowed_planning_time"
    )
    used = (
        "goal_constraints path_constraints start_state group_name trajectory_constraints "
        "reference_trajectories max_velocity_scaling_factor max_acceleration_scaling_factor "
        "max_cartesian_speed cartesian_speed_limited_link cartesian_speed_end_effector_link"
    )
    known_fields(fields, "the request", [*used.split(), *unused.split()])
    _check_group(str(fields.get("group_name", "")), robot)
    for key in ("trajectory_constraints", "reference_trajectories"):
        held = fields.get(key)
        if field_of(held, "constraints") or (isinstance(held, list) and held):
            raise InvalidInputError(f"{key} are not judged; write the request without them")
    goals = listed(fields.get("goal_constraints"), "goal_constraints")
    speed = _number(fields.get("max_cartesian_speed", 0.0), "max_cartesian_speed")
    # earlier versions have the second name; without one it is the hand's link: MoveIt knows no tool
    frames = ("cartesian_speed_limited_link", "cartesian_speed_end_effector_link")
    link = next(iter(robot.tool_links), robot.end_effector)
    frame = next(filter(None, map(fields.get, frames)), link)
    start, fingers = _start(fields.get("start_state"), robot)
    return MotionRequest(
        start,
        _conditions(fields.get("path_constraints") or {}, robot, "path_constraints"),
        tuple(_asking(goal, robot, f"goal_constraints[{k}]") for k, goal in enumerate(goals)),
        _factor(fields, "max_velocity_scaling_factor"),
        _factor(fields, "max_acceleration_scaling_factor"),
        {str(frame): FrameLimit(speed)} if speed > 0.0 else {},
        fingers,
    )


def _refuse_diff(diff: Any) -> None:
    """Refuse what a planning_scene_diff adds to the scene or the start, which is not judged."""
    state, world = field_of(diff, "robot_state"), field_of(diff, "world")
    refuse_attached(state)
    objects = listed(field_of(world, "collision_objects"), "collision_objects")
    if objects or field_of(field_of(field_of(world, "octomap"), "octomap"), "data"):
        names = ", ".join(shown(field_of(item, "id")) for item in objects) or "an octomap"
        raise InvalidInputError(
            f"planning_scene_diff adds {names}; write it into a PlanningScene and give that as "
            "--scene"
        )
    if field_of(field_of(state, "joint_state"), "name"):
        raise InvalidInputError(
            "planning_scene_diff has a joint_state; write it as the request's start_state"
        )


def _number(value: Any, where: str) -> float:
    return float(scalar(float, value, where))


def _factor(fields: Mapping[str, Any], name: str) -> float:
    """Return a factor on limits; MoveIt takes 0, and all above 1, as 1."""
    factor = _number(fields.get(name, 1.0), name)
    return factor if 0.0 < factor <= 1.0 else 1.0


def _given(value: Any, where: str, known: str) -> Mapping[str, Any]:
    """Return an object with fields of `known` alone; None is an empty one."""
    return known_fields({} if value is None else value, where, known.split())


def _start(state: Any, robot: Robot) -> tuple[dict[str, float], dict[str, float]]:
    """Return values of joints in a RobotState: planned ones, and fingers held elsewhere."""
    parts = "joint_state multi_dof_joint_state attached_collision_objects is_diff"
    fields = _given(state, "start_state", parts)
    refuse_attached(fields)
    where = "start_state.joint_state"
    joints = fields.get("joint_state") or {}
    every = joint_state_values(joints, where)
    for rate in listed(joints.get("velocity"), f"{where}.velocity"):
        if abs(_number(rate, f"{where}.velocity")) > 0.01:  # measured at rest, it is not 0
            raise InvalidInputError(
                f"{where}.velocity is {shown(joints['velocity'])}, but motions are judged from "
                "rest; leave it empty, or judge by a problem file with --start-velocity"
            )
    parts = "header joint_names transforms twist wrench"
    base = _given(fields.get("multi_dof_joint_state"), "multi_dof_joint_state", parts)
    if placed := base.get("joint_names") or base.get("transforms"):
        raise InvalidInputError(
            f"start_state.multi_dof_joint_state places {shown(placed)}, which is not judged; leave "
            "it empty and place the robot by --base"
        )
    found = {name: value for name, value in every.items() if name in robot.joint_names}
    if every and not found:
        raise InvalidInputError(
            f"start_state has joints {', '.join(map(shown, every))}; the robot has "
            f"{', '.join(robot.joint_names)}: give the robot that was planned"
        )
    missing = [name for name in robot.joint_names if name not in found]
    if every and missing and not field_of(state, "is_diff"):
        raise InvalidInputError(
            f"start_state has no value of {', '.join(missing)}; add it, or write is_diff: true if "
            "the motion may start at any value of it"
        )
    return found, _fingers(every, robot)


def _fingers(values: Mapping[str, float], robot: Robot) -> dict[str, float]:
    """Return the joints of the gripper at other values than the robot's.

    Other joints that are elsewhere are refused; those that the robot lacks are left out, as by
    MoveIt.
    """
    held = {joint.name: joint.value for joint in robot.held_joints}
    other = {
        name: value
        for name, value in values.items()
        if name in held and abs(value - held[name]) > 1e-6
    }
    # joints that the user locks have the user's values
    locked = robot.source.get("locked") or {}
    gripper = gripper_joints(robot) if other else []
    fingers = {joint.name: joint for joint in gripper if joint.name not in locked}
    for name, value in other.items():
        if name not in fingers:
            raise InvalidInputError(
                f"start_state has {name} at {value:.9g}, the robot holds it at {held[name]:.9g}: "
                f"give --lock {name}={value:.9g}"
            )
    known = {*held, *robot.moving_joints}
    if unknown := [name for name in values if name not in known]:
        log.warning(
            f"start_state: {few(unknown)} are left out: {robot.name} lacks them, as wheels; else "
            "give the robot that was planned, with all of its parts"
        )
    for joint in fingers.values():
        if joint.mimics in other and joint.name not in values:
            other[joint.name] = joint.multiplier * other[joint.mimics] + joint.offset
    return other


def _check_group(name: str, robot: Robot) -> None:
    """Refuse the group of a request if the robot's SRDF says that it moves other joints."""
    path = read_source(robot.source).srdf
    for group in srdf_root(Path(path)).iterfind("group") if path else ():
        if group.get("name") != name or {child.tag for child in group} - {"joint", "chain"}:
            continue  # which joints a group of links or groups moves is not looked up
        joints = {joint.get("name") for joint in group.iter("joint")}
        tips = [str(chain.get("tip_link")) for chain in group.iter("chain")]
        moved = [tip for tip in tips if tip in robot.frame_names and robot.link_of(tip)[0] > 0]
        if not moved and not joints & {*robot.joint_names}:
            raise InvalidInputError(
                f"group_name {name!r} moves none of the robot's joints "
                f"{', '.join(robot.joint_names)}: give the robot that was planned"
            )


def _conditions(message: Any, robot: Robot, where: str) -> Conditions:
    """Return the conditions of a `Constraints` message."""
    readers: Mapping[str, tuple[Callable, str]] = {
        "joint": (_joint, "joint_name position tolerance_above tolerance_below"),
        "position": (_position, "header link_name target_point_offset constraint_region"),
        "orientation": (
            _orientation,
            "header orientation link_name absolute_x_axis_tolerance absolute_y_axis_tolerance "
            "absolute_z_axis_tolerance parameterization",
        ),
    }
    names = [f"{key}_constraints" for key in (*readers, "visibility")]
    fields = known_fields(message, where or "the request", ["name", *names])
    if fields.get("visibility_constraints"):
        raise InvalidInputError(
            f"{at(where, 'visibility_constraints')} are not judged: state the view as look-at of a "
            "problem file"
        )
    regions: list[TaskSpaceRegion] = []
    joints: list[JointBounds] = []
    eulers: list[EulerBounds] = []
    for key, (read, known) in readers.items():
        name = f"{key}_constraints"
        for k, item in enumerate(listed(fields.get(name), at(where, name))):
            with located(at(where, f"{name}[{k}]")):
                made = read(known_fields(item, key, [*known.split(), "weight"]), robot)
            kinds: Sequence[tuple[type, list]] = (
                (TaskSpaceRegion, regions),
                (JointBounds, joints),
                (EulerBounds, eulers),
            )
            next(found for kind, found in kinds if isinstance(made, kind)).append(made)
    return Conditions(tuple(regions), tuple(joints), tuple(eulers))


def _asking(message: Any, robot: Robot, where: str) -> Conditions:
    """Return the conditions of a `Constraints` message; refuse one whose lists are all empty."""
    conditions = _conditions(message, robot, where)
    if conditions == Conditions():
        raise InvalidInputError(
            f"{where or 'the request'} has no constraint, so that any motion would meet it; give "
            "joint_constraints, position_constraints or orientation_constraints"
        )
    return conditions


def _joint(fields: Mapping[str, Any], robot: Robot) -> JointBounds:
    name = require_choice("joint_name", str(fields.get("joint_name")), robot.joint_names)
    value = _number(fields.get("position"), "position")
    below = _number(fields.get("tolerance_below", 0.0), "tolerance_below")
    above = _number(fields.get("tolerance_above", 0.0), "tolerance_above")
    j = robot.joint_names.index(name)
    free = value - below <= robot.lower[j] and value + above >= robot.upper[j]
    slides = robot.kinematics.prismatic[robot.kinematics.order[j]]
    if free and not slides and binds_no_angle(max(below, above)):
        raise InvalidInputError(f"tolerance of {name}: {angle_asked(max(below, above))}")
    if value - below > robot.upper[j] or value + above < robot.lower[j]:
        raise InvalidInputError(
            f"position {value:.4g} of {name} is outside its limits {robot.lower[j]:.4g} to "
            f"{robot.upper[j]:.4g}: {other_units([value])}, and the robot that was planned"
        )
    return JointBounds(name, value - below, value + above)


def _frame(fields: Mapping[str, Any], robot: Robot) -> np.ndarray:
    return standing_frame(frame_name(field_of(fields.get("header"), "frame_id")), robot)


def _link(fields: Mapping[str, Any], robot: Robot) -> str:
    return require_choice("link_name", str(fields.get("link_name")), robot.frame_names)


def _position(fields: Mapping[str, Any], robot: Robot) -> TaskSpaceRegion:
    """Return the region of a point of a link that stays in a box, ball or cylinder."""
    held = mapping(fields.get("constraint_region"), "constraint_region")
    shapes = listed(held.get("primitives"), "primitives")
    poses = listed(held.get("primitive_poses"), "primitive_poses")
    if held.get("meshes") or len(shapes) != 1 or len(poses) != 1:
        raise InvalidInputError(
            f"constraint_region has {len(shapes)} primitives and "
            f"{len(listed(held.get('meshes'), 'meshes'))} meshes; one primitive with its pose is "
            "judged: a box, sphere or cylinder"
        )
    shape, there = read_primitive(shapes[0]), _frame(fields, robot) @ read_pose(poses[0])
    offset = ros_vector(fields.get("target_point_offset") or {"x": 0.0, "y": 0.0, "z": 0.0})
    Tw_e = pose([-_number(x, "target_point_offset") for x in offset])
    Bw = np.array([[-FREE, FREE]] * 6)
    spans: dict[str, Any] = {}
    if isinstance(shape, Box):
        half = 0.5 * np.array(shape.size)
        Bw[:3] = np.stack([-half, half], axis=1)
    elif isinstance(shape, Cylinder):
        Bw[2] = -0.5 * shape.height, 0.5 * shape.height
        spans["radius"] = (0.0, shape.radius)
    elif isinstance(shape, Sphere):
        spans["distance"] = (0.0, shape.radius)
    return TaskSpaceRegion(there, Tw_e, Bw, end_effector=_link(fields, robot), **spans)


def _orientation(fields: Mapping[str, Any], robot: Robot) -> TaskSpaceRegion | EulerBounds:
    """Return the bounds on the orientation of a link."""
    link = _link(fields, robot)
    desired = _frame(fields, robot) @ read_pose(
        {"position": [0.0, 0.0, 0.0], "orientation": fields.get("orientation")}
    )
    most = np.array(
        [
            abs(_number(fields.get(name), name))
            for name in (f"absolute_{axis}_axis_tolerance" for axis in "xyz")
        ]
    )
    for axis, bound in zip("xyz", most.tolist(), strict=True):
        if binds_no_angle(bound):
            raise InvalidInputError(f"absolute_{axis}_axis_tolerance: {angle_asked(bound)}")
    kind = fields.get("parameterization", 0)
    if kind not in (0, 1):
        raise InvalidInputError(
            f"parameterization is {shown(kind)}; 0 (XYZ Euler angles) and 1 (rotation vector) are "
            "judged"
        )
    if kind == 0:
        return EulerBounds(link, desired[:3, :3], most)
    desired[:3, 3] = 0.0
    wide = np.where(most >= np.pi, FREE, most)
    Bw = np.array([[-FREE, FREE]] * 3 + [[-x, x] for x in wide])
    return TaskSpaceRegion(desired, np.eye(4), Bw, end_effector=link)
