"""A robot arm: its joints, limits and collision geometry.

`Robot` has two models: pinocchio objects for the exact backend and the certificate, and arrays for
the compiled kernels. Tests compare the two.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np
import pinocchio as pin

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError, few, require_choice
from cvqmpt_lab.base.poses import nearest_turn
from cvqmpt_lab.base.values import Condition, frozen
from cvqmpt_lab.robot.kinematics import Kinematics
from cvqmpt_lab.robot.left_out import OVERLAP, LeftOut


class HeldJoint(NamedTuple):
    """A joint that planning does not move."""

    name: str
    value: float  # constant value [rad or m]
    reason: str  # why planning does not move it


class Follower(NamedTuple):
    """A joint that mimics a planned joint: it has the value multiplier * leader + offset."""

    name: str
    leader: str  # the planned joint; in chains of joints that mimic others, the first one
    multiplier: float  # product along a chain of mimic joints
    offset: float  # [rad or m]


@dataclass(frozen=True)
class LinkGeometry:
    """One convex piece of a link."""

    name: str  # as in the URDF, e.g. ``panda_link5_0``
    link: int  # pose row that it is fixed to: 0 is the world, j + 1 joint j
    T_link_geometry: np.ndarray  # (4, 4)
    vertices: np.ndarray  # (n, 3) corners of the hull in the geometry frame [m]
    # whether it is compared with other links alone, not with obstacles and loads
    self_only: bool = False

    def __post_init__(self) -> None:
        frozen((self.T_link_geometry, self.vertices))

    @property
    def vertices_in_link(self) -> np.ndarray:
        """Vertices (n, 3) in the frame of the link [m]."""
        return self.vertices @ self.T_link_geometry[:3, :3].T + self.T_link_geometry[:3, 3]

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        """Centre (3,) in the link's frame and radius of a ball that contains the piece [m]."""
        points = self.vertices_in_link
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        return centre, float(np.linalg.norm(points - centre, axis=1).max())


LIMIT_UNITS = {
    "velocity": "rad/s",
    "acceleration": "rad/s^2",
    "jerk": "rad/s^3",
    "effort": "Nm",
    "torque_rate": "Nm/s",
}
SLOW_SPEED = 0.1  # factor of the speed limits for a first try on a real arm (Panda: 0.2 rad/s)


Speed = Annotated[float, Condition(float, {"exclusiveMinimum": 0.0}, "a number above 0")]


