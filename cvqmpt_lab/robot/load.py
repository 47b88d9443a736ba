"""Build a `Robot` from a named arm or a URDF file; read configurations by name or from an SRDF."""

import copyreg
import json
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pinocchio as pin

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import (
    InvalidInputError,
    UnknownChoiceError,
    few,
    mapping,
    require_choice,
    shown,
)
from cvqmpt_lab.base.modules import Code, allow_code
from cvqmpt_lab.base.values import Array, FloatArray
from cvqmpt_lab.robot.hulls import MeshFile, hulls_of_meshes, link_geometry, take_meshes
from cvqmpt_lab.robot.joint_limits_file import (
    Limits,
    limits_with,
    narrow_positions,
    read_joint_limits,
)
from cvqmpt_lab.robot.joint_states import is_joint_state, of_joints
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.mechanism import (
    ArticulatedObject,
    add_tool,
    placed_frames,
    with_articulated_object,
)
from cvqmpt_lab.robot.pairs import (
    bodies_of,
    checked_pairs,
    default_off,
    left_out_pairs,
    srdf_oddities,
    srdf_root,
)
from cvqmpt_lab.robot.parser import keep_needed_parts, parsed
from cvqmpt_lab.robot.reach import note_on_reach
from cvqmpt_lab.robot.robot import (
    LIMIT_UNITS,
    Follower,
    HeldJoint,
    Robot,
    axis_frames,
    kinematics_arrays,
    positive_per_joint,
)
from cvqmpt_lab.robot.source import (
    PACKAGE_PATHS,
    PANDA_FINGER_OPENING_M,
    RobotSource,
    content_digest,
    find_collision_meshes,
    read_source,
)
from cvqmpt_lab.robot.urdf import (
    Joint,
    Urdf,
    check_turns,
    held_joints,
    one_coordinate_a_joint,
    read_urdf,
)
from cvqmpt_lab.robot.urdf_bodies import Prepared, prepare_bodies


class StateForm(Array):
    """Form of a configuration: numbers; in a file also {"joint": value} or a group_state."""

    def schema(self, schema_of: Any) -> dict[str, Any]:
        """Return the JSON schema of all three."""
        names = {"type": "string", "description": "group_state of the robot's SRDF"}
        by_joint = schema_of(Mapping[str, float]) | {"description": "value by joint"}
        return {"anyOf": [super().schema(schema_of), by_joint, names]}


class SourceForm:
    """Form of the source of a robot, which stays as it is in a file."""

    def read(self, value: Any, where: str) -> Any:
        """Return a mapping."""
        return dict(mapping(value, where))

    def schema(self, schema_of: Any) -> dict[str, Any]:
        """Return the JSON schema: a URDF or a named arm, perhaps with a door or drawer."""
        found = schema_of.object(RobotSource, {}, articulated=ArticulatedObject | None)
        for name in ("end_effector", "srdf"):  # null stands for an absent field
            found["properties"][name]["type"] = ["string", "null"]
        ways = ["name"], ["urdf", "end_effector"], ["urdf", "end_effectors"]
        return found | {"oneOf": [{"required": way} for way in ways]}


State = Annotated[FloatArray, StateForm((None,), "numbers [rad or m]")]


def panda(finger_opening: float = PANDA_FINGER_OPENING_M) -> Robot:
    """Load the Franka Emika Panda with its hand, both fingers held at `finger_opening` [m]."""
    return robot_from_source({"name": "panda", "finger_opening": finger_opening})


