"""How fast joints may move and how hard they may speed up.

Positions are limited elsewhere (`Robot.lower`, `Robot.upper`). A URDF states velocity limits but has no
place for acceleration limits, so those come from the maker's data sheet. Jerk is not limited here.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.errors import InvalidInputError

SLOW = 0.1  # of the limits: 0.2 rad/s on the Panda, the pace of first tries on a real arm
PANDA_ACCELERATION = (15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0)  # [rad/s^2], data sheet; velocities: its URDF


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Largest speed and acceleration of each joint, both directions alike."""

    joint_names: tuple[str, ...]
    """n names, for messages."""
    velocity: np.ndarray
    """(n,) [rad/s or m/s]."""
    acceleration: np.ndarray
    """(n,) [rad/s^2 or m/s^2]."""

    def __post_init__(self) -> None:
        for name, unit in (("velocity", "rad/s"), ("acceleration", "rad/s^2")):
            values = positive_per_joint(f"{name} limit", getattr(self, name), self.joint_names, unit)
            object.__setattr__(self, name, values)

    def scaled(self, speed: float) -> "JointLimits":
        """Both limits times speed, a number above 0 and at most 1."""
        if not 0.0 < speed <= 1.0:
            raise InvalidInputError(f"speed factor {speed}: give a number above 0 and at most 1 (full speed)")
        return JointLimits(self.joint_names, speed * self.velocity, speed * self.acceleration)


def positive_per_joint(
    what: str, values: float | Sequence[float] | np.ndarray, joint_names: Sequence[str], unit: str
) -> np.ndarray:
    """Finite positive numbers (n,), one a joint; a single number serves all joints."""
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{what}s {values!r}: give {len(joint_names)} numbers [{unit}]") from error
    if array.ndim == 0:
        array = np.full(len(joint_names), float(array))
    if array.shape != (len(joint_names),):
        names = ", ".join(joint_names)
        raise InvalidInputError(
            f"{what}s have shape {array.shape}: give {len(joint_names)} numbers [{unit}], one each for {names}"
        )
    for name, value in zip(joint_names, array, strict=True):
        if not (np.isfinite(value) and value > 0.0):
            raise InvalidInputError(
                f"{what} {value} of joint {name!r}: give a finite number above 0 [{unit}]"
            )
    array.flags.writeable = False
    return array