@dataclass(frozen=True)
class FrameLimit:
    """Largest speeds of a frame of the robot in the world; None: not limited."""

    speed: Speed | None = None  # of its origin [m/s]
    turning_speed: Speed | None = None  # [rad/s]

    def __post_init__(self) -> None:
        if self.speed is None and self.turning_speed is None:
            raise InvalidInputError("a frame's limit has neither 'speed' nor 'turning_speed'")

    def within(self, other: "FrameLimit") -> "FrameLimit":
        """Return the smaller limit of each kind of both."""

        def least(*limits: float | None) -> float | None:
            return min((limit for limit in limits if limit is not None), default=None)

        return FrameLimit(
            least(self.speed, other.speed), least(self.turning_speed, other.turning_speed)
        )


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Largest rates and efforts of each joint, the same in both directions; None: unknown."""

    joint_names: tuple[str, ...]  # (n,), for messages
    velocity: np.ndarray  # (n,) [rad/s or m/s]
    acceleration: np.ndarray  # (n,) [rad/s^2 or m/s^2]
    jerk: np.ndarray | None = None  # (n,) [rad/s^3 or m/s^3]
    effort: np.ndarray | None = None  # (n,) torque or force of the motor [Nm or N]
    torque_rate: np.ndarray | None = None  # (n,) change of effort, over 1 ms [Nm/s or N/s]

    def __post_init__(self) -> None:
        for kind, unit in LIMIT_UNITS.items():
            if getattr(self, kind) is not None:
                # the joint of a door has infinite limits of these kinds
                unlimited = kind in ("jerk", "effort", "torque_rate")
                values = positive_per_joint(
                    kind, getattr(self, kind), self.joint_names, unit, unlimited
                )
                object.__setattr__(self, kind, values)

    def scaled(self, speed: float) -> "JointLimits":
        """Return limits with rates times `speed`, 0 < speed <= 1, and unchanged efforts."""
        if not 0.0 < speed <= 1.0:
            raise InvalidInputError(
                f"speed factor {speed}: give a number above 0 and at most 1 (full speed)"
            )
        return replace(
            self,
            velocity=speed * self.velocity,
            acceleration=speed * self.acceleration,
            jerk=None if self.jerk is None else speed * self.jerk,
        )


def positive_per_joint(
    what: str,
    values: float | Sequence[float] | np.ndarray,
    joint_names: Sequence[str],
    unit: str,
    unlimited: bool = False,
) -> np.ndarray:
    """Return limits (n,) of n joints after checks; a single number is used for all joints.

    Args:
        what: kind of limit, for messages, e.g. "jerk".
        values: (n,) or one number, above 0 and finite.
        joint_names: names of the n joints.
        unit: unit of the values, for messages.
        unlimited: whether infinity is allowed.

    Raises:
        InvalidInputError: wrong number of values, or a value out of range.
    """
    n = len(joint_names)
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{what} limits {values!r}: give {n} numbers [{unit}]") from error
    if array.ndim == 0:
        array = np.full(n, float(array))
    if array.shape != (n,):
        raise InvalidInputError(
            f"{what} limits have shape {array.shape}: give {n} numbers [{unit}], one each for "
            f"{', '.join(joint_names)}"
        )
    for name, value in zip(joint_names, array, strict=True):
        if not (value > 0.0 and (unlimited or np.isfinite(value))):
            raise InvalidInputError(
                f"{what} limit {value} of joint {name!r}: give a finite number above 0 [{unit}]"
            )
    return frozen(array)


@dataclass(frozen=True, eq=False)
class Robot:
    """A tree with n planned joints: an arm, or an arm and the door that it moves.

    Further joints may mimic planned ones: `followers`. Robots are made by `panda`, `load_robot` or
    `with_articulated_object`.
    """

    name: str
    source: dict  # field "robot" of a problem file that loads this robot again
    model: pin.Model  # of all joints, followers included; see `Kinematics.joint_values`
    collision_model: pin.GeometryModel  # meshes replaced by their convex hulls
    # frames of constraints and goals, by name: pose row of the link, T_link_frame (4, 4). A region
    # without a frame refers to the first one. A tool is a frame of its own, LINK/tool.
    end_effectors: Mapping[str, tuple[int, np.ndarray]]
    kinematics: Kinematics  # arrays for the kernels
    links: tuple[LinkGeometry, ...]  # convex pieces
    # pairs of indices into `links`: these are checked
    self_collision_pairs: tuple[tuple[int, int], ...]
    left_out_pairs: tuple[LeftOut, ...] = ()
    held_joints: tuple[HeldJoint, ...] = ()  # joints of the URDF that planning does not move
    followers: tuple[Follower, ...] = ()  # joints that mimic planned joints
    soft_limited: tuple[str, ...] = ()  # planned joints whose soft limits are narrower
    bodiless: tuple[str, ...] = ()  # links with a visual and no collision body, moving ones first
    remarks: tuple[str, ...] = ()  # on what was read of the URDF and SRDF otherwise than written
    # (n,) each, by the field's name in `JointLimits`; unknown ones and velocity are left out
    limits: Mapping[str, np.ndarray] = field(default_factory=dict)
    # largest speeds of frames of the robot, by the frame's name
    frame_limits: Mapping[str, FrameLimit] = field(default_factory=dict)
    files: tuple[tuple[str, str], ...] = ()  # path and sha256 of each source file
    # planned joints that the URDF calls continuous: configurations a whole turn apart are equal
    continuous: tuple[str, ...] = ()
    # the link that has the tool, as `end_effectors`: it can be named as a hand, too
    tool_links: Mapping[str, tuple[int, np.ndarray]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.frame_limits:
            require_choice(f"frame of robot {self.name} in frame_limits", name, self.frame_names)
        # problems share robots
        frozen((self.kinematics, *self.hands.values(), *self.limits.values()))

    def __repr__(self) -> str:
        hands, joints = " and ".join(self.end_effectors), ", ".join(self.joint_names)
        return (
            f"Robot {self.name!r}: {self.dof} joints, end effector {hands}, reach "
            f"{self.reach:.2f} m, {len(self.links)} convex pieces\njoints      {joints}"
        )

    @property
    def end_effector(self) -> str:
        """Name of the first end effector's frame."""
        return next(iter(self.end_effectors))

    @cached_property
    def hands(self) -> dict[str, tuple[int, np.ndarray]]:
        """All of `end_effectors` and `tool_links`."""
        return {**self.end_effectors, **self.tool_links}

    def hand(self, end_effector: str | None = None) -> tuple[int, np.ndarray]:
        """Return the pose row of one of `hands` and T_link_frame (4, 4); None: the first."""
        name = end_effector or self.end_effector
        require_choice(f"end effector of robot {self.name}", name, self.hands)
        return self.hands[name]

    def frame(self, name: str | None = None) -> tuple[int, np.ndarray]:
        """Return what `hand` and `link_of` return, of an end effector or any other body frame."""
        if name is None or name in self.hands:
            return self.hand(name)
        choices = dict.fromkeys((*self.end_effectors, *self.frame_names))
        require_choice(f"frame of robot {self.name}", name, choices)
        return self.link_of(name)

    @property
    def dof(self) -> int:
        """Number of planned joints n."""
        return len(self.kinematics.lower)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the n planned joints, in configuration order."""
        names = self.moving_joints
        return tuple(names[j] for j in self.kinematics.order[: self.dof])

    @property
    def moving_joints(self) -> tuple[str, ...]:
        """Names of all joints that move, followers included, in the order of `kinematics`."""
        return tuple(self.model.names)[1:]

    @property
    def lower(self) -> np.ndarray:
        """Lower joint limits (n,) [rad or m]."""
        return self.kinematics.lower

    @property
    def upper(self) -> np.ndarray:
        """Upper joint limits (n,) [rad or m]."""
        return self.kinematics.upper

    @cached_property
    def turns_freely(self) -> np.ndarray:
        """(n,) bool: planned hinges whose whole turns change no pose: no other joint follows."""
        k = self.kinematics
        return frozen(~k.prismatic[k.order[: self.dof]] & (np.bincount(k.entry) == 1))

    @cached_property
    def endless(self) -> np.ndarray:
        """(n,) bool: continuous joints that turn freely."""
        return frozen(self.turns_freely & np.isin(self.joint_names, self.continuous))

    def differences(self, states: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return states (..., n) - other (n,), of endless joints at most half a turn [rad or m]."""
        apart: np.ndarray = states - other
        return np.where(self.endless, nearest_turn(apart, 0.0), apart)

    @cached_property
    def turning(self) -> np.ndarray:
        """(n,) bool: joints that turn freely by more than one turn."""
        return frozen(self.turns_freely & (self.upper - self.lower > 2.0 * np.pi))

    def unit_of(self, joint: int, unit: str) -> str:
        """Replace rad by m (and Nm by N) in a unit if the joint is prismatic."""
        slides = self.kinematics.prismatic[self.kinematics.order[joint]]
        return unit.replace("Nm", "N").replace("rad", "m") if slides else unit

    def movers(self, row: int) -> np.ndarray:
        """Return (n,) bool: the planned joints that move a pose row, followers included."""
        k = self.kinematics
        return np.isin(np.arange(self.dof), k.entry[k.moves[:, row]])

    @property
    def nothing_collides(self) -> str:
        """Reason why no distance of the robot can be checked; "" if some moving link has a body."""
        if any(piece.link > 0 and not piece.self_only for piece in self.links):
            return ""
        cure = ": --visual-as-collision takes the visual ones" if self.bodiless else ""
        return f"none of the moving links has a collision body{cure}"

    @property
    def notes(self) -> list[str]:
        """Lines on what planning does otherwise than the robot's files may let expect."""
        notes = [f"nothing can collide: {self.nothing_collides}"] if self.nothing_collides else []
        if self.bodiless:
            notes.append(
                f"cannot collide: {few(self.bodiless)}, with a <visual> and no <collision>; "
                "--visual-as-collision takes the visual"
            )
        if self.soft_limited:
            notes.append(
                f"within the soft limits of {few(self.soft_limited)}; --hard-limits plans to the "
                "others"
            )
        always = [pair for pair in self.left_out_pairs if pair.reason.startswith(OVERLAP)]
        if always:
            notes.append(
                f"compared by nobody, because they overlap in every random state: "
                f"{LeftOut.named(always)}"
            )
        return [*notes, *self.remarks]

    @property
    def uncompared(self) -> str:
        """Pairs of links that nobody compares, in words; "" if all are compared."""
        pairs = self.left_out_pairs
        if not pairs:
            return ""
        return f"{len(pairs)} pairs of links, which nobody compares: {LeftOut.named(pairs)}"

    @property
    def velocity_limits(self) -> np.ndarray:
        """Velocity limits (n,) of the planned joints [rad/s or m/s]; 0 or inf where unknown."""
        return np.array(self.model.upperVelocityLimit)[self.kinematics.order[: self.dof]]

    @property
    def weightless(self) -> list[str]:
        """Joints of the arm whose link has no mass in the URDF; their efforts are unknown."""
        names = self.moving_joints
        arm = len(names) - ("articulated" in self.source)
        bodies = zip(names[:arm], list(self.model.inertias)[1:], strict=False)
        return [name for name, body in bodies if body.mass <= 0.0]

    @property
    def joint_limits(self) -> JointLimits:
        """Velocity limits of the URDF and the known others; refused without acceleration limits."""
        if "acceleration" not in self.limits:
            raise InvalidInputError(
                f"robot {self.name} has no acceleration limits, which a URDF cannot state: give "
                "load_robot(..., acceleration_limits=...), on the command line --acceleration, "
                "in a problem file 'acceleration_limits' of 'robot'"
            )
        unknown = np.array(self.joint_names)[~(self.velocity_limits > 0.0)]
        if len(unknown):
            raise InvalidInputError(
                f"robot {self.name} has velocity limits of 0 for {', '.join(unknown)}: give each "
                '<limit> of the URDF its motor\'s velocity="..." [rad/s or m/s], or give '
                "--velocity, in a problem file 'velocity_limits' of 'robot'"
            )
        return JointLimits(self.joint_names, self.velocity_limits, **self.limits)

    @cached_property
    def kinematics_digest(self) -> str:
        """Hash of joint names, placements, axes and limits; weights of a network belong to one."""
        k = self.kinematics
        digest = hashlib.sha256("\n".join(self.joint_names).encode())
        for array in (k.parent, k.prismatic, k.rotation, k.translation, k.lower, k.upper):
            # rounding errors of processors must not change the digest; + 0.0 turns -0.0 into 0.0
            rounded = np.round(array.astype(np.float64), 9) + 0.0
            digest.update(rounded.astype("<f8").tobytes())
        digest.update("".join(map(str, self.followers)).encode())
        return digest.hexdigest()[:32]

    @cached_property
    def farthest(self) -> np.ndarray:
        """Largest distance (p,) of the origin of each pose row from the base [m].

        The origin of joint j is at most |t_j| farther from the base than its parent's origin, for
        a prismatic joint |t_j| and its largest value.
        """
        k, slides = self.kinematics, self._slides
        distance = np.zeros(len(k.parent) + 1)
        for j in range(len(k.parent)):
            distance[j + 1] = distance[k.parent[j]] + np.linalg.norm(k.translation[j]) + slides[j]
        return frozen(distance)

    @property
    def _farthest_in_boxes(self) -> np.ndarray:
        """Bounds (p,) as `farthest`, nearer for robots with several sliders [m].

        Sliders behind the base or behind a hinge keep the orientation of its frame: the origins
        that they move stay in a box of this frame, whose farthest corner is nearer than the sum of
        all strokes.
        """
        k = self.kinematics
        if np.count_nonzero(k.prismatic) < 2:
            return self.farthest
        ends = k.joint_values(np.stack([k.lower, k.upper]))
        distance, start = np.zeros((2, len(k.parent) + 1))  # start: of the frame of the box
        turns, boxes = [np.eye(3)], [np.zeros((2, 3))]
        for j, parent in enumerate(k.parent):
            turn, box = turns[parent] @ k.rotation[j], boxes[parent]
            box = box + turns[parent] @ k.translation[j]
            if k.prismatic[j]:
                strokes = ends[:, j, None] * turn[:, 2]
                box = box + np.stack([strokes.min(axis=0), strokes.max(axis=0)])
            distance[j + 1] = start[parent] + np.linalg.norm(np.abs(box).max(axis=0))
            start[j + 1] = start[parent] if k.prismatic[j] else distance[j + 1]
            turns.append(turn if k.prismatic[j] else np.eye(3))
            boxes.append(box if k.prismatic[j] else np.zeros((2, 3)))
        return distance

    @cached_property
    def reach(self) -> float:
        """Radius [m] of a ball around the base that contains all moving links and end effectors."""
        distance = self._farthest_in_boxes
        ends = [distance[row] + np.linalg.norm(T[:3, 3]) for row, T in self.hands.values()]
        ends += [
            distance[piece.link] + np.linalg.norm(piece.vertices_in_link, axis=1).max()
            for piece in self.links
            if piece.link > 0
        ]
        return float(max(ends))

    def levers(self, carried: float = 0.0) -> np.ndarray:
        """Return bounds (n,) of any point's speed per unit speed of each joint [m/rad or m/m].

        For a revolute joint it is the largest distance from its origin to a point that it moves.

        carried: radius [m] of a ball around each of `hands` that contains its load.
        """
        far = np.zeros(len(self.kinematics.parent) + 1)
        for link, T in self.hands.values():
            far[link] = max(far[link], np.linalg.norm(T[:3, 3]) + carried)
        for piece in self.links:
            corners = np.linalg.norm(piece.vertices_in_link, axis=1).max()
            far[piece.link] = max(far[piece.link], corners)
        return self.speeds_from(far)

    def speeds_from(self, extent: np.ndarray) -> np.ndarray:
        """Return bounds (n,) of any point's speed per unit speed of each planned joint.

        extent: as of `joint_speeds_from`, (p,) [m].
        """
        return self.kinematics.summed(self.joint_speeds_from(extent))

    def joint_speeds_from(self, extent: np.ndarray) -> np.ndarray:
        """Return bounds (..., joints) of any point's speed per unit speed of each joint's driver.

        extent: (p, ...) distance [m] from the origin of each pose row to the farthest point fixed
            to it, -inf without such a point; overwritten by that to the farthest point that it
            moves.
        """
        k, slides = self.kinematics, self._slides
        for j in reversed(range(len(k.parent))):
            step = np.linalg.norm(k.translation[j]) + slides[j]
            extent[k.parent[j]] = np.maximum(extent[k.parent[j]], step + extent[j + 1])
        lever = extent[1:].T
        return np.abs(k.multiplier) * np.where(k.prismatic, lever > -np.inf, lever.clip(min=0.0))

    @property
    def _slides(self) -> np.ndarray:
        """Largest distances (joints,) that sliders move from their zero [m]; 0 of hinges."""
        k = self.kinematics
        ends = np.abs(k.joint_values(np.stack([k.lower, k.upper])))
        return np.where(k.prismatic, ends.max(axis=0), 0.0)

    @property
    def turn_rate(self) -> float:
        """Bound of any link's turn where each planned joint moves by 1 [rad]."""
        k = self.kinematics
        return float(np.abs(k.multiplier[~k.prismatic]).sum())

    def pose(self, q: np.ndarray, frame: str | None = None) -> np.ndarray:
        """Return T_world_frame (4, 4) of the end effector or a body frame at q (n,) [rad or m]."""
        return self.poses(np.asarray(q)[None], frame)[0]

    def poses(self, q: np.ndarray, frame: str | None = None) -> np.ndarray:
        """Return T_world_frame (k, 4, 4) at configurations (k, n), computed by pinocchio."""
        frame_id = self.frame_id(frame)
        poses = np.empty((len(q), 4, 4))
        data = self.model.createData()
        values = self.kinematics.joint_values(np.asarray(q, dtype=float))
        for T, row in zip(poses, values, strict=True):
            pin.forwardKinematics(self.model, data, row)
            T[:] = pin.updateFramePlacement(self.model, data, frame_id).homogeneous
        return poses

    def frame_id(self, frame: str | None) -> int:
        """Return pinocchio's number of a body frame, or of the end effector for None."""
        name = frame or self.end_effector
        if not self.model.existFrame(name, pin.FrameType.BODY):
            raise UnknownChoiceError(f"frame of robot {self.name}", name, self.frame_names)
        return int(self.model.getFrameId(name, pin.FrameType.BODY))

    def link_of(self, frame: str) -> tuple[int, np.ndarray]:
        """Return the pose row that a body frame is fixed to, and T_link_frame (4, 4)."""
        body = self.model.frames[self.frame_id(frame)]
        return in_link(axis_frames(self.model), body.parentJoint, body.placement)

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Names of the robot's body frames."""
        return tuple(f.name for f in self.model.frames if f.type == pin.FrameType.BODY)

    def joint_outside_limits(
        self, q: np.ndarray, tolerance: float = 1e-9
    ) -> tuple[str, float] | None:
        """Return the joint farthest outside its limits and its excess [rad or m], or None."""
        excess = np.maximum(self.lower - q, q - self.upper)
        worst = int(np.argmax(excess))
        if excess[worst] <= tolerance:
            return None
        return self.joint_names[worst], float(excess[worst])

    def random_configurations(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw uniform configurations (count, n) inside the limits [rad or m]."""
        return rng.uniform(self.lower, self.upper, (count, self.dof))


def axis_frames(model: pin.Model) -> list[np.ndarray]:
    """Return the rotation (3, 3) of the kernels' joint frame in pinocchio's, for each pose row.

    The z axis of a kernels' joint frame is the axis of the joint.
    """
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    z = np.array([0.0, 0.0, 1.0])
    frames = [np.eye(3)]
    for j in range(1, model.njoints):
        jacobian = pin.getJointJacobian(model, data, j, pin.ReferenceFrame.LOCAL)
        # pinocchio returns a vector for a model of one joint
        motion = jacobian.reshape(6, -1)[:, j - 1]
        axis = motion[3:] if np.linalg.norm(motion[3:]) > 0.5 else motion[:3]
        frames.append(pin.Quaternion.FromTwoVectors(z, axis).toRotationMatrix())
    return frames


def kinematics_arrays(
    model: pin.Model, frames: list[np.ndarray], followers: Sequence[Follower] = ()
) -> Kinematics:
    """Return a model's arrays for the kernels.

    Args:
        model: pinocchio's model of all joints.
        frames: result of `axis_frames`.
        followers: joints of the model that mimic others.
    """
    n, names = model.nq, list(model.names)[1:]
    leaders = {joint.name: joint.leader for joint in followers}
    own = [j for j, name in enumerate(names) if name not in leaders]
    entries = {names[j]: entry for entry, j in enumerate(own)}
    multiplier, offset = np.ones(n), np.full(n, -0.0)
    for joint in followers:
        j = names.index(joint.name)
        multiplier[j], offset[j] = joint.multiplier, joint.offset
    parent = np.array([model.parents[j + 1] for j in range(n)], dtype=np.int64)
    rotation, translation = np.empty((n, 3, 3)), np.empty((n, 3))
    moves = np.zeros((n, n + 1), dtype=bool)
    for j in range(n):
        placement = model.jointPlacements[j + 1]
        R_parent = frames[parent[j]]
        rotation[j] = R_parent.T @ placement.rotation @ frames[j + 1]
        translation[j] = R_parent.T @ placement.translation
        moves[[above - 1 for above in model.supports[j + 1] if above > 0], j + 1] = True
    kinds = [joint.shortname() for joint in list(model.joints)[1:]]
    return Kinematics(
        parent=parent,
        rotation=rotation,
        translation=translation,
        prismatic=np.array([kind.startswith("JointModelP") for kind in kinds]),
        lower=np.array(model.lowerPositionLimit)[own],
        upper=np.array(model.upperPositionLimit)[own],
        moves=moves,
        entry=np.array([entries[leaders.get(name, name)] for name in names], dtype=np.int64),
        multiplier=multiplier,
        offset=offset,
        order=np.array(own + [names.index(name) for name in leaders], dtype=np.int64),
    )


def in_link(frames: list[np.ndarray], joint: int, placement: pin.SE3) -> tuple[int, np.ndarray]:
    """Return the pose row and (4, 4) placement of an item that pinocchio attaches to a joint."""
    T = placement.homogeneous
    T[:3] = frames[joint].T @ T[:3]
    return int(joint), T
