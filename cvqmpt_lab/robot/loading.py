"""Building a `Robot` from a URDF: the Franka Panda of example-robot-data, or the user's own arm."""

import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from functools import lru_cache
from numbers import Real
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.kernels.kinematics import Kinematics
from cvqmpt_lab.robot.limits import PANDA_ACCELERATION, positive_per_joint
from cvqmpt_lab.robot.robot import LinkGeometry, Robot

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
    _replace_meshes_by_hulls(geometry)
    pairs, overlaps = _self_collision_pairs(model, geometry, srdf)
    accelerations = None
    if acceleration_limits is not None:
        names = list(model.names)[1:]
        accelerations = positive_per_joint("acceleration limit", acceleration_limits, names, "rad/s^2")
    axes = _axis_frames(model)
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
        end_effector_link=_in_link(axes, hand.parentJoint, hand.placement),
        kinematics=_kinematics(model, axes),
        links=tuple(_link_geometry(g, axes) for g in geometry.geometryObjects),
        self_collision_pairs=pairs,
        resting_overlaps=overlaps,
        acceleration_limits=accelerations,
    )


def robot_from_source(source: Mapping) -> Robot:
    """The robot that a problem file names: ``{"name": "panda"}`` or ``{"urdf": ..., "end_effector": ...}``."""
    try:
        return _cached_robot(tuple(sorted((k, _frozen(v)) for k, v in source.items())))
    except (TypeError, ValueError) as error:
        raise InvalidInputError(
            f"problem field 'robot' is malformed: {' '.join(str(error).split())}"
        ) from error


def _frozen(value: object) -> object:
    if isinstance(value, Mapping):
        return tuple(sorted(value.items()))
    return tuple(value) if isinstance(value, list) else value


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


def _replace_meshes_by_hulls(geometry: pin.GeometryModel) -> None:
    """Every collision mesh becomes its convex hull."""
    for item in geometry.geometryObjects:
        shape = item.geometry
        if isinstance(shape, coal.BVHModelBase):
            if shape.num_vertices == 0:
                raise InvalidInputError(f"collision mesh {item.meshPath or item.name} is empty")
            try:
                shape.buildConvexHull(True, "Qt")
            except (ValueError, RuntimeError) as error:
                raise InvalidInputError(
                    f"collision mesh {item.meshPath or item.name} has no volume: its convex hull is flat"
                ) from error
            item.geometry = shape.convex


def _link_geometry(item: pin.GeometryObject, frames: list[np.ndarray]) -> LinkGeometry:
    link, T_link_geometry = _in_link(frames, item.parentJoint, item.placement)
    return LinkGeometry(item.name, link, T_link_geometry, hull_vertices(item.geometry))


def hull_vertices(shape: coal.CollisionGeometry) -> np.ndarray:
    """Vertices (n, 3) [m] of a polytope that contains the shape: exact for hulls and boxes.

    Round shapes (cylinder, capsule, sphere) are circumscribed by 24-sided prisms or boxes.
    """
    if isinstance(shape, coal.ConvexBase):
        points = shape.points()
        return np.array(points, dtype=float).reshape(-1, 3)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    if isinstance(shape, coal.Box):
        return corners * shape.halfSide
    if isinstance(shape, coal.Sphere):
        return corners * shape.radius
    if isinstance(shape, coal.Cylinder | coal.Capsule):
        half = shape.halfLength + (shape.radius if isinstance(shape, coal.Capsule) else 0.0)
        return prism_vertices(shape.radius, half)
    raise InvalidInputError(
        f"collision shape {type(shape).__name__} is not supported: use a mesh, box or cylinder"
    )


def prism_vertices(radius: float, half_length: float, sides: int = 24) -> np.ndarray:
    """Vertices (2 sides, 3) of the prism around a cylinder along z [m]."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = radius / np.cos(np.pi / sides) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.c_[ring, np.full(sides, z)] for z in (-half_length, half_length)])


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


def _axis_frames(model: pin.Model) -> list[np.ndarray]:
    """Per pose row, the rotation (3, 3) that turns pinocchio's joint frame so that its z is the joint axis."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    frames = [np.eye(3)]
    for j in range(1, model.njoints):
        motion = pin.getJointJacobian(model, data, j, pin.ReferenceFrame.LOCAL)[:, j - 1]
        axis = motion[3:] if np.linalg.norm(motion[3:]) > 0.5 else motion[:3]
        z = np.array([0.0, 0.0, 1.0])
        frames.append(pin.Quaternion.FromTwoVectors(z, axis).toRotationMatrix())
    return frames


def _kinematics(model: pin.Model, frames: list[np.ndarray]) -> Kinematics:
    """Plain arrays of a model, in joint frames whose z is the joint axis."""
    n = model.nq
    parent = np.array([model.parents[j + 1] for j in range(n)], dtype=np.int64)
    placements = [model.jointPlacements[j + 1] for j in range(n)]
    moves = np.zeros((n, n + 1), dtype=bool)
    for k in range(1, n + 1):
        for j in model.supports[k]:
            if j > 0:
                moves[j - 1, k] = True
    return Kinematics(
        parent=parent,
        rotation=np.array([frames[parent[j]].T @ placements[j].rotation @ frames[j + 1] for j in range(n)]),
        translation=np.array([frames[parent[j]].T @ placements[j].translation for j in range(n)]),
        prismatic=np.array([j.shortname().startswith("JointModelP") for j in list(model.joints)[1:]]),
        lower=np.array(model.lowerPositionLimit),
        upper=np.array(model.upperPositionLimit),
        moves=moves,
    )


def _in_link(frames: list[np.ndarray], joint: int, placement: pin.SE3) -> tuple[int, np.ndarray]:
    """Pose row and (4, 4) placement of something that pinocchio attaches to a joint."""
    T = placement.homogeneous
    T[:3] = frames[joint].T @ T[:3]
    return int(joint), T
