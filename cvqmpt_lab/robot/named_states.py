"""Configurations as people name them: by joint, or by a group_state of the robot's SRDF."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError, shown
from cvqmpt_lab.files import read_text
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.robot.source import read_source
from cvqmpt_lab.values import Array, FloatArray

State = Annotated[FloatArray, Array((None,), "numbers [rad or m]")]
"""A configuration: numbers; in a file also {"joint": value} or the name of a group_state."""


def numbers_of(robot: Robot, value: Any, where: str) -> Any:
    """The numbers, in the robot's order, of {"joint": value} or of a group_state's name;
    anything else as it is.
    """
    if isinstance(value, str):
        states = group_states(robot)
        if value not in states:
            raise UnknownChoiceError(
                f"group_state of {where}", value, states or ["none in its SRDF; give numbers"]
            )
        value = {
            name: number for name, number in states[value].items() if name in robot.joint_names
        }
    if not isinstance(value, Mapping):
        return value
    for name in value:
        if name not in robot.joint_names:
            raise UnknownChoiceError(f"joint of {where}", name, robot.joint_names)
    missing = [name for name in robot.joint_names if name not in value]
    if missing:
        raise InvalidInputError(
            f"{where} has no value for {', '.join(missing)}; give one for each joint [rad or m]"
        )
    return [value[name] for name in robot.joint_names]


def group_states(robot: Robot) -> dict[str, dict[str, float]]:
    """Values of joints [rad or m] by name of each group_state in the robot's SRDF;
    none without one.
    """
    path = read_source(robot.source).srdf
    if not path:
        return {}
    states: dict[str, dict[str, float]] = {}
    try:
        for state in ElementTree.fromstring(read_text(Path(path), "SRDF")).iter("group_state"):
            joints = states.setdefault(state.get("name", ""), {})
            for joint in state.iter("joint"):
                values = joint.get("value", "").split()
                if len(values) == 1:  # a joint of several coordinates is none of an arm's
                    joints[joint.get("name", "")] = float(values[0])
    except (ElementTree.ParseError, ValueError) as error:
        raise InvalidInputError(
            f"group_states of SRDF {path} cannot be read: {shown(str(error))}"
        ) from error
    return states
