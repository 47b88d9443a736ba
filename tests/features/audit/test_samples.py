"""Faults that samples show; smooth recordings and those with encoder steps show none."""

import numpy as np
import pytest

from cvqmpt_lab.features.audit.samples import (
    jump_faults,
    least_jerk,
    pair_faults,
    resolution,
    stamp_faults,
    unit_faults,
)
from cvqmpt_lab.features.audit.swapped import swapped_pair

NAMES = ("a", "b", "c")
T = np.arange(120) / 30.0
SMOOTH = np.stack([0.8 * np.sin(T), 1.2 + 0.5 * np.cos(1.3 * T), 0.3 * np.sin(0.7 * T)], axis=1)


def kinds(faults):
    return [fault.kind for fault in faults]


def test_a_smooth_recording_shows_no_fault():
    late = np.vstack([SMOOTH[:4].repeat(1, 0), SMOOTH[:-4]])
    steps = np.round(late / 0.0015) * 0.0015
    assert not kinds(stamp_faults(T, 1 / 30)) and not kinds(jump_faults(SMOOTH, T, 1 / 30, NAMES))
    assert not kinds(pair_faults(SMOOTH, steps, T, NAMES))
    assert not kinds(unit_faults(np.degrees(SMOOTH), "degrees", NAMES, [False] * 3))


def test_stamps_and_gaps_are_found_where_they_are():
    twice = T.copy()
    twice[10] = twice[9]
    (fault,) = stamp_faults(twice, 1 / 30)
    assert fault.kind == "stamps" and fault.at_s == T[9] and "1 stamps" in fault.text
    (fault,) = stamp_faults(np.delete(T, [20, 21, 22]), 1 / 30)
    assert fault.kind == "gap" and fault.at_s == T[19] and "0.133 s" in fault.text


@pytest.mark.parametrize("last", [51, None])
def test_a_jump_is_one_sample_or_all_that_follow(last):
    states = SMOOTH.copy()
    states[50:last, 1] += 0.3
    (fault,) = jump_faults(states, T, 1 / 30, NAMES)
    assert (fault.kind, fault.joint) == ("jump", "b") and abs(fault.at_s - T[50]) < 0.05
    # a gap in time explains a large step
    gone = np.r_[0:30, 45:120]
    assert not kinds(jump_faults(SMOOTH[gone], T[gone], 1 / 30, NAMES))


def test_joints_that_change_places_and_drift_are_named():
    crossed = SMOOTH[:, [1, 0, 2]]
    (fault,) = pair_faults(SMOOTH, crossed, T, NAMES)
    assert fault.kind == "swapped" and "a and b" in fault.text
    for late in (0, 6, -6):
        off = np.roll(SMOOTH, late, axis=0)[10:-10]
        off[:, 2] += np.linspace(0.0, 0.2, len(off))
        (fault,) = pair_faults(off, SMOOTH[10:-10], T[10:-10], NAMES)
        assert (fault.kind, fault.joint) == ("drift", "c"), late


def test_values_that_are_too_small_for_their_unit_are_named():
    assert kinds(unit_faults(SMOOTH, "degrees", NAMES, [False] * 3)) == ["units"]
    assert not kinds(unit_faults(SMOOTH, "radians", NAMES, [False] * 3))
    hand = np.degrees(SMOOTH)
    hand[:, 2] = np.linspace(0.1, 0.9, len(T))
    shares = [False, False, True]
    assert kinds(unit_faults(hand, "degrees", NAMES, shares)) == ["gripper"]
    hand[:, 2] = 0.1 * (np.arange(len(T)) % 3)  # a closed gripper: steps of its encoder
    assert not kinds(unit_faults(hand, "degrees", NAMES, shares))


def test_the_least_jerk_is_below_that_of_any_curve():
    jerks, begins = least_jerk(np.sin(3.0 * T)[:, None], T)
    assert np.abs(jerks).max() <= 27.0 and np.abs(jerks).max() > 26.0
    assert len(begins) == len(jerks) == len(T) - 3
    cubic = (2.0 * T**3 - T)[:, None]
    np.testing.assert_allclose(least_jerk(cubic, T)[0], 12.0, rtol=1e-6)


def test_steps_of_an_encoder_are_found_in_float32():
    step = 2.0 * np.pi / 4096
    values = np.degrees(np.round(SMOOTH / step) * step).astype(np.float32)
    np.testing.assert_allclose(resolution(np.radians(values)), step, rtol=1e-3)
    fast = np.array([0, 2, 5, 9, 20, 50, 53])[:, None] * step
    np.testing.assert_allclose(resolution(fast), step, rtol=1e-6)
    assert not resolution(SMOOTH).any() and not resolution(np.zeros((9, 2))).any()


def test_an_episode_whose_columns_changed_places_is_found_among_others():
    rng = np.random.default_rng(0)
    medians = np.array([0.0, -1.0, 0.9]) + 0.05 * rng.standard_normal((12, 3))
    own = medians[3, [0, 2, 1]]
    assert swapped_pair(own, np.vstack([medians, own])) == (1, 2)
    assert all(swapped_pair(row, medians) is None for row in medians)
