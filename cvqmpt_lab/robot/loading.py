"""Building a `Robot` from a URDF: the Franka Panda of example-robot-data, or the user's own arm."""

import copyreg
import json
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from functools import lru_cache
from numbers import Real
from pathlib import Path

import numpy as np
import pinocchio as pin

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.robot.arrays import axis_frames, in_link, kinematics_arrays
from cvqmpt_lab.robot.hulls import link_geometry, replace_meshes_by_hulls
from cvqmpt_lab.robot.limits import PANDA_ACCELERATION, positive_per_joint
from cvqmpt_lab.robot.mechanism import ArticulatedObject, with_articulated_object
from cvqmpt_lab.robot.robot import Robot

FINGER_OPENING = 0.04  # [m] each finger of the Panda's hand, its largest
CURES = {
    "continuous": "make it revolute with limits",
    "mimic": "remove its <mimic>, which frees it,",
    "floating": "make it fixed",
    "planar": "make it fixed, or two prismatic joints and a revolute one,",
}  # of joints that are refused


def panda(finger_opening: float = FINGER_OPENING) -> Robot:
    """Franka Emika Panda with its hand; both fingers fixed at finger_opening [m], frame panda_hand."""
    if not 0.0 <= finger_opening <= FINGER_OPENING:
        raise InvalidInputError(
            f"finger opening {finger_opening} m: give a value from 0 to {FINGER_OPENING} m"
        )
    root = _example_robot_data()
    folder = root / "example-robot-data" / "robots" / "panda_description"
    fingers = {"panda_finger_joint1": finger_opening, "panda_finger_joint2": finger_opening}
    return load_robot(
        folder / "urdf" / "panda.urdf",
        "panda_hand",
        srdf=folder / "srdf" / "panda.srdf",
        locked=fingers,
        package_dirs=(root,),
        source={"name": "panda", "finger_opening": finger_opening},
        acceleration_limits=PANDA_ACCELERATION,
    )


def load_robot(
    urdf: Path | str,
    end_effector: str,
    srdf: Path | str | None = None,
    locked: Mapping[str, float] | None = None,
    package_dirs: tuple[Path, ...] = (),
    source: dict | None = None,
    acceleration_limits: float | Sequence[float] | None = None,
) -> Robot:
    """Load a fixed-base arm of hinge and slider joints.

    Parameters
    ----------
    end_effector: frame that constraints and goals speak of.
    srdf: file with the link pairs to skip; without one, neighbours and pairs that overlap at rest are skipped.
    locked: joints to fix, with their values [rad or m].
    package_dirs: folders in which ``package://`` mesh paths are looked up.
    acceleration_limits: one a joint, or one for all [rad/s^2 or m/s^2]; only timing a path needs them.

    Raises
    ------
    InvalidInputError: unreadable file, missing or empty mesh, a joint type the kernels cannot take.
    UnknownChoiceError: end_effector or a locked joint that is not in the URDF.
    """
    urdf = Path(urdf)
    locked = dict(locked or {})
    _refuse_unsupported_joints(urdf, locked)
    try:
        model = pin.buildModelFromUrdf(str(urdf))
        folders = [str(d) for d in (*package_dirs, urdf.parent, urdf.parent.parent)]
        geometry = pin.buildGeomFromUrdf(model, str(urdf), pin.GeometryType.COLLISION, package_dirs=folders)
    except (ValueError, RuntimeError) as error:
        raise InvalidInputError(f"cannot load {urdf}: {' '.join(str(error).split())}") from error
    bodies = [f.name for f in model.frames if f.type == pin.FrameType.BODY]
    if end_effector not in bodies:
        raise UnknownChoiceError("end-effector frame", end_effector, bodies)
    model, geometry = _fix_joints(model, geometry, locked)
    _refuse_bad_model(model, urdf)
    replace_meshes_by_hulls(geometry)
    pairs, overlaps = _self_collision_pairs(model, geometry, srdf)
    accelerations = None
    if acceleration_limits is not None:
        names = list(model.names)[1:]
        accelerations = positive_per_joint("acceleration limit", acceleration_limits, names, "rad/s^2")
    axes = axis_frames(model)
    hand = model.frames[model.getFrameId(end_effector)]
    return Robot(
        name=model.name,
        source=source
        or {
            "urdf": str(urdf.resolve()),
            "end_effector": end_effector,
            "srdf": str(Path(srdf).resolve()) if srdf else None,
            "locked": locked,
            "package_dirs": [str(Path(folder).resolve()) for folder in package_dirs],
            **({} if accelerations is None else {"acceleration_limits": accelerations.tolist()}),
        },
        model=model,
        collision_model=geometry,
        end_effector=end_effector,
        end_effector_link=in_link(axes, hand.parentJoint, hand.placement),
        kinematics=kinematics_arrays(model, axes),
        links=tuple(link_geometry(g, axes) for g in geometry.geometryObjects),
        self_collision_pairs=pairs,
        resting_overlaps=overlaps,
        acceleration_limits=accelerations,
    )


def robot_from_source(source: Mapping) -> Robot:
    """The robot that a problem file names: ``{"name": "panda"}`` or ``{"urdf": ..., "end_effector": ...}``.

    Either with an "articulated" object, see `ArticulatedObject.to_dict`, whose joint then comes last.
    """
    arm = {key: value for key, value in source.items() if key != "articulated"}
    try:
        robot = _cached_robot(tuple(sorted((k, _frozen(v)) for k, v in arm.items())))
        articulated = json.dumps(source["articulated"], sort_keys=True) if "articulated" in source else ""
    except (TypeError, ValueError) as error:
        raise InvalidInputError(
            f"problem field 'robot' is malformed: {' '.join(str(error).split())}"
        ) from error
    return _cached_mechanism(robot, articulated) if articulated else robot


