"""A robot in a scene in MuJoCo: moved by a controller at 1 kHz, with contacts and states recorded.

The gains are relative to the effort limits and the same for all arms: at an error of 1 / STIFFNESS
a joint applies its full effort limit. Every controller keeps the arm's effort limits.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, require_choice, require_installed
from cvqmpt_lab.base.poses import rigid
from cvqmpt_lab.features.motion.trajectory import JointState, Trajectory
from cvqmpt_lab.features.physics.mjcf import (
    ARMATURE,
    DAMPING,
    HAND_SITE,
    LOAD_BODY,
    Physics,
    mjcf_of,
    unchecked_pairs,
)
from cvqmpt_lab.robot.dynamics import Dynamics, Load, without_effort_limit
from cvqmpt_lab.robot.load import gripper_joints, opening_sign, with_gripper
from cvqmpt_lab.robot.robot import Follower, Robot
from cvqmpt_lab.scene.scene import Scene

CONTROL_PERIOD_S = 1e-3
# [1/rad], [s]: Kp = STIFFNESS x effort limit, 3000 Nm/rad at the Panda's shoulder as in libfranka's
# setDefaultBehavior; Kd = TIME_CONSTANT Kp, a damping ratio of 0.5 to 1.2 at 0.1 to 3 kg m^2
STIFFNESS, TIME_CONSTANT = 35.0, 0.04
CONTROLLERS = {
    "computed-torque": "tau = RNEA(q_d, q_d', q_d'') + Kp (q_d - q) + Kd (q_d' - q'); masses of "
    "arm and load, rotors and damping are known",
    "computed-torque-unknown-load": "the same, but load, rotors and damping are not known",
    "position-servo": "tau = g(q) + Kp (q_d - q) - Kd q', stiffer; the load is not known",
}
GRIP_FORCE_N, OPEN_FORCE_N = -50.0, 30.0  # on each finger


class Controller:
    """A controller by its name in `CONTROLLERS`."""

    def __init__(self, name: str, robot: Robot) -> None:
        """Make a controller; InvalidInputError if the robot has no effort limits or masses.

        Args:
            name: a key of `CONTROLLERS`.
            robot: the arm with its gripper held.
        """
        require_choice("controller", name, CONTROLLERS)
        if why := without_effort_limit(robot):
            raise InvalidInputError(
                f"robot {robot.name} cannot be executed: {why}; give a URDF with masses, and "
                "--effort"
            )
        self.name, self.robot = name, robot
        self.limits = robot.limits["effort"]  # (n,) [Nm or N]
        self.carry(())

    def carry(self, loads: Sequence[Load]) -> None:
        """Set the loads that the arm carries from now on."""
        known = loads if self.name == "computed-torque" else ()
        dynamics = Dynamics.of(self.robot, known)
        assert dynamics is not None
        self._dynamics = dynamics

    def efforts(self, wanted: JointState, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Efforts (n,) [Nm or N] at positions q and velocities v (n,), within the limits."""
        off = wanted.positions - q
        if self.name == "position-servo":
            gravity = self._dynamics.gravity(q[None])[0]
            # gains of MuJoCo Menagerie's Panda
            tau = gravity + 50.0 * self.limits * (off - 0.1 * v)
        else:
            Kp = STIFFNESS * self.limits
            tau = self._dynamics.efforts(*(x[None] for x in wanted))[0]
            tau = tau + Kp * (off + TIME_CONSTANT * (wanted.velocities - v))
            if self.name == "computed-torque":
                tau = tau + ARMATURE * wanted.accelerations + DAMPING * wanted.velocities
        return np.clip(tau, -self.limits, self.limits)


class Contact(NamedTuple):
    """An unwanted contact of two bodies."""

    first: str
    second: str
    depth_m: float  # largest penetration depth
    time_s: float  # time of that depth


class Rest(NamedTuple):
    """Place at which a load stands before it is lifted, or after it is put down."""

    place: np.ndarray  # (3,) position of the load [m]
    supports: frozenset[int]  # geoms on which it stands there


class Sample(NamedTuple):
    """State at one time of an execution."""

    time: float  # [s]
    phase: str  # name of the problem or phase
    source: Mapping[str, Any]  # of the arm, with the commanded gripper opening
    q: np.ndarray  # (n,) of the arm [rad or m]
    doors: dict[str, float]  # values of the articulations [rad or m]
    T_world_load: np.ndarray | None  # (4, 4) [m]; None: there is no load


