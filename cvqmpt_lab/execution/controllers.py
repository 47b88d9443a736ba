"""Controllers of an arm at 1 kHz: efforts from the state that is wanted and the state that is.

Gains are the same for any arm: a joint gives its whole effort limit at an error of 1 / STIFFNESS.
Every controller is limited by the arm's effort limits.
"""

from collections.abc import Sequence

import numpy as np

from cvqmpt_lab.errors import InvalidInputError, require_choice
from cvqmpt_lab.execution.mjcf import ARMATURE, DAMPING
from cvqmpt_lab.robot.dynamics import Dynamics, Load, without_effort_limit
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.trajectory.trajectory import JointState

PERIOD = 1e-3  # [s] of control
# [1/rad], [s]: Kp = STIFFNESS x effort limit, 3000 Nm/rad at the Panda's shoulder as in libfranka's
# setDefaultBehavior; Kd = TIME_CONSTANT Kp damps joints of 0.1 to 3 kg m^2 by 0.5 to 1.2
STIFFNESS, TIME_CONSTANT = 35.0, 0.04
SERVO_STIFFNESS, SERVO_TIME_CONSTANT = 50.0, 0.1  # as in MuJoCo Menagerie's Panda
CONTROLLERS = {
    "computed-torque": "tau = RNEA(q_d, q_d', q_d'') + Kp (q_d - q) + Kd (q_d' - q'); masses of "
    "arm and load, rotors and damping are known",
    "computed-torque-unknown-load": "the same, but load, rotors and damping are not known",
    "position-servo": "tau = g(q) + Kp (q_d - q) - Kd q', stiffer; the load is not known",
}


class Controller:
    """A controller by its name in `CONTROLLERS`."""

    def __init__(self, name: str, robot: Robot) -> None:
        """robot: the arm with its gripper closed; InvalidInputError where efforts are not known."""
        require_choice("controller", name, CONTROLLERS)
        if why := without_effort_limit(robot):
            raise InvalidInputError(
                f"robot {robot.name} cannot be executed: {why}; give a URDF with masses, and "
                "--effort"
            )
        self.name, self.robot, self.limits = name, robot, robot.limits["effort"]
        self.carry(())

    def carry(self, loads: Sequence[Load]) -> None:
        """Take up loads, or put them down."""
        known = loads if self.name == "computed-torque" else ()
        dynamics = Dynamics.of(self.robot, known)
        assert dynamics is not None
        self._dynamics = dynamics

    def efforts(self, wanted: JointState, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Efforts (n,) [Nm or N] at q and q' (n,), within the limits."""
        off = wanted.positions - q
        if self.name == "position-servo":
            gravity = self._dynamics.gravity(q[None])[0]
            Kp = SERVO_STIFFNESS * self.limits
            tau = gravity + Kp * (off - SERVO_TIME_CONSTANT * v)
        else:
            Kp = STIFFNESS * self.limits
            tau = self._dynamics.efforts(*(x[None] for x in wanted))[0]
            tau = tau + Kp * (off + TIME_CONSTANT * (wanted.velocities - v))
            if self.name == "computed-torque":
                tau = tau + ARMATURE * wanted.accelerations + DAMPING * wanted.velocities
        return np.clip(tau, -self.limits, self.limits)