def load_robot(
    urdf: Path | str,
    end_effector: str | Sequence[str],
    srdf: Path | str | None = None,
    locked: Mapping[str, float] | None = None,
    package_dirs: Sequence[Path | str] = (),
    acceleration_limits: float | Sequence[float] | None = None,
    jerk_limits: float | Sequence[float] | None = None,
    effort_limits: float | Sequence[float] | None = None,
    torque_rate_limits: float | Sequence[float] | None = None,
    base: np.ndarray | None = None,
    hard_limits: bool = False,
    visual_as_collision: bool = False,
    velocity_limits: float | Sequence[float] | None = None,
    tool: np.ndarray | None = None,
) -> Robot:
    """Load the arm of revolute and prismatic joints from the base of a URDF to one of its frames.

    Continuous joints turn by up to 2 pi either way. A joint outside the chain is held at its value
    nearest to 0. A joint that mimics another one follows it.

    Args:
        urdf: path of the URDF file.
        end_effector: frame of constraints and goals; or several frames, whose joints all move.
        srdf: file with the link pairs that are not checked; None: they are found by sampling.
        locked: values of the joints that are held [rad or m], by name.
        package_dirs: folders that are searched first for ``package://`` mesh paths.
        acceleration_limits: (n,), or one for all joints [rad/s^2 or m/s^2]; used for timing only.
        jerk_limits: (n,), or one for all joints [rad/s^3 or m/s^3].
        effort_limits: (n,), or one for all joints [Nm or N]; None: plausible ones of the URDF.
        torque_rate_limits: (n,), or one for all joints [Nm/s or N/s].
        base: (4, 4) pose of the base link in the world; None: the identity.
        hard_limits: whether joints move beyond the soft limits of their <safety_controller>.
        visual_as_collision: whether links without a collision body get their visual bodies.
        velocity_limits: (n,), or one for all joints [rad/s or m/s]; None: those of the URDF.
        tool: (4, 4) pose of a tool in the frame `end_effector` [m]; the hand is then the frame
            END_EFFECTOR/tool, to which constraint, goals and loads refer.
    """
    source: dict[str, Any] = {"urdf": str(Path(urdf).resolve())}
    if isinstance(end_effector, str):
        source["end_effector"] = end_effector
    else:
        source["end_effectors"] = list(end_effector)
    source |= {
        "srdf": str(Path(srdf).resolve()) if srdf else None,
        "locked": dict(locked or {}),
        "package_dirs": [str(Path(folder).resolve()) for folder in package_dirs],
    }
    numbers = {
        "acceleration_limits": acceleration_limits,
        "jerk_limits": jerk_limits,
        "effort_limits": effort_limits,
        "torque_rate_limits": torque_rate_limits,
        "base": base,
        "velocity_limits": velocity_limits,
        "tool": tool,
    }
    given = {k: np.asarray(v).tolist() for k, v in numbers.items() if v is not None}
    flags = {"hard_limits": hard_limits, "visual_as_collision": visual_as_collision}
    return _built(source | given | {name: True for name, value in flags.items() if value})


def robot_from_source(source: Mapping[str, Any]) -> Robot:
    """Return the robot of a problem file; it is kept in memory until one of its files changes.

    Args:
        source: ``{"name": "panda"}`` or ``{"urdf": ..., "end_effector": ...}``, with options;
            "articulated" is the JSON of an `ArticulatedObject`, whose joint becomes the last one.
    """
    try:
        alone = {k: v for k, v in mapping(source, "robot").items() if k != "articulated"}
        arm = json.dumps(alone, sort_keys=True)
        door = ""
        if "articulated" in source:
            door = json.dumps(source["articulated"], sort_keys=True)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"problem field 'robot' is malformed: {error}") from error
    # meshes are searched in these folders, too
    packages = ":".join(os.environ.get(name, "") for name in PACKAGE_PATHS)
    robot = _cached_robot(arm, packages)
    if any(content_digest(path) != digest for path, digest in robot.files):
        _cached_robot.cache_clear()
        robot = _cached_robot(arm, packages)
    return _cached_mechanism(robot, door) if door else robot


@lru_cache(maxsize=8)
def _cached_robot(source: str, packages: str) -> Robot:
    return _built(json.loads(source))


@lru_cache(maxsize=8)
def _cached_mechanism(robot: Robot, articulated: str) -> Robot:
    item = from_plain(ArticulatedObject, json.loads(articulated), "robot.articulated")
    return with_articulated_object(robot, item)


def unpickled(
    source: Mapping[str, Any], files: Sequence[tuple[str, str]], code_allowed: bool = False
) -> Robot:
    """Build a pickled robot again from its source; refuse if one of its files has changed.

    Args:
        source: of the robot.
        files: its files with their digests.
        code_allowed: whether files may start code where the robot was pickled.
    """
    if code_allowed:
        allow_code()
    robot = robot_from_source(source)
    if [digest for _, digest in robot.files] != [digest for _, digest in files]:
        changed = next((path for path, digest in files if content_digest(path) != digest), source)
        raise InvalidInputError(
            f"robot {robot.name} was pickled before a change of its file {changed}: pickle it again"
        )
    return robot


