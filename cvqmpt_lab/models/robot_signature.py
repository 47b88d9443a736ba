"""Which robot weights were trained for: what is kept beside them, and compared with the robot at hand."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

from cvqmpt_lab.errors import InvalidInputError

LIMIT_TOLERANCE = 1e-4
"""Joint limits that differ by less are the same robot's [rad or m]."""


class OtherRobotError(InvalidInputError):
    """Weights of one robot were about to be used for another."""

    def __init__(self, weights: "RobotSignature", robot: "RobotSignature", differences: list[str]) -> None:
        name = "this one" if weights.name == robot.name else repr(robot.name)
        super().__init__(
            f"weights are for robot {weights.name!r}, not {name}: {'; '.join(differences)}; "
            "choose weights trained for it"
        )
        self.weights = weights
        self.robot = robot
        self.differences = differences


@dataclass(frozen=True)
class RobotSignature:
    """A robot as weights remember it. Where a digest is known, names of robots are labels only."""

    name: str
    lower: tuple[float, ...]
    """(n,), by which joints are scaled [rad or m]."""
    upper: tuple[float, ...]
    """(n,) [rad or m]."""
    joints: tuple[str, ...] = ()
    """(n,) names; empty where an earlier version did not record them."""
    kinematics: str = ""
    """`Robot.kinematics_digest`; likewise."""

    def require_same(self, other: "RobotSignature") -> None:
        """Compare with the robot at hand.

        Raises
        ------
        OtherRobotError
            Naming the differences.
        """
        differences = self.differences(other)
        if differences:
            raise OtherRobotError(self, other, differences)

    def differences(self, other: "RobotSignature") -> list[str]:
        """How `other` differs, in words, nothing when it is this robot."""
        if len(self.lower) != len(other.lower):
            return [f"{len(self.lower)} joints, not {len(other.lower)}"]
        if self.joints and other.joints and self.joints != other.joints:
            ours, theirs = next(
                pair for pair in zip(self.joints, other.joints, strict=True) if len(set(pair)) > 1
            )
            return [f"joint {ours!r}, not {theirs!r}"]
        limits = [
            f"{side} limit of joint {joint} {ours:g}, not {theirs:g}"
            for side in ("lower", "upper")
            for joint, (ours, theirs) in enumerate(
                zip(getattr(self, side), getattr(other, side), strict=True)
            )
            if not abs(ours - theirs) <= LIMIT_TOLERANCE
        ]
        if limits:
            return limits[:2]
        if not (self.kinematics and other.kinematics):
            return [] if self.name == other.name else ["another name, and no digest to compare"]
        if self.kinematics == other.kinematics:
            return []
        return [f"joints placed otherwise (kinematics {self.kinematics[:8]}, not {other.kinematics[:8]})"]

    def to_json(self) -> dict[str, Any]:
        """What `from_json` reads."""
        return {name: list(part) if isinstance(part, tuple) else part for name, part in asdict(self).items()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any], where: str) -> Self:
        """Read what `to_json` wrote, or an earlier version, which knew no joints' names and no digest.

        Raises
        ------
        InvalidInputError
            Naming, after `where`, what is wrong.
        """
        name, joints, kinematics = data.get("name"), data.get("joints", []), data.get("kinematics", "")
        lower, upper = (_numbers(data.get(side)) for side in ("lower", "upper"))
        if not isinstance(name, str) or not isinstance(kinematics, str) or lower is None or upper is None:
            raise InvalidInputError(f"{where} must have a name and lists of numbers lower and upper")
        if len(lower) != len(upper) or not lower or not all(a < b for a, b in zip(lower, upper, strict=True)):
            raise InvalidInputError(f"{where}: lower {lower} and upper {upper} are no joint limits")
        if not isinstance(joints, list) or not all(isinstance(joint, str) for joint in joints):
            raise InvalidInputError(f"{where}: joints is {joints!r}; it must be a list of names")
        if joints and len(joints) != len(lower):
            raise InvalidInputError(f"{where}: {len(joints)} names of joints, but {len(lower)} limits")
        return cls(name, lower, upper, tuple(joints), kinematics)


def _numbers(values: object) -> tuple[float, ...] | None:
    """A list of finite numbers, or None when it is no such thing."""
    if not isinstance(values, list) or any(isinstance(v, bool | str) for v in values):
        return None
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        return None
    return numbers if all(map(math.isfinite, numbers)) else None
