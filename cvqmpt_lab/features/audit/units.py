"""Radians of the values of a recording, whose unit the user states; units are never guessed.

``radians``: values are used as they are. ``degrees``: q = pi / 180 x. ``normalised``: LeRobot's
values from -100 to 100 of the range that was measured at calibration, in steps of the motor's
encoder, 4096 a turn:

    q = x / 200 (range_max - range_min) 2 pi / 4095,        x = -x if drive_mode is 1

so that 0 is the middle of the range, as in the URDFs of SO-100 and SO-101. LeRobot's grippers go
from 0, closed, to 100, open, also in data sets in degrees:

    q = lower + x / 100 (range_max - range_min) 2 pi / 4095,    x = 100 - x if drive_mode is 1

with the lower limit of the joint. Without a calibration, a gripper in a data set in degrees has the
range of its joint limits.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, few, mapping, shown, whole_number
from cvqmpt_lab.base.files import read_json_object
from cvqmpt_lab.robot.robot import Robot

UNITS = ("radians", "degrees", "normalised")
STEPS_OF_A_TURN = 4096  # of the encoders of LeRobot's arms; LeRobot divides by one less


@dataclass(frozen=True)
class Calibrated:
    """Calibration of one motor."""

    range_min: int  # smallest and largest step of the encoder
    range_max: int
    reversed: bool  # drive_mode 1

    @property
    def radians(self) -> float:
        """The range as an angle [rad]."""
        return (self.range_max - self.range_min) * 2.0 * np.pi / (STEPS_OF_A_TURN - 1)


def plain_name(name: str) -> str:
    """Return the name of a joint without what LeRobot adds: main_, .pos and .position."""
    for ending in (".pos", ".position"):
        name = name.removesuffix(ending)
    return name.removeprefix("main_")


def read_calibration(path: Path) -> dict[str, Calibrated]:
    """Read LeRobot's calibration of motors by name: id, drive_mode, homing_offset, range_..."""
    found = {}
    for name, fields in read_json_object(path, "calibration").items():
        where = f"calibration {path}: {name}"
        known = mapping(fields, where, "drive_mode, range_min and range_max")
        least, most = (_step(known, key, where) for key in ("range_min", "range_max"))
        if not least < most:
            raise InvalidInputError(f"{where}: range_min {least} must be below range_max {most}")
        mode = whole_number(f"{where}: drive_mode", known.get("drive_mode", 0), most=1)
        found[plain_name(name)] = Calibrated(least, most, bool(mode))
    if not found:
        raise InvalidInputError(f"calibration {path} has no motor")
    return found


def _step(fields: Mapping[str, Any], key: str, where: str) -> int:
    if key not in fields:
        raise InvalidInputError(f"{where} has no {key}; it has {few(map(shown, fields))}")
    return whole_number(f"{where}: {key}", fields[key], most=2**20)


def is_gripper(name: str) -> bool:
    """Return whether LeRobot writes a joint's values from 0 to 100."""
    return "gripper" in name


def scales(
    robot: Robot,
    names: Sequence[str],
    units: str,
    calibration: Mapping[str, Calibrated] | None,
    of_lerobot: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Return factors and offsets (n,): positions [rad or m] are factor x value + offset.

    Args:
        robot: the robot, with the limits of its joints.
        names: n joints of the robot, in the order of the values.
        units: one of UNITS.
        calibration: of motors by name; needed for normalised values.
        of_lerobot: whether a gripper in a recording in degrees goes from 0 to 100.
    """
    factors, offsets = np.ones(len(names)), np.zeros(len(names))
    if units == "radians":
        return factors, offsets
    for k, name in enumerate(names):
        joint = robot.joint_names.index(name)
        motor = None if calibration is None else calibration.get(name)
        share = is_gripper(name) and (units == "normalised" or of_lerobot)
        if units == "degrees" and not share:
            slider = robot.unit_of(joint, "rad") == "m"
            factors[k] = 1.0 if slider else np.pi / 180.0
            continue
        if motor is None and not (share and units == "degrees"):
            have = "" if calibration is None else f"; it has {few(calibration)}"
            raise InvalidInputError(
                f"normalised values of {name} need its calibration: give --calibration F.json of "
                f"the arm that was recorded{have}"
            )
        lower, upper = float(robot.lower[joint]), float(robot.upper[joint])
        range_rad = upper - lower if motor is None else motor.radians
        turned = motor is not None and motor.reversed
        if share:
            factors[k] = (-1.0 if turned else 1.0) * range_rad / 100.0
            offsets[k] = lower + (range_rad if turned else 0.0)
        else:
            factors[k] = (-1.0 if turned else 1.0) * range_rad / 200.0
    return factors, offsets
