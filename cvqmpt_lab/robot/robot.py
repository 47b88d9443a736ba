"""A robot arm: its joints, limits and collision geometry.

`Robot` has its model twice: as pinocchio objects for the exact backend and the certificate, and as
arrays for the compiled kernels. Tests compare the two.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.base.values import frozen
from cvqmpt_lab.robot.kinematics import Kinematics
from cvqmpt_lab.robot.urdf import HeldJoint


class LeftOut(NamedTuple):
    """Two links, or a link and a piece of a door, that are not checked against each other, and why.

    Reasons: "SRDF: " and its maker's word; "fixed to each other"; "adjacent" (one joint between
    them); "overlap in N % of random states" (by sampling: convex hulls too large); "may touch" (a
    hand and the door it holds, says the problem file); "casing" (a door and its fixed frame).
    """

    first: str
    second: str
    reason: str  # as in the docstring


@dataclass(frozen=True)
class LinkGeometry:
    """One convex piece of a link."""

    name: str  # as in the URDF, e.g. ``panda_link5_0``
    link: int  # pose row that carries it: 0 is the world, j + 1 joint j
    T_link_geometry: np.ndarray  # (4, 4)
    vertices: np.ndarray  # (n, 3) corners of the hull in the geometry frame [m]

    def __post_init__(self) -> None:
        frozen((self.T_link_geometry, self.vertices))

    @property
    def vertices_in_link(self) -> np.ndarray:
        """The same (n, 3) in the frame of the link [m]."""
        return self.vertices @ self.T_link_geometry[:3, :3].T + self.T_link_geometry[:3, 3]

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        """Centre (3,) in the link's frame and radius of a ball around the piece [m]."""
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
SLOW = 0.1  # share of the speed limits for first tries on a real arm: 0.2 rad/s on the Panda


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Largest rates and efforts of each joint, both directions alike; None: not known."""

    joint_names: tuple[str, ...]  # n names, for messages
    velocity: np.ndarray  # (n,) [rad/s or m/s]
    acceleration: np.ndarray  # (n,) [rad/s^2 or m/s^2]
    jerk: np.ndarray | None = None  # (n,) [rad/s^3 or m/s^3]
    effort: np.ndarray | None = None  # torque or force of the motor (n,) [Nm or N]
    torque_rate: np.ndarray | None = None  # change of effort within 1 ms, a second (n,) [Nm/s, N/s]

    def __post_init__(self) -> None:
        for kind, unit in LIMIT_UNITS.items():
            if getattr(self, kind) is not None:
                # a door that is moved limits neither jerk nor effort
                known = kind in ("jerk", "effort", "torque_rate")
                values = positive_per_joint(
                    kind, getattr(self, kind), self.joint_names, unit, unlimited=known
                )
                object.__setattr__(self, kind, values)

    def scaled(self, speed: float) -> "JointLimits":
        """Rates times speed, a number above 0 and at most 1; efforts as they are."""
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
    """Limits (n,), positive and finite, one a joint; a single number is used for all joints.

    unlimited: infinity is allowed.
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
    """A tree of n one-degree-of-freedom joints: an arm, or an arm and the door it moves.

    Made by `panda`, `load_robot` or `with_articulated_object`.
    """

    name: str
    source: dict  # field "robot" of a problem file that loads this robot again
    model: pin.Model
    collision_model: pin.GeometryModel  # meshes replaced by their convex hulls
    # frames that constraints and goals are about, the first where a region names none: pose row of
    # the link, T_link_frame (4, 4)
    end_effectors: Mapping[str, tuple[int, np.ndarray]]
    kinematics: Kinematics  # arrays for the kernels
    links: tuple[LinkGeometry, ...]  # convex pieces
    # indices into `links` of the pairs that are checked
    self_collision_pairs: tuple[tuple[int, int], ...]
    left_out_pairs: tuple[LeftOut, ...] = ()
    held_joints: tuple[HeldJoint, ...] = ()  # joints of the URDF that planning does not move
    # (n,) each, of the kinds of `JointLimits` that are known, without velocity
    limits: Mapping[str, np.ndarray] = field(default_factory=dict)
    files: tuple[tuple[str, str], ...] = ()  # path and sha256 of each file that it was built from

    def __post_init__(self) -> None:
        # problems share robots
        frozen((self.kinematics, *self.end_effectors.values(), *self.limits.values()))

    def __repr__(self) -> str:
        return (
            f"Robot {self.name!r}: {self.dof} joints, end effector "
            f"{' and '.join(self.end_effectors)}, "
            f"reach {self.reach:.2f} m, {len(self.links)} convex pieces\n"
            f"joints      {', '.join(self.joint_names)}"
        )

    @property
    def end_effector(self) -> str:
        """The first end effector's frame."""
        return next(iter(self.end_effectors))

    @property
    def end_effector_link(self) -> tuple[int, np.ndarray]:
        """Pose row of the first end effector's link, and T_link_frame (4, 4)."""
        return next(iter(self.end_effectors.values()))

    def hand(self, end_effector: str | None = None) -> tuple[int, np.ndarray]:
        """Pose row of an end effector's link, None: the first one's, and T_link_frame (4, 4)."""
        name = end_effector or self.end_effector
        require_choice(f"end effector of robot {self.name}", name, self.end_effectors)
        return self.end_effectors[name]

    @property
    def dof(self) -> int:
        """Number of joints n."""
        return self.model.nq

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the n moving joints, in configuration order."""
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
    def turning(self) -> np.ndarray:
        """Which joints turn more than once, (n,) bool."""
        return frozen(~self.kinematics.prismatic & (self.upper - self.lower > 2.0 * np.pi))

    @property
    def weightless(self) -> list[str]:
        """Joints of the arm whose link has no mass in the URDF: no effort can be computed."""
        arm = self.dof - ("articulated" in self.source)
        masses = zip(self.joint_names[:arm], list(self.model.inertias)[1:], strict=False)
        return [name for name, body in masses if body.mass <= 0.0]

    @property
    def joint_limits(self) -> JointLimits:
        """Velocity limits of the URDF and all others that are known, of acceleration at least."""
        if "acceleration" not in self.limits:
            raise InvalidInputError(
                f"robot {self.name} has no acceleration limits, which a URDF cannot state: give "
                "load_robot(..., acceleration_limits=...), on the command line --acceleration, "
                "in a problem file 'acceleration_limits' of 'robot'"
            )
        velocity = np.array(self.model.upperVelocityLimit)
        return JointLimits(self.joint_names, velocity, **self.limits)

    @cached_property
    def kinematics_digest(self) -> str:
        """Hash of joint names, placements, axes and limits, not shapes; weights belong to one."""
        k = self.kinematics
        digest = hashlib.sha256("\n".join(self.joint_names).encode())
        for array in (k.parent, k.prismatic, k.rotation, k.translation, k.lower, k.upper):
            # rounding of compilers and processors must not show in the digest; no minus zero
            rounded = np.round(array.astype(np.float64), 9) + 0.0
            digest.update(rounded.astype("<f8").tobytes())
        return digest.hexdigest()[:32]

    @cached_property
    def reach(self) -> float:
        """Radius [m] of a ball around the base that no moving link or end-effector frame leaves.

        The distance of joint j's origin is at most that of its parent's plus |t_j|, and for a
        slider plus max(|lower|, |upper|).
        """
        k = self.kinematics
        distance = np.zeros(self.dof + 1)
        for j in range(self.dof):
            slide = max(abs(k.lower[j]), abs(k.upper[j])) if k.prismatic[j] else 0.0
            distance[j + 1] = distance[k.parent[j]] + np.linalg.norm(k.translation[j]) + slide
        ends = [distance[row] + np.linalg.norm(T[:3, 3]) for row, T in self.end_effectors.values()]
        ends += [
            distance[piece.link] + np.linalg.norm(piece.vertices_in_link, axis=1).max()
            for piece in self.links
            if piece.link > 0
        ]
        return float(max(ends))

    def levers(self, carried: float = 0.0) -> np.ndarray:
        """Bounds (n,) on the speed of any point, per unit speed of each joint [m/rad or m/m].

        Of a hinge, the largest distance from its origin to a point that it moves.

        carried: radius of a ball around each end effector with what it carries [m].
        """
        k, far = self.kinematics, np.zeros(self.dof + 1)
        for link, T in self.end_effectors.values():
            far[link] = max(far[link], np.linalg.norm(T[:3, 3]) + carried)
        for piece in self.links:
            corners = np.linalg.norm(piece.vertices_in_link, axis=1).max()
            far[piece.link] = max(far[piece.link], corners)
        slides = np.where(k.prismatic, np.maximum(np.abs(k.lower), np.abs(k.upper)), 0.0)
        for j in reversed(range(self.dof)):
            beyond = np.linalg.norm(k.translation[j]) + slides[j] + far[j + 1]
            far[k.parent[j]] = max(far[k.parent[j]], beyond)
        return np.where(k.prismatic, 1.0, far[1:])

    def pose(self, q: np.ndarray, frame: str | None = None) -> np.ndarray:
        """T_world_frame (4, 4) of the end effector or a named body frame, at q (n,) [rad or m]."""
        return self.poses(np.asarray(q)[None], frame)[0]

    def poses(self, q: np.ndarray, frame: str | None = None) -> np.ndarray:
        """T_world_frame (k, 4, 4) at configurations (k, n), by pinocchio."""
        name = frame or self.end_effector
        if not self.model.existFrame(name, pin.FrameType.BODY):
            raise InvalidInputError(
                f"robot {self.name} has no frame {name!r}; see `Robot.frame_names`"
            )
        frame_id = self.model.getFrameId(name, pin.FrameType.BODY)
        poses, data = np.empty((len(q), 4, 4)), self.model.createData()
        for T, row in zip(poses, np.asarray(q, dtype=float), strict=True):
            pin.forwardKinematics(self.model, data, row)
            T[:] = pin.updateFramePlacement(self.model, data, frame_id).homogeneous
        return poses

    def link_of(self, frame: str) -> tuple[int, np.ndarray]:
        """Pose row that carries a body frame, and T_link_frame (4, 4)."""
        require_choice(f"frame of robot {self.name}", frame, self.frame_names)
        body = self.model.frames[self.model.getFrameId(frame, pin.FrameType.BODY)]
        return in_link(axis_frames(self.model), body.parentJoint, body.placement)

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Names of the robot's body frames."""
        return tuple(f.name for f in self.model.frames if f.type == pin.FrameType.BODY)

    def joint_outside_limits(
        self, q: np.ndarray, tolerance: float = 1e-9
    ) -> tuple[str, float] | None:
        """Name of the joint furthest outside its limits and by how much [rad or m], or None."""
        excess = np.maximum(self.lower - q, q - self.upper)
        worst = int(np.argmax(excess))
        if excess[worst] <= tolerance:
            return None
        return self.joint_names[worst], float(excess[worst])

    def random_configurations(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Uniform configurations (count, n) inside the limits [rad or m]."""
        return rng.uniform(self.lower, self.upper, (count, self.dof))


def axis_frames(model: pin.Model) -> list[np.ndarray]:
    """Rotation (3, 3) of each pose row that turns pinocchio's joint frame: its z is the joint axis.

    The kernels' joint frames are these.
    """
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    z = np.array([0.0, 0.0, 1.0])
    frames = [np.eye(3)]
    for j in range(1, model.njoints):
        jacobian = pin.getJointJacobian(model, data, j, pin.ReferenceFrame.LOCAL)
        # of one joint, pinocchio gives a vector
        motion = jacobian.reshape(6, -1)[:, j - 1]
        axis = motion[3:] if np.linalg.norm(motion[3:]) > 0.5 else motion[:3]
        frames.append(pin.Quaternion.FromTwoVectors(z, axis).toRotationMatrix())
    return frames


def kinematics_arrays(model: pin.Model, frames: list[np.ndarray]) -> Kinematics:
    """Arrays of a model for the kernels; frames: of `axis_frames`."""
    n = model.nq
    parent = np.array([model.parents[j + 1] for j in range(n)], dtype=np.int64)
    rotation, translation = np.empty((n, 3, 3)), np.empty((n, 3))
    moves = np.zeros((n, n + 1), dtype=bool)
    for j in range(n):
        placement, R_parent = model.jointPlacements[j + 1], frames[parent[j]]
        rotation[j] = R_parent.T @ placement.rotation @ frames[j + 1]
        translation[j] = R_parent.T @ placement.translation
        moves[[above - 1 for above in model.supports[j + 1] if above > 0], j + 1] = True
    kinds = [joint.shortname() for joint in list(model.joints)[1:]]
    return Kinematics(
        parent=parent,
        rotation=rotation,
        translation=translation,
        prismatic=np.array([kind.startswith("JointModelP") for kind in kinds]),
        lower=np.array(model.lowerPositionLimit),
        upper=np.array(model.upperPositionLimit),
        moves=moves,
    )


def in_link(frames: list[np.ndarray], joint: int, placement: pin.SE3) -> tuple[int, np.ndarray]:
    """Pose row and (4, 4) placement of something that pinocchio attaches to a joint."""
    T = placement.homogeneous
    T[:3] = frames[joint].T @ T[:3]
    return int(joint), T
