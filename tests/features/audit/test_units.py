"""Values of recordings become radians by the unit that the user states."""

import json

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.features.audit.units import plain_name, read_calibration, scales
from cvqmpt_lab.features.motion.alone import robot_moving
from cvqmpt_lab.robot.load import robot_from_source

MOTOR = {"id": 1, "drive_mode": 0, "homing_offset": 12, "range_min": 1024, "range_max": 3072}
NAMES = ("shoulder_pan", "wrist_roll", "gripper")


@pytest.fixture(scope="module")
def robot():
    return robot_moving(robot_from_source({"name": "so-arm101"}), ["gripper"])


@pytest.fixture
def calibration(tmp_path):
    def made(**motors):
        (tmp_path / "c.json").write_text(json.dumps(motors))
        return read_calibration(tmp_path / "c.json")

    return made


def lerobot(value, motor, share):
    """Return the angle of a normalised value as LeRobot computes: its step, then degrees."""
    low, high = motor["range_min"], motor["range_max"]
    if share:
        value = 100.0 - value if motor["drive_mode"] else value
        step = low + value / 100.0 * (high - low)
        return np.radians((step - low) * 360.0 / 4095)
    value = -value if motor["drive_mode"] else value
    step = low + (value + 100.0) / 200.0 * (high - low)
    return np.radians((step - (low + high) / 2) * 360.0 / 4095)


@pytest.mark.parametrize("mode", [0, 1])
def test_normalised_values_are_those_of_lerobot(robot, calibration, mode):
    motor = {**MOTOR, "drive_mode": mode}
    found = calibration(**dict.fromkeys(("shoulder_pan", "wrist_roll.pos", "main_gripper"), motor))
    factors, offsets = scales(robot, NAMES, "normalised", found, True)
    closed = robot.lower[robot.joint_names.index("gripper")]
    for value in (-100.0, 0.0, 37.0, 100.0):
        q = factors * value + offsets
        assert q[:2] == pytest.approx(lerobot(value, motor, False), abs=1e-12)
        assert q[2] == pytest.approx(closed + lerobot(value, motor, True), abs=1e-12)


def test_degrees_are_degrees_and_grippers_of_lerobot_are_per_cent(robot, calibration):
    factors, offsets = scales(robot, NAMES, "degrees", None, True)
    j = robot.joint_names.index("gripper")
    assert factors[0] == np.pi / 180.0 and offsets[0] == 0.0
    assert factors[2] * 100.0 + offsets[2] == pytest.approx(robot.upper[j])
    assert offsets[2] == robot.lower[j]
    factors, _ = scales(robot, NAMES, "degrees", None, False)
    assert factors[2] == np.pi / 180.0
    factors, offsets = scales(robot, NAMES, "radians", None, True)
    assert not offsets.any() and (factors == 1.0).all()


def test_what_is_missing_or_wrong_in_a_calibration_is_said(robot, calibration, tmp_path):
    found = calibration(shoulder_pan=MOTOR)
    refused("wrist_roll need its calibration", scales, robot, NAMES, "normalised", found, True)
    refused("has no range_min", calibration, gripper={"range_max": 3})
    refused("must be below range_max", calibration, gripper={**MOTOR, "range_max": 1024})
    refused("drive_mode 2", calibration, gripper={**MOTOR, "drive_mode": 2})
    refused("has no motor", calibration)
    assert plain_name("main_shoulder_pan.pos") == "shoulder_pan"