def _by_source(robot: Robot) -> tuple:
    """How a robot is pickled: worker processes rebuild pinocchio's objects."""
    return robot_from_source, (robot.source,)


copyreg.pickle(Robot, _by_source)


def _frozen(value: object) -> object:
    if isinstance(value, Mapping):
        return tuple(sorted(value.items()))
    return tuple(value) if isinstance(value, list) else value


@lru_cache(maxsize=8)
def _cached_mechanism(robot: Robot, articulated: str) -> Robot:
    return with_articulated_object(robot, ArticulatedObject.from_dict(json.loads(articulated)))


@lru_cache(maxsize=8)
def _cached_robot(items: tuple) -> Robot:
    source = dict(items)
    if "urdf" in source:
        if "end_effector" not in source:
            raise InvalidInputError("robot field 'end_effector' is missing: name a frame of the URDF")
        return load_robot(
            source["urdf"],
            source["end_effector"],
            source.get("srdf"),
            dict(source.get("locked") or ()),
            tuple(Path(folder) for folder in source.get("package_dirs") or ()),
            acceleration_limits=source.get("acceleration_limits"),
        )
    if source.get("name") != "panda":
        raise UnknownChoiceError("robot", source.get("name"), ["panda", "or give 'urdf' and 'end_effector'"])
    return panda(source.get("finger_opening", FINGER_OPENING))


def _example_robot_data() -> Path:
    """The share folder that the example-robot-data wheel installed."""
    for entry in sys.path:
        share = Path(entry) / "cmeel.prefix" / "share"
        if (share / "example-robot-data").is_dir():
            return share
    raise InvalidInputError("the Panda's URDF is not installed: pip install example-robot-data")


def _refuse_unsupported_joints(urdf: Path, locked: Mapping[str, float]) -> None:
    """Name the first joint that is neither fixed, revolute nor prismatic, or that mimics another."""
    try:
        root = ElementTree.parse(urdf).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise InvalidInputError(f"cannot read URDF {urdf}: {error}") from error
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    movable = [name for name, joint in joints.items() if joint.get("type") != "fixed"]
    for name, value in locked.items():
        if name not in movable:
            raise UnknownChoiceError("joint to lock", name, movable)
        if not isinstance(value, Real) or not np.isfinite(float(value)):
            raise InvalidInputError(
                f"joint {name!r} cannot be locked at {value!r}: give a finite number [rad or m]"
            )
    for name, joint in joints.items():
        kind = "mimic" if joint.find("mimic") is not None else joint.get("type")
        if kind not in ("fixed", "revolute", "prismatic") and name not in locked:
            cure = CURES.get(kind or "", "make it one of these")
            raise InvalidInputError(
                f"joint {name!r} of {urdf.name} is {kind}: joints must be revolute or prismatic with limits; "
                f"{cure} in the URDF, or lock it: --lock {name}=0, in Python locked={{{name!r}: 0.0}}"
            )


def _fix_joints(model: pin.Model, geometry: pin.GeometryModel, locked: Mapping[str, float]):
    """Model and geometry without the locked joints."""
    if not locked:
        return model, geometry
    q = pin.neutral(model)
    for name, value in locked.items():
        q[model.joints[model.getJointId(name)].idx_q] = value
    ids = [model.getJointId(name) for name in locked]
    reduced, reduced_geometry = pin.buildReducedModel(model, geometry, ids, q)
    return reduced, reduced_geometry


def _refuse_bad_model(model: pin.Model, urdf: Path) -> None:
    if model.nq != model.njoints - 1 or model.nq == 0:
        raise InvalidInputError(f"{urdf.name} has {model.njoints - 1} joints but {model.nq} coordinates")
    for j, name in enumerate(list(model.names)[1:]):
        low, high = model.lowerPositionLimit[j], model.upperPositionLimit[j]
        if not (np.isfinite([low, high]).all() and low < high):
            raise InvalidInputError(
                f"joint {name!r} of {urdf.name} has limits [{low}, {high}]: lower < upper needed"
            )


def _self_collision_pairs(model: pin.Model, geometry: pin.GeometryModel, srdf: Path | str | None):
    """Pairs to check, and the names of pairs skipped because they overlap at rest."""
    geometry.addAllCollisionPairs()
    overlaps: list[tuple[str, str]] = []
    if srdf is not None:
        if not Path(srdf).is_file():
            raise InvalidInputError(
                f"SRDF file {srdf} does not exist; leave it out to skip neighbours and overlaps"
            )
        pin.removeCollisionPairs(model, geometry, str(srdf), False)
    else:
        _skip_neighbours(model, geometry)
        data, geometry_data = model.createData(), pin.GeometryData(geometry)
        rest = np.clip(pin.neutral(model), model.lowerPositionLimit, model.upperPositionLimit)
        pin.computeCollisions(model, data, geometry, geometry_data, rest, False)
        for k, pair in reversed(list(enumerate(list(geometry.collisionPairs)))):
            if geometry_data.collisionResults[k].isCollision():
                overlaps.append(tuple(geometry.geometryObjects[i].name for i in (pair.first, pair.second)))
                geometry.removeCollisionPair(pair)
    pairs = tuple((int(p.first), int(p.second)) for p in geometry.collisionPairs)
    return pairs, tuple(overlaps)


def _skip_neighbours(model: pin.Model, geometry: pin.GeometryModel) -> None:
    """Drop pairs on one joint or on a joint and its parent."""
    for pair in list(geometry.collisionPairs):
        a, b = (geometry.geometryObjects[i].parentJoint for i in (pair.first, pair.second))
        if a == b or model.parents[a] == b or model.parents[b] == a:
            geometry.removeCollisionPair(pair)
