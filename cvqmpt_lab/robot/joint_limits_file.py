"""MoveIt's joint_limits.yaml: limits that a URDF cannot state, or narrower ones."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from cvqmpt_lab.base.errors import (
    InvalidInputError,
    at,
    known_fields,
    located,
    mapping,
    require_choice,
)
from cvqmpt_lab.base.files import read_bytes, yaml_value
from cvqmpt_lab.base.readers import parsing
from cvqmpt_lab.base.values import scalar

Limits = Mapping[str, Mapping[str, float]]
"""By joint, then by kind: "velocity", ..., "lower", "upper" [rad or m, s]."""


def read_joint_limits(path: Path, joints: Sequence[str]) -> Limits:
    """Read the limits of a file; joints of the robot that are not planned are left out.

    Args:
        path: the file.
        joints: names of all joints of the robot.

    Raises InvalidInputError or UnknownChoiceError with the file and the field that is wrong.
    """
    data = read_bytes(path, "joint limits")
    with parsing(path, "joint limits"):
        message = _unwrapped(yaml_value(data.decode("utf-8-sig")))
    with located(str(path)):
        stated = mapping(message.get("joint_limits", message), "joint_limits")
        return {
            require_choice("joint of joint_limits", name, joints): _of_joint(
                mapping(fields, at("joint_limits", name)), at("joint_limits", name)
            )
            for name, fields in stated.items()
            if not str(name).startswith("default_")
        }


def _unwrapped(value: Any) -> Mapping[str, Any]:
    """Return the part with "joint_limits" of a file of ROS's parameters, else the whole.

    In ROS 2 parameters stand below the name of a node and "ros__parameters".
    """
    whole = mapping(value, "", "joint_limits")
    found = dict(_having_limits(whole, "the file"))
    if len(found) > 1:
        raise InvalidInputError(
            f"joint_limits occur in {' and in '.join(found)}; keep those of one"
        )
    if not found and "ros__parameters" in str(value):
        raise InvalidInputError(
            "its ROS parameters have no joint_limits; give a file with joint_limits at its top"
        )
    return next(iter(found.values()), whole)


def _having_limits(part: Mapping[str, Any], name: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the parts of nested mappings that have "joint_limits", with their names."""
    if "joint_limits" in part:
        yield name, part
        return
    for key, inside in part.items():
        if isinstance(inside, Mapping):
            yield from _having_limits(inside, str(key) if name == "the file" else f"{name}.{key}")


def narrow_positions(model: pin.Model, limits: Limits, planned: Sequence[str]) -> None:
    """Narrow the position limits of planned joints in a model; refuse empty ones."""
    for name in planned:
        j = model.getJointId(name) - 1
        lower, upper = model.lowerPositionLimit[j], model.upperPositionLimit[j]
        own = limits.get(name, {})
        lower, upper = max(lower, own.get("lower", lower)), min(upper, own.get("upper", upper))
        if not lower < upper:
            raise InvalidInputError(
                f"joint_limits of {name} leave it no range: from {lower:g} to {upper:g}; correct "
                "min_position and max_position"
            )
        model.lowerPositionLimit[j], model.upperPositionLimit[j] = lower, upper


def limits_with(
    kind: str, known: np.ndarray | None, limits: Limits, names: Sequence[str]
) -> np.ndarray | None:
    """Return the limits (n,) of a kind: from the file, else the known ones.

    Args:
        kind: "velocity", "acceleration", "jerk" or "effort".
        known: (n,), or () for all joints; None: not known.
        limits: limits of the file.
        names: names of the n planned joints.

    Raises InvalidInputError if the file has limits of some joints and others have none.
    """
    if not any(kind in limits.get(name, {}) for name in names):
        return known
    values = np.full(len(names), np.nan if known is None else known)
    for k, name in enumerate(names):
        values[k] = limits.get(name, {}).get(kind, values[k])
    missing = [name for name, value in zip(names, values, strict=True) if np.isnan(value)]
    if missing:
        raise InvalidInputError(
            f"joint_limits have {kind} limits, but none of {', '.join(missing)}: add max_{kind} "
            f"with has_{kind}_limits: true"
        )
    return values


def _of_joint(fields: Mapping[str, Any], where: str) -> dict[str, float]:
    """Return the limits of one joint by kind."""
    kinds = {f"max_{kind}": kind for kind in ("velocity", "acceleration", "jerk", "effort")}
    kinds |= {"min_position": "lower", "max_position": "upper"}
    flags = [f"has_{key.partition('_')[2]}_limits" for key in kinds]
    found = {}
    known_fields(fields, where, (*kinds, *flags, "angle_wraparound"))
    for (key, kind), flag in zip(kinds.items(), flags, strict=True):
        if scalar(bool, fields.get(flag, False), at(where, flag)):
            if key not in fields:
                raise InvalidInputError(f"{where} has {flag}: true, but no {key}")
            found[kind] = float(scalar(float, fields[key], at(where, key)))
    return found