def mujoco_module() -> Any:
    """Import MuJoCo; InvalidInputError if it is not installed."""
    require_installed("mujoco", "executing", "physics")
    import mujoco

    return mujoco


class Simulation:
    """Simulation of a robot in a scene, with the doors and the load of `Physics`.

    Args:
        arm: the arm with its gripper held.
        scene: the scene at the beginning, without the load.
        q: configuration (n,) of the arm at the beginning [rad or m].
        controller: controller of the arm.
        physics: contact time, doors and load.
        gripper: whether the fingers move; else they stay where the arm's source holds them.
    """

    def __init__(
        self,
        arm: Robot,
        scene: Scene,
        q: np.ndarray,
        controller: Controller,
        physics: Physics,
        gripper: bool,
    ) -> None:
        self.mujoco = mujoco_module()
        self.scene, self.controller = scene, controller
        robot = arm
        if gripper:
            robot = with_gripper(arm)
            fixed_pairs = tuple(unchecked_pairs(arm))  # pieces of both have the same order
            physics = physics._replace(fingers=_fingers(arm, robot), unchecked=fixed_pairs)
        self.physics = physics
        text = mjcf_of(robot, scene, physics)
        self.model = model = self.mujoco.MjModel.from_xml_string(text)
        self.data = data = self.mujoco.MjData(model)
        joints = [model.joint(name) for name in arm.joint_names]
        self._q = np.array([joint.qposadr[0] for joint in joints])
        self._v = np.array([joint.dofadr[0] for joint in joints])
        self._motors = np.array([model.actuator(name).id for name in arm.joint_names])
        self._fingers = np.array([model.actuator(name).id for name in physics.fingers], dtype=int)
        others = {name: [o for o in physics.fingers if o != name] for name in physics.fingers}
        self._opens = np.array([opening_sign(robot, *finger) for finger in others.items()])
        # numbers of geoms: piece, obstacle and load may share a name
        pieces = [model.geom(f"piece_{k}_geom").id for k in range(len(robot.links))]
        self._pieces = {item.name: k for item, k in zip(robot.links, pieces, strict=True)}
        # a solid has one geom, a map or cloud one for each box
        self.obstacles = {
            item.name: _geoms(model.body(f"obstacle_{k}")) for k, item in enumerate(scene.obstacles)
        }
        self.loads = frozenset(range(model.ngeom)).difference(pieces, *self.obstacles.values())
        labels = {k: name for name, k in self._pieces.items()}
        labels |= {k: name for name, geoms in self.obstacles.items() for k in geoms}
        self.names = [labels.get(k, LOAD_BODY) for k in range(model.ngeom)]
        moving = [model.joint(name).qposadr[0] for name in arm.moving_joints]
        data.qpos[moving] = arm.kinematics.joint_values(q)
        held = {joint.name: joint.value for joint in arm.held_joints}
        for name in physics.fingers:
            data.qpos[model.joint(name).qposadr[0]] = held[name]
        self.mujoco.mj_forward(model, data)
        self.force = OPEN_FORCE_N  # of each finger [N]
        self.phase, self.source = "", arm.source
        self.samples: list[Sample] = []
        self.touched: dict[tuple[str, str], Contact] = {}
        self.allowed: set[frozenset[int]] = set()  # pairs of geoms that may touch
        self.rests: tuple[Rest, Rest] | None = None  # where the load is taken and put down
        self._lifted = False  # whether the load has left its first rest
        self.errors: list[float] = []  # largest |q_d - q| of each period [rad or m]
        self.saturated = 0  # periods in which an effort limit was reached
        self._periods = 0

    @property
    def q(self) -> np.ndarray:
        """Positions (n,) of the arm's joints."""
        return self.data.qpos[self._q].copy()

    @property
    def T_world_hand(self) -> np.ndarray:
        """Pose (4, 4) [m] of the hand."""
        site = self.data.site(HAND_SITE)
        return rigid(site.xmat.reshape(3, 3), site.xpos)

    @property
    def T_world_load(self) -> np.ndarray | None:
        """Pose (4, 4) [m] of the load; None: there is no load."""
        if self.physics.free is None and not self.physics.welded:
            return None
        body = self.data.body(LOAD_BODY)
        return rigid(body.xmat.reshape(3, 3), body.xpos)

    @property
    def doors(self) -> dict[str, float]:
        """Values of the articulations that can move [rad or m]."""
        return {
            name: self.scene.articulation(name).value + float(self.data.joint(name).qpos[0])
            for name in self.physics.doors
        }

    def follow(self, motion: Trajectory) -> None:
        """Execute a motion of the arm, whose times may begin after 0."""
        times = np.arange(0.0, motion.duration + CONTROL_PERIOD_S, CONTROL_PERIOD_S)
        for state in zip(*motion.at(times), strict=True):
            self._step(JointState(*state))

    def hold(self, q: np.ndarray, seconds: float) -> None:
        """Stay at q (n,) [rad or m]."""
        still = np.zeros_like(q)
        for _ in range(round(seconds / CONTROL_PERIOD_S)):
            self._step(JointState(q, still, still))

    def _step(self, wanted: JointState) -> None:
        """Simulate one control period; record contacts, and every tenth period the state."""
        data = self.data
        tau = self.controller.efforts(wanted, data.qpos[self._q], data.qvel[self._v])
        self.saturated += bool((np.abs(tau) >= self.controller.limits).any())
        data.ctrl[self._motors] = tau
        data.ctrl[self._fingers] = self.force * self._opens
        self.mujoco.mj_step(self.model, data, nstep=round(CONTROL_PERIOD_S / self.physics.step))
        self.errors.append(float(np.abs(data.qpos[self._q] - wanted.positions).max()))
        self._lifted = self._lifted or not self._is_at(0)
        depths = data.contact.includemargin - data.contact.dist
        for geoms, depth in zip(data.contact.geom.tolist(), depths, strict=True):
            self._touch(frozenset(geoms), float(depth))
        if self._periods % 10 == 0:
            self.samples.append(
                Sample(data.time, self.phase, self.source, self.q, self.doors, self.T_world_load)
            )
        self._periods += 1

    def allow(self, hand: Iterable[str], held: Iterable[str] | None) -> None:
        """Let pieces of the hand touch these obstacles alone, or the load if `held` is None."""
        touched = self.loads if held is None else [k for name in held for k in self.obstacles[name]]
        self.allowed = {frozenset((self._pieces[name], k)) for name in hand for k in touched}

    def _is_at(self, which: int) -> bool:
        """Whether the load is within 2 cm of its first or its second rest."""
        if self.rests is None:
            return False
        place = self.data.body(LOAD_BODY).xpos
        return bool(np.linalg.norm(place - self.rests[which].place) < 0.02)

    def _touch(self, geoms: frozenset[int], depth: float) -> None:
        """Record a contact of a penetration depth [m] unless the two bodies may touch."""
        if depth < 0.0 or geoms in self.allowed:
            return
        if self.rests is not None and geoms & self.loads:
            others, (first, last) = geoms - self.loads, self.rests
            if others <= first.supports and not self._lifted:
                return
            if others <= last.supports and self._is_at(1):
                return
        pair = min(names := [self.names[k] for k in geoms]), max(names)
        if pair not in self.touched or depth > self.touched[pair].depth_m:
            self.touched[pair] = Contact(*pair, depth, self.data.time)


def _geoms(body: Any) -> range:
    """Return the numbers of the geoms of a body of a model."""
    first = int(body.geomadr[0])
    return range(first, first + int(body.geomnum[0]))


def _fingers(arm: Robot, robot: Robot) -> Mapping[str, Follower | None]:
    """Return the gripper's joints, each with what it follows, or None; refuses hinges."""
    joints = gripper_joints(arm)
    turning = [joint.name for joint in joints if joint.kind != "prismatic"]
    if turning or not joints:
        what = f"turns {', '.join(turning)}" if turning else "has no fingers"
        raise InvalidInputError(
            f"the gripper of {arm.name} {what}: only fingers on sliders behind the arm's last "
            "joint are simulated; a problem's load can be welded instead, --hold weld, and a task "
            "needs such fingers"
        )
    names = [joint.name for joint in joints]
    return {
        joint.name: Follower(joint.name, joint.mimics, joint.multiplier, joint.offset)
        if joint.mimics in names
        else None
        for joint in sorted(joints, key=lambda joint: robot.joint_names.index(joint.name))
    }
