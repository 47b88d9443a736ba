"""Limits of a robot: rates and efforts of its joints, speeds of its frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.values import Condition, frozen

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
