"""Building a `Robot` from a URDF: an arm that has a name, or the user's own."""

import copyreg
import json
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from cvqmpt_lab.codec import from_plain
from cvqmpt_lab.errors import InvalidInputError, mapping
from cvqmpt_lab.robot.hulls import link_geometry, replace_meshes_by_hulls
from cvqmpt_lab.robot.mechanism import ArticulatedObject, with_articulated_object
from cvqmpt_lab.robot.robot import (
    Robot,
    axis_frames,
    in_link,
    kinematics_arrays,
    positive_per_joint,
)
from cvqmpt_lab.robot.self_collision import checked_pairs, left_out_pairs
from cvqmpt_lab.robot.source import (
    ARTICULATED,
    FINGER_OPENING,
    ROS_VARIABLE,
    WHERE,
    UrdfRobot,
    content_digest,
    find_collision_meshes,
    read_source,
)
from cvqmpt_lab.robot.urdf import (
    HeldJoint,
    Urdf,
    check_bodies,
    held_joints,
    one_coordinate_a_joint,
    read_urdf,
)

MOST_REACH = 10.0  # [m] from the origin; the kernels' distance grid then takes 125 MB
JOINT = "joint: "  # prefix of joint names in pinocchio, which confuses joints and links of one name


def panda(finger_opening: float = FINGER_OPENING) -> Robot:
    """Franka Emika Panda with its hand; both fingers fixed at finger_opening [m], frame panda_hand."""
    return robot_from_source({"name": "panda", "finger_opening": finger_opening})


def load_robot(
    urdf: Path | str,
    end_effector: str,
    srdf: Path | str | None = None,
    locked: Mapping[str, float] | None = None,
    package_dirs: Sequence[Path | str] = (),
    acceleration_limits: float | Sequence[float] | None = None,
    base: np.ndarray | None = None,
) -> Robot:
    """Load the arm of hinge and slider joints between the base of a URDF and a frame of it.

    Continuous joints turn by up to 2 pi either way; joints that are not between the two are held at
    the value nearest to 0, and those that mimic them at the value that follows.

    Args:
        end_effector: frame that constraints and goals are about.
        srdf: file with the link pairs to skip; without one they are found by sampling.
        locked: joints to fix, with their values [rad or m].
        package_dirs: folders in which ``package://`` mesh paths are looked up first.
        acceleration_limits: one a joint, or one for all [rad/s^2 or m/s^2]; only timing a path needs
            them.
        base: (4, 4), pose of the base link in the world.
    """
    source: dict[str, Any] = {
        "urdf": str(Path(urdf).resolve()),
        "end_effector": end_effector,
        "srdf": str(Path(srdf).resolve()) if srdf else None,
        "locked": dict(locked or {}),
        "package_dirs": [str(Path(folder).resolve()) for folder in package_dirs],
    }
    if acceleration_limits is not None:
        source["acceleration_limits"] = np.asarray(acceleration_limits).tolist()
    if base is not None:
        source["base"] = np.asarray(base).tolist()
    return _built(source)


def robot_from_source(source: Mapping[str, Any]) -> Robot:
    """The robot that a problem file names: ``{"name": "panda"}`` or ``{"urdf": ..., "end_effector":
    ...}``.

    Either may have an "articulated" object, the json of an `ArticulatedObject`, whose joint then
    comes last.
    """
    try:
        alone = {k: v for k, v in mapping(source, WHERE).items() if k != ARTICULATED}
        arm = json.dumps(alone, sort_keys=True)
        articulated = (
            json.dumps(source[ARTICULATED], sort_keys=True) if ARTICULATED in source else ""
        )
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"problem field 'robot' is malformed: {error}") from error
    packages = os.environ.get(ROS_VARIABLE, "")
    robot = _cached_robot(arm, packages)
    if any(content_digest(path) != digest for path, digest in robot.files):
        _cached_robot.cache_clear()
        robot = _cached_robot(arm, packages)
    return _cached_mechanism(robot, articulated) if articulated else robot


@lru_cache(maxsize=8)
def _cached_robot(source: str, packages: str) -> Robot:
    """packages: folders in which meshes are looked for, too."""
    return _built(json.loads(source))


@lru_cache(maxsize=8)
def _cached_mechanism(robot: Robot, articulated: str) -> Robot:
    item = from_plain(ArticulatedObject, json.loads(articulated), f"{WHERE}.{ARTICULATED}")
    return with_articulated_object(robot, item)


def unpickled(source: Mapping[str, Any], files: Sequence[tuple[str, str]]) -> Robot:
    """The robot of a source, built again;
    InvalidInputError if its files hold something else than when pickled.
    """
    robot = robot_from_source(source)
    if [digest for _, digest in robot.files] != [digest for _, digest in files]:
        changed = next((path for path, digest in files if content_digest(path) != digest), source)
        raise InvalidInputError(
            f"robot {robot.name} was pickled from other files than there are now, see {changed}: "
            f"make the pickle anew"
        )
    return robot


