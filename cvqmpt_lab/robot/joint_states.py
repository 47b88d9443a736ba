"""ROS's JointState messages: values of joints by name."""

import logging
from collections.abc import Collection, Mapping
from typing import Any

from cvqmpt_lab.base.errors import InvalidInputError, few, known_fields, shown, unique
from cvqmpt_lab.base.readers import listed
from cvqmpt_lab.base.values import scalar

log = logging.getLogger("cvqmpt")


def is_joint_state(value: Any) -> bool:
    """Return whether a value is a JointState, or a RobotState, which holds one."""
    return isinstance(value, Mapping) and (
        "joint_state" in value or {"name", "position"} <= {*value}
    )


def joint_state_values(message: Any, where: str) -> dict[str, float]:
    """Return the positions [rad or m] of a JointState by joint; errors begin with `where`."""
    fields = known_fields(
        {} if message is None else message,
        where,
        ("header", "name", "position", "velocity", "effort"),
    )
    names = [str(name) for name in listed(fields.get("name"), f"{where}.name")]
    unique(names, f"{where}.name")
    values = listed(fields.get("position"), f"{where}.position")
    if len(names) != len(values):
        raise InvalidInputError(f"{where} has {len(names)} names and {len(values)} positions")
    return {
        name: float(scalar(float, value, f"{where}: {name}"))
        for name, value in zip(names, values, strict=True)
    }


def of_joints(message: Any, joints: Collection[str], where: str) -> dict[str, float]:
    """Return the values of some joints in a JointState or RobotState; a note names the others."""
    state = message.get("joint_state", message)
    values = joint_state_values(state, where)
    if not values.keys() & {*joints}:
        raise InvalidInputError(
            f"{where} has joints {few(map(shown, values)) or 'none'}; the robot has "
            f"{', '.join(joints)}"
        )
    if others := [name for name in values if name not in joints]:
        log.warning(f"{where}: {few(others)} are left out, they are not planned")
    return {name: value for name, value in values.items() if name in joints}
