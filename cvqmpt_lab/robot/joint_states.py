"""Positions of joints in ROS's JointState, the message of the topic /joint_states."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from cvqmpt_lab.base.errors import InvalidInputError, few, known_fields, unique
from cvqmpt_lab.base.readers import listed


def positions_by_joint(
    message: Mapping[str, Any], joints: Sequence[str], where: str
) -> dict[str, Any]:
    """Return the positions [rad or m] in a JointState by joint; others are left out with a note.

    Args:
        message: fields of the message, with lists `name` and `position`.
        joints: names of the joints that are wanted.
        where: the field's name in errors.
    """
    known_fields(message, where, ("header", "name", "position", "velocity", "effort"))
    names, values = (listed(message[key], f"{where}.{key}") for key in ("name", "position"))
    if len(names) != len(values):
        raise InvalidInputError(f"{where} has {len(names)} names and {len(values)} positions")
    unique([str(name) for name in names], f"{where}.name")
    found = dict(zip(map(str, names), values, strict=True))
    if others := [name for name in found if name not in joints]:
        logging.getLogger("cvqmpt").warning(
            f"{where} has joints that are not planned, which are left out: {few(others)}"
        )
    return {name: value for name, value in found.items() if name in joints}