# pinocchio's objects are not pickled: worker processes build them again
copyreg.pickle(Robot, lambda robot: (unpickled, (robot.source, robot.files, Code.allowed)))


def with_gripper(robot: Robot) -> Robot:
    """Return the arm with a moving gripper: held joints behind the arm's last joint move."""
    return _built(robot.source, [joint.name for joint in gripper_joints(robot)])


def gripper_joints(robot: Robot) -> list[Joint]:
    """Return the joints of the URDF behind the last joint that moves the end effector."""
    given = read_source(robot.source)
    urdf = read_urdf(Path(given.urdf), given.package_dirs)
    above = [joint.name for joint in urdf.chain(given.end_effector)]
    last = [name for name in above if name in robot.moving_joints][-1]
    return [
        joint
        for joint in urdf.joints.values()
        if joint.kind in ("revolute", "prismatic", "continuous")
        and joint.name not in robot.moving_joints
        and last in [higher.name for higher in urdf.chain(joint.child)]
    ]


def opening_sign(robot: Robot, finger: str, others: Sequence[str]) -> float:
    """Return 1.0 if a finger opens towards larger values of its slider, else -1.0.

    It opens away from the other fingers; limits decide where it has none, or none is beside it.

    Args:
        robot: arm whose fingers move, see `with_gripper`.
        finger: name of the slider.
        others: names of the other fingers' joints.
    """
    k = robot.joint_names.index(finger)
    middle = np.clip(np.zeros(robot.dof), robot.lower, robot.upper)
    rotations, translations = link_poses(robot.kinematics, middle[None])
    rows = {name: robot.moving_joints.index(name) + 1 for name in (finger, *others)}
    centres = {name: translations[0, row] for name, row in rows.items()}
    for name, row in rows.items():
        pieces = [piece.vertices_in_link.mean(axis=0) for piece in robot.links if piece.link == row]
        if pieces:
            centres[name] = centres[name] + rotations[0, row] @ np.mean(pieces, axis=0)
    own = centres.pop(finger)
    beside = own - np.mean(list(centres.values()), axis=0) if centres else np.zeros(3)
    along = float(beside @ rotations[0, rows[finger], :, 2])
    if abs(along) < 1e-4:
        along = float(robot.upper[k] + robot.lower[k])
    return 1.0 if along >= 0.0 else -1.0


