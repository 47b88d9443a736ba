"""Which robot weights were trained for: what is kept beside them, and compared with the robot at hand."""

from dataclasses import dataclass

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

    def __post_init__(self) -> None:
        if (
            not self.lower
            or len(self.lower) != len(self.upper)
            or not all(map(float.__lt__, self.lower, self.upper))
        ):
            raise InvalidInputError(f"lower {self.lower} and upper {self.upper} are no joint limits")
        if self.joints and len(self.joints) != len(self.lower):
            raise InvalidInputError(f"{len(self.joints)} names of joints, but {len(self.lower)} limits")

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
