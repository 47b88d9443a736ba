"""Constraint `joint-coupling`: a weighted sum of joints stays between bounds."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cvqmpt_lab.base.codec import Checked, to_plain
from cvqmpt_lab.base.errors import InvalidInputError, require_choice, shown
from cvqmpt_lab.base.jit import Pointer, entry
from cvqmpt_lab.base.values import scalar
from cvqmpt_lab.constraints.bounded_rows import BoundedRows
from cvqmpt_lab.constraints.regions import FunctionRows
from cvqmpt_lab.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class JointCoupling(Checked):
    """Joints q with lower <= sum of factor * q <= upper."""

    factors: Mapping[str, float]  # factor of each joint, by its name
    lower: float | None = 0.0  # [rad or m]; None: no bound
    upper: float | None = 0.0  # [rad or m]; None: no bound

    def _check(self) -> None:
        factors = {k: scalar(float, v, f"factors.{k}") for k, v in self.factors.items()}
        if not any(factors.values()):
            raise InvalidInputError(f"factors is {shown(factors)}; give a factor other than 0")
        lower, upper = self.bounds
        if not (lower <= upper and np.isfinite([lower, upper]).any()):
            raise InvalidInputError(
                f"lower is {self.lower} and upper {self.upper}; lower <= upper is needed, and one "
                "of the two"
            )
        object.__setattr__(self, "factors", factors)

    @property
    def bounds(self) -> tuple[float, float]:
        """Both bounds, infinite where there is none [rad or m]."""
        lower = -np.inf if self.lower is None else self.lower
        return lower, np.inf if self.upper is None else self.upper

    def on(self, robot: Robot) -> "CoupledJoints":
        """Return the constraint for a robot; UnknownChoiceError: it has no such joint."""
        for name in self.factors:
            require_choice(
                f"joint of robot {robot.name} in joint-coupling", name, robot.joint_names
            )
        return CoupledJoints(self, np.array([self.factors.get(k, 0.0) for k in robot.joint_names]))

    def reraise(self) -> None:
        """Do nothing: machine code raises no errors."""

    @property
    def named(self) -> dict[str, Any]:
        """The constraint as problem files write it."""
        return {"joint-coupling": to_plain(self, complete=True)}


@dataclass(frozen=True, eq=False)
class CoupledJoints(BoundedRows):
    """A joint coupling with the factors a (n,) of a robot's joints: x = a . q."""

    given: JointCoupling
    factors: np.ndarray

    @property
    def compiled(self) -> FunctionRows:
        """The sum as machine code."""
        lower, upper = (np.array([bound]) for bound in self.given.bounds)
        return FunctionRows(_weighted_sum.address, lower, upper, self.factors)

    def values(self, q: np.ndarray) -> np.ndarray:
        """Return a . q (b, 1) of q (b, n)."""
        return (q @ self.factors)[:, None]

    def slopes(self, q: np.ndarray) -> np.ndarray:
        """Return a (b, 1, n) for q (b, n)."""
        return np.broadcast_to(self.factors, (len(q), 1, len(self.factors)))

    def bound_between(self, states: np.ndarray) -> np.ndarray:
        """Return 0 (k - 1,): a . q is linear on a straight motion, so F is largest at an end."""
        return np.zeros(len(states) - 1)

    def describe(self) -> str:
        """Return the sum with its bounds, such as "joint1 - 2 joint3 from 0 to 0.1"."""
        terms = " ".join(
            f"{'-' if factor < 0.0 else '+'} {'' if abs(factor) == 1.0 else f'{abs(factor):g} '}{k}"
            for k, factor in self.given.factors.items()
        )
        lower, upper = self.given.bounds
        return f"{terms.removeprefix('+ ')} from {lower:g} to {upper:g}"


@entry(inline="never")
def _weighted_sum(
    derivative: int,
    n: int,
    m: int,
    q: Pointer,
    rotation: Pointer,
    translation: Pointer,
    parameters: Pointer,
    out: Pointer,
):
    """Write a . q, or a, see `FunctionRows`; the parameters are a (n,)."""
    if not derivative:
        out[0] = 0.0
    for j in range(n):
        if derivative:
            out[j] = parameters[j]
        else:
            out[0] += parameters[j] * q[j]
    return 0