def _built(source: Mapping[str, Any], free: Sequence[str] = ()) -> Robot:
    """Build the robot of a source without articulated object; free: locked joints that move."""
    given = read_source(source)
    named = (given.urdf, given.srdf, given.joint_limits)
    read = {path: content_digest(path) for path in named if path}
    urdf = read_urdf(Path(given.urdf), given.package_dirs)
    read |= {path: content_digest(path) for path in urdf.included}
    held, followers = held_joints(urdf, given.end_effectors, given.locked, given.base is not None)
    held = tuple(joint for joint in held if joint.name not in free)
    model, geometry, files, meshes, bodies = _models(urdf, given, held)
    following = {joint.name for joint in followers}
    planned = [name for name in list(model.names)[1:] if name not in {*following, *free}]
    check_turns(urdf, planned)
    stated: Limits = {}
    if given.joint_limits:
        stated = read_joint_limits(Path(given.joint_limits), list(urdf.joints))
        narrow_positions(model, stated, planned)
    soft = () if given.hard_limits else _within_soft_limits(model, urdf, planned)
    _limit_leaders(model, urdf, followers)
    axes = axis_frames(model)
    kinematics = kinematics_arrays(model, axes, followers)
    own = kinematics.order[: len(kinematics.lower)]
    # A URDF must state an effort limit. Larger values than any arm's motor has [Nm or N] are
    # placeholders.
    efforts = np.array(model.upperEffortLimit)[own]
    placeholder = np.where(kinematics.prismatic[own], 1e4, 1e3)
    plausible = np.where((efforts > 0.0) & (efforts < placeholder), efforts, np.inf)
    names = [model.names[j + 1] for j in own.tolist()]
    velocities = given.velocity_limits
    if stated:
        known = np.array(model.upperVelocityLimit)[own] if velocities is None else velocities
        velocities = limits_with("velocity", known, stated, names)
    if velocities is not None and not free:
        speeds = positive_per_joint("velocity", velocities, names, LIMIT_UNITS["velocity"])
        for j, speed in zip(own.tolist(), speeds.tolist(), strict=True):
            model.upperVelocityLimit[j] = speed
    known_limits = {key.removesuffix("_limits"): given.limits[key] for key in given.limits}
    if known_limits["effort"] is None and any("effort" in stated.get(name, {}) for name in names):
        # the URDF's, where they are plausible
        known_limits["effort"] = np.where(np.isinf(plausible), np.nan, plausible)
    limits = {
        kind: positive_per_joint(kind, values, names, LIMIT_UNITS[kind])
        for kind, values in (
            (kind, limits_with(kind, known_limits[kind], stated, names)) for kind in known_limits
        )
        # limits of the source have no entries for `free` joints
        if values is not None and not free
    }
    body_frames = [frame for frame in model.frames if frame.type == pin.FrameType.BODY]
    standing = {frame.name for frame in body_frames if frame.parentJoint == 0}
    remarks = urdf.notes + bodies.notes
    end_effectors, tool_links = given.end_effectors, tuple[str, ...]()
    # results of arms by name depend on their hulls
    hulls_alone = bool(given.name) or given.one_hull_a_mesh
    if not hulls_alone:
        from cvqmpt_lab.robot.link_pieces import cut_concave_links  # arms by name need none

        concave = urdf, given.srdf, meshes, files
        geometry, notes = cut_concave_links(model, geometry, kinematics, *concave)
        remarks += tuple(notes)
    if given.tool is not None:
        name, line = add_tool(model, given.end_effector, given.tool)
        end_effectors, tool_links, remarks = (name,), given.end_effectors, (*remarks, line)
    robot = Robot(
        name=model.name,
        source=dict(source),
        model=model,
        collision_model=geometry,
        end_effectors=placed_frames(model, axes, end_effectors),
        tool_links=placed_frames(model, axes, tool_links),
        kinematics=kinematics,
        links=tuple(link_geometry(item, axes) for item in geometry.geometryObjects),
        self_collision_pairs=(),
        held_joints=held,
        followers=followers,
        soft_limited=soft,
        # those that move come first
        bodiless=tuple(sorted(bodies.bodiless, key=lambda name: name in standing)),
        remarks=remarks,
        limits={"effort": plausible, **limits},
        frame_limits=dict(given.frame_limits),
        files=tuple({**read, **files}.items()),
        continuous=tuple(name for name in names if urdf.joints[name].kind == "continuous"),
    )
    far = note_on_reach(robot, urdf)
    left_out = left_out_pairs(bodies_of(robot), urdf, given.srdf, hulls_alone)
    pairs = checked_pairs(model, geometry, left_out)
    off = default_off(srdf_root(Path(given.srdf)))[0] if given.srdf else set()
    owners = [model.frames[item.parentFrame].name for item in geometry.geometryObjects]
    links = tuple(
        replace(piece, self_only=True) if owner in off else piece
        for piece, owner in zip(robot.links, owners, strict=True)
    )
    return replace(
        robot,
        links=links,
        self_collision_pairs=pairs,
        left_out_pairs=left_out,
        remarks=remarks + far,
    )