# Pickled by its source: worker processes build pinocchio's objects again.
copyreg.pickle(Robot, lambda robot: (unpickled, (robot.source, robot.files)))


def _built(source: Mapping[str, Any]) -> Robot:
    """The robot of a source that has no articulated object."""
    files = read_source(source)
    read = {path: content_digest(path) for path in (files.urdf, files.srdf) if path}
    urdf = read_urdf(Path(files.urdf))
    held = held_joints(urdf, files.end_effector, files.locked, files.base is not None)
    model, geometry, meshes = _models(urdf, files, held)
    replace_meshes_by_hulls(geometry)
    axes = axis_frames(model)
    links = tuple(link_geometry(g, axes) for g in geometry.geometryObjects)
    kinematics = kinematics_arrays(model, axes)
    accelerations = None
    if files.acceleration_limits is not None:
        names = list(model.names)[1:]
        accelerations = positive_per_joint(
            "acceleration", files.acceleration_limits, names, "rad/s^2"
        )
    hand = model.frames[model.getFrameId(files.end_effector, pin.FrameType.BODY)]
    robot = Robot(
        name=model.name,
        source=dict(source),
        model=model,
        collision_model=geometry,
        end_effector=files.end_effector,
        end_effector_link=in_link(axes, hand.parentJoint, hand.placement),
        kinematics=kinematics,
        links=links,
        self_collision_pairs=(),
        held_joints=held,
        acceleration_limits=accelerations,
        files=tuple({**read, **meshes}.items()),
    )
    _refuse_far(robot, urdf)
    srdf = Path(files.srdf) if files.srdf else None
    left_out = left_out_pairs(model, geometry, links, kinematics, urdf, srdf)
    pairs = checked_pairs(model, geometry, left_out)
    return replace(robot, self_collision_pairs=pairs, left_out_pairs=left_out)


def _models(
    urdf: Urdf, files: UrdfRobot, held: Sequence[HeldJoint]
) -> tuple[pin.Model, pin.GeometryModel, dict[str, str]]:
    """Pinocchio's models of the joints that are not held, standing on the given base;
    digests of the meshes' files.
    """
    check_bodies(urdf.root, urdf.path)
    root = one_coordinate_a_joint(urdf)
    meshes = find_collision_meshes(root, urdf.path, [Path(folder) for folder in files.package_dirs])
    digests = {path: content_digest(path) for path in meshes}
    # pinocchio cannot hold joints where one is called like a link
    for element in root.findall("joint"):
        element.set("name", JOINT + element.get("name", ""))
    text = ElementTree.tostring(root, encoding="unicode")
    try:
        model = pin.buildModelFromXML(text)
        geometry = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError) as error:
        raise InvalidInputError(
            f"cannot load {files.urdf}: {' '.join(str(error).split())}"
        ) from error
    if len(geometry.geometryObjects) != len(root.findall("link/collision")):
        raise InvalidInputError(
            f"cannot load {files.urdf}: its parser leaves collision bodies out; see its words above"
        )
    q, ids = pin.neutral(model), []
    for joint in held:
        if model.existJointName(JOINT + joint.name):  # floating and planar joints are fixed by now
            ids.append(model.getJointId(JOINT + joint.name))
            q[model.joints[ids[-1]].idx_q] = joint.value
    if ids:
        model, geometry = pin.buildReducedModel(model, geometry, ids, q)
    for j, name in enumerate(list(model.names)):
        model.names[j] = name.removeprefix(JOINT)
    if files.base is not None:
        _place(model, geometry, pin.SE3(files.base))
    return model, geometry, digests


def _place(model: pin.Model, geometry: pin.GeometryModel, base: pin.SE3) -> None:
    """Move everything fixed to the world."""
    for j in range(1, model.njoints):
        if model.parents[j] == 0:
            model.jointPlacements[j] = base * model.jointPlacements[j]
    for frame in list(model.frames)[1:]:  # the first is the world
        if frame.parentJoint == 0:
            frame.placement = base * frame.placement
    for item in geometry.geometryObjects:
        if item.parentJoint == 0:
            item.placement = base * item.placement


def _refuse_far(robot: Robot, urdf: Urdf) -> None:
    if robot.reach <= MOST_REACH:
        return
    slides = {
        j.name: max(abs(j.lower), abs(j.upper))
        for j in urdf.joints.values()
        if j.kind == "prismatic"
    }
    name, slide = max(slides.items(), key=lambda item: item[1], default=("", 0.0))
    slides_far = slide > MOST_REACH / 2
    reason = (
        f"joint {name!r} slides to {slide:g} m" if slides_far else "its links or base lie far away"
    )
    raise InvalidInputError(
        f"{urdf.path.name} reaches {robot.reach:.3g} m from the origin, because {reason}: at most "
        f"{MOST_REACH:g} m; "
        "are all lengths in metres?"
    )
