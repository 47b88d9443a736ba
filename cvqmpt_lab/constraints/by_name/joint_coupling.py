"""Constraint `joint-coupling`."""

from collections.abc import Mapping
from typing import Any

EXAMPLE = {"factors": {"JOINT": 1.0, "OTHER": -1.0}}


def joint_coupling(
    factors: Mapping[str, float], lower: float | None = 0.0, upper: float | None = 0.0
) -> Any:
    """Return the constraint of a weighted sum of joints.

    Args:
        factors: factor of each joint of the sum, by the joint's name.
        lower: smallest value of the sum [rad or m]; None: no bound.
        upper: largest value of the sum [rad or m]; None: no bound.
    """
    from cvqmpt_lab.constraints.joint_coupling import JointCoupling  # few problems have one

    return JointCoupling(factors, lower, upper)