def _within_soft_limits(model: pin.Model, urdf: Urdf, planned: Sequence[str]) -> tuple[str, ...]:
    """Narrow the limits of planned joints to the soft ones of the URDF; return which changed."""
    narrowed = []
    for joint in (urdf.joints[name] for name in planned):
        j = model.getJointId(joint.name) - 1
        hard = model.lowerPositionLimit[j], model.upperPositionLimit[j]
        # limits that are not stated, or empty, are no limits; a continuous joint has none
        if joint.kind == "continuous" or not joint.soft_lower < joint.soft_upper:
            continue
        lower, upper = max(hard[0], joint.soft_lower), min(hard[1], joint.soft_upper)
        if not lower < upper:
            raise InvalidInputError(
                f"joint {joint.name!r} of {urdf.path.name} has soft limits "
                f"[{joint.soft_lower:g}, {joint.soft_upper:g}] outside its limits [{hard[0]:g}, "
                f"{hard[1]:g}]: correct its <safety_controller>, or leave it out: --hard-limits"
            )
        if (lower, upper) != hard:
            model.lowerPositionLimit[j], model.upperPositionLimit[j] = lower, upper
            narrowed.append(joint.name)
    return tuple(narrowed)


def _limit_leaders(model: pin.Model, urdf: Urdf, followers: Sequence[Follower]) -> None:
    """Narrow the limits of planned joints so that the joints that mimic them keep theirs.

    Limits of a follower that are empty, and a velocity of 0, are placeholders.
    """
    for joint in followers:
        own, leader = urdf.joints[joint.name], model.getJointId(joint.leader) - 1
        if joint.multiplier == 0.0:
            continue
        velocity = model.upperVelocityLimit[model.getJointId(joint.name) - 1]
        if velocity > 0.0:
            most = velocity / abs(joint.multiplier)
            model.upperVelocityLimit[leader] = min(model.upperVelocityLimit[leader], most)
        if own.kind == "continuous" or not own.lower < own.upper:
            continue
        ends = sorted((end - joint.offset) / joint.multiplier for end in (own.lower, own.upper))
        lower = max(model.lowerPositionLimit[leader], ends[0])
        upper = min(model.upperPositionLimit[leader], ends[1])
        if not lower < upper:
            raise InvalidInputError(
                f"joint {joint.name!r} of {urdf.path.name} has limits [{own.lower:g}, "
                f"{own.upper:g}], in which {joint.multiplier:g} * {joint.leader} "
                f"{joint.offset:+g} never lies: correct its <mimic> or <limit>, or hold it: --lock "
                f"{joint.leader}={urdf.joints[joint.leader].neutral:g}"
            )
        model.lowerPositionLimit[leader], model.upperPositionLimit[leader] = lower, upper


def _models(
    urdf: Urdf, given: RobotSource, held: Sequence[HeldJoint], prefix: str = "joint: "
) -> tuple[pin.Model, pin.GeometryModel, dict[str, str], dict[str, MeshFile], Prepared]:
    """Return pinocchio's models, sha256 of meshes by path, meshes by body, and remarks.

    Held joints are fixed, and the robot stands on the given base. prefix: put in front of the
    joints' names meanwhile: pinocchio confuses a joint and a link of the same name.
    """
    root = one_coordinate_a_joint(urdf)
    bodies = prepare_bodies(root, urdf.path, given.visual_as_collision)
    bodies = bodies._replace(notes=(*bodies.notes, *_without_uncompared(root, given.srdf)))
    folders = [Path(folder) for folder in given.package_dirs]
    meshes, lost = find_collision_meshes(root, urdf.path, folders, given.skip_missing_meshes)
    if lost:
        said = f"cannot collide: {few(lost)}, whose collision mesh is missing"
        bodies = bodies._replace(notes=(*bodies.notes, said))
    digests = {path: content_digest(path) for path in meshes}
    taken = take_meshes(root)
    hulls = hulls_of_meshes(taken.values(), digests)
    larger = [
        f"{name} by up to {1e3 * hulls[mesh].rounded:.1g} mm"
        for name, mesh in taken.items()
        if hulls[mesh].rounded
    ]
    if larger:
        why = "of meshes with too many corners or without thickness"
        rounded = f"hulls {why} are larger than these: {few(larger)}"
        bodies = bodies._replace(notes=(*bodies.notes, rounded))
    bodies = bodies._replace(notes=(*bodies.notes, *keep_needed_parts(root)))
    for element in root.findall("joint"):
        element.set("name", prefix + element.get("name", ""))
    model, geometry = parsed(root, given.urdf)
    for item in geometry.geometryObjects:
        if item.name in taken:
            item.geometry = hulls[taken[item.name]].shape
    q = pin.neutral(model)
    ids = []
    for joint in held:
        # floating and planar joints are fixed by now
        if model.existJointName(prefix + joint.name):
            ids.append(model.getJointId(prefix + joint.name))
            q[model.joints[ids[-1]].idx_q] = joint.value
    if ids:
        model, geometry = pin.buildReducedModel(model, geometry, ids, q)
    for j, name in enumerate(list(model.names)):
        model.names[j] = name.removeprefix(prefix)
    if given.base is not None:
        # move everything fixed to the world; the first frame is the world itself
        base = pin.SE3(given.base)
        for j in range(1, model.njoints):
            if model.parents[j] == 0:
                model.jointPlacements[j] = base * model.jointPlacements[j]
        for fixed in (*list(model.frames)[1:], *geometry.geometryObjects):
            if fixed.parentJoint == 0:
                fixed.placement = base * fixed.placement
        # the masses of fixed links count in the centre of mass
        model.inertias[0] = base.act(model.inertias[0])
    return model, geometry, digests, taken, bodies


def _without_uncompared(root: ElementTree.Element, srdf: str) -> list[str]:
    """Remove the bodies of links that an SRDF compares with nothing; return lines about them.

    root: root element of the URDF; it is changed. srdf: path, or "".
    """
    if not srdf:
        return []
    described = srdf_root(Path(srdf))
    off, enabled = default_off(described)
    named = [
        item.get(key, "")
        for item in described
        if item.tag in ("disable_collisions", "enable_collisions", "disable_default_collisions")
        for key in ("link1", "link2", "link")
        if key in item.attrib
    ]
    links = {link.get("name", "") for link in root.findall("link")}
    alone, partly = list[str](), list[str]()
    for link in root.findall("link"):
        name, bodies = link.get("name", ""), link.findall("collision")
        if name not in off or not bodies:
            continue
        if any(name in pair for pair in enabled):
            partly.append(name)
            continue
        alone.append(name)
        for body in bodies:
            link.remove(body)
    lines = {
        **srdf_oddities(described),
        "named by the SRDF, but no links of the URDF": [one for one in named if one not in links],
        "compared with nothing, by the SRDF": alone,
        "compared only with the links that the SRDF enables, not with obstacles": partly,
    }
    return [f"{what}: {few(names)}" for what, names in lines.items() if names]


def numbers_of(robot: Robot, value: Any, where: str) -> Any:
    """Return a configuration as a list of numbers [rad or m] in the order of the robot's joints.

    Args:
        robot: the robot.
        value: {"joint": number}, a JointState message or the name of a group_state of its SRDF;
            any other value is returned unchanged.
        where: the field's name in errors.
    """
    if isinstance(value, str):
        states = group_states(robot)
        if value not in states:
            raise UnknownChoiceError(
                f"group_state of {where}", value, states or ["none in its SRDF; give numbers"]
            )
        known = robot.joint_names
        value = {name: number for name, number in states[value].items() if name in known}
    if not isinstance(value, Mapping):
        return value
    if is_joint_state(value):
        value = of_joints(value, robot.joint_names, where)
    for name in value:
        require_choice(f"joint of {where}", name, robot.joint_names)
    missing = [name for name in robot.joint_names if name not in value]
    if missing:
        raise InvalidInputError(
            f"{where} has no value for {', '.join(missing)}; give one for each joint [rad or m]"
        )
    return [value[name] for name in robot.joint_names]


def group_states(robot: Robot) -> dict[str, dict[str, float]]:
    """Return the joints' values [rad or m] of each group_state in the robot's SRDF, by name."""
    path = read_source(robot.source).srdf
    if not path:
        return {}
    states: dict[str, dict[str, float]] = {}
    try:
        for state in srdf_root(Path(path)).iter("group_state"):
            joints = states.setdefault(state.get("name", ""), {})
            for joint in state.iter("joint"):
                values = joint.get("value", "").split()
                # a joint of several coordinates is none of the arm's
                if len(values) == 1:
                    joints[joint.get("name", "")] = float(values[0])
    except ValueError as error:
        raise InvalidInputError(
            f"group_states of SRDF {path} cannot be read: {shown(str(error))}"
        ) from error
    return states
