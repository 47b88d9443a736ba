"""Faults of a recording that its samples show: stamps, gaps, jumps, drift, swapped joints, units.

Each rule has thresholds that are stated here and measured in docs/audit.md.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

GAP = 1.5  # a step of time that is longer than this many periods is a gap
# a jump is a step of a joint that is larger than this in one period [rad or m], ...
JUMP = 0.05
JUMP_RATIO = 4.0  # ... and this many times the steps two samples before and after
DRIFT = 0.1  # growth of the difference of measured and commanded positions [rad or m]
DRIFT_PARTS = 6  # parts of an episode in which it must grow, one after the other
MOST_LATE = 15  # samples by which measured positions may be later than commands, or earlier
SWAPPED = 0.1  # mean difference of two joints that are compared with each other [rad or m]
SMALL_UNIT = 3.2  # a recording in degrees or per cent whose values are all smaller is in radians
LEAST_MOVED = 0.05  # a recording that moves less than this [unit of the file] says nothing of units
LEAST_VALUES = 15  # a gripper that rests has fewer different values, the steps of its encoder


class SampleFault(NamedTuple):
    """A fault of the samples of a recording."""

    kind: str
    text: str
    at_s: float | None = None  # time [s]
    joint: str = ""


def stamp_faults(times: np.ndarray, period: float) -> Iterator[SampleFault]:
    """Yield repeated stamps and gaps of times (m,) [s]; period: usual step of time [s]."""
    steps = np.diff(times)
    wrong = np.flatnonzero(~(steps > 0.0))
    if len(wrong):
        k = int(wrong[0])
        what = "repeats" if steps[k] == 0.0 else "is before"
        yield SampleFault(
            "stamps",
            f"{len(wrong)} stamps do not increase: the one of sample {k + 1} {what} that of the "
            "sample before",
            float(times[k]),
        )
    # after r stamps that do not increase, a step spans r + 1 samples
    spans, run = np.ones(len(steps)), 0
    for k, step in enumerate(steps):
        spans[k], run = 1 + run, 0 if step > 0.0 else run + 1
    long = np.flatnonzero(steps > GAP * period * spans)
    if len(long):
        k = int(long[steps[long].argmax()])
        yield SampleFault(
            "gap",
            f"{len(long)} gaps in time, the longest of {steps[k]:.3g} s, where samples are "
            f"{period:.3g} s apart",
            float(times[long[0]]),
        )


def jump_faults(
    states: np.ndarray, times: np.ndarray, period: float, names: Sequence[str]
) -> Iterator[SampleFault]:
    """Yield the largest jump of joints; the text counts all.

    Args:
        states: (m, n) [rad or m].
        times: (m,) increasing [s].
        period: usual step of time [s].
        names: of the n joints.
    """
    if len(states) < 6:
        return
    steps = np.abs(np.diff(states, axis=0)) / np.diff(times)[:, None] * period
    beside = np.zeros_like(steps)
    beside[2:] = steps[:-2]
    beside[:-2] = np.maximum(beside[:-2], steps[2:])
    jumps = (steps > JUMP) & (steps > JUMP_RATIO * beside)
    if jumps.any():
        k, joint = divmod(int(np.where(jumps, steps, 0.0).argmax()), steps.shape[1])
        yield SampleFault(
            "jump",
            f"{names[joint]} jumps by {steps[k, joint]:.3g} between two samples, {int(jumps.sum())}"
            " such jumps",
            float(times[k]),
            names[joint],
        )


def pair_faults(
    states: np.ndarray, other: np.ndarray, times: np.ndarray, names: Sequence[str]
) -> Iterator[SampleFault]:
    """Yield faults that commanded and measured positions show together: swapped joints, drift.

    Args:
        states: (m, n) [rad or m].
        other: (m, n) the other one of commanded and measured positions.
        times: (m,) [s].
        names: of the n joints.
    """
    # (n, n) mean distance of each joint from each joint of the other
    apart = np.abs(states[:, :, None] - other[:, None, :]).mean(axis=0)
    own = np.diag(apart)
    for i in range(len(names)):
        for j in range(i + 1, len(names)):
            crossed = apart[i, j] + apart[j, i]
            if own[i] + own[j] > 2.0 * SWAPPED and crossed < 0.3 * (own[i] + own[j]):
                yield SampleFault(
                    "swapped",
                    f"{names[i]} and {names[j]} are swapped: each follows the other's commands",
                    None,
                    names[i],
                )
                return
    states, other, times = _together(states, other, times)
    if len(states) < 5 * DRIFT_PARTS:
        return
    parts = np.array_split(states - other, DRIFT_PARTS)
    medians = np.array([np.median(part, axis=0) for part in parts])
    grown = medians[-1] - medians[0]
    steady = (np.diff(medians, axis=0) * np.sign(grown) > 0.0).all(axis=0)
    drifts = np.where(steady, np.abs(grown), 0.0)
    joint = int(drifts.argmax())
    if drifts[joint] > DRIFT:
        yield SampleFault(
            "drift",
            f"measured and commanded positions of {names[joint]} drift apart by "
            f"{drifts[joint]:.3g}",
            float(times[-1]),
            names[joint],
        )


def _together(
    states: np.ndarray, other: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states, the others and times without the delay of measured after commanded ones.

    The delay is the one, of at most MOST_LATE samples, with the least change of the difference.
    """

    def shifted(late: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        m = len(states) - abs(late)
        begin, after = max(-late, 0), max(late, 0)
        return states[begin : begin + m], other[after : after + m], times[begin : begin + m]

    def change(late: int) -> float:
        first, second, _ = shifted(late)
        return float(np.abs(np.diff(first - second, axis=0)).mean())

    most = min(MOST_LATE, len(states) // 4)
    return shifted(min(range(-most, most + 1), key=lambda late: (change(late), abs(late))))


def resolution(states: np.ndarray) -> np.ndarray:
    """Return the steps (n,) in which joints are recorded, such as those of an encoder [rad or m].

    It is 0 for a joint whose differences are no multiples of the least one, or of a half, third or
    quarter of it, and for one that does not move.

    states: (m, n) [rad or m].
    """
    steps = np.zeros(states.shape[1])
    for j, column in enumerate(states.T):
        values = np.unique(column)
        apart = np.diff(values)
        apart = apart[apart > 1e-6]  # float32 repeats a value with rounding
        if len(apart) < 3:
            continue
        least = float(np.median(apart[apart < 1.25 * apart.min()]))
        for parts in (1, 2, 3, 4):  # a fast joint may have no two neighbouring values
            counts = np.round(apart * parts / least)
            step = float(apart.sum() / counts.sum())  # rounding of float32 averages out
            if np.abs(apart / step - counts).max() < 0.1:
                steps[j] = step
                break
    return steps


def unit_faults(
    raw: np.ndarray, units: str, names: Sequence[str], shares: Sequence[bool]
) -> Iterator[SampleFault]:
    """Yield values that are too small for degrees or per cent: of radians, or from 0 to 1.

    Args:
        raw: (m, n) values as recorded.
        units: stated unit.
        names: of the n joints.
        shares: (n,) which joints go from 0 to 100, as LeRobot's grippers.
    """
    if units == "radians":
        return
    share = np.array(shares, dtype=bool)
    most, moved = np.abs(raw).max(axis=0), np.ptp(raw, axis=0)
    if (~share).any() and most[~share].max() <= SMALL_UNIT and moved[~share].max() > LEAST_MOVED:
        yield SampleFault(
            "units",
            f"all values are at most {most[~share].max():.3g}: radians? They are stated as {units}",
        )
    for k in np.flatnonzero(share & (most <= 1.05) & (moved > LEAST_MOVED)).tolist():
        if len(np.unique(raw[:, k])) < LEAST_VALUES:
            continue
        yield SampleFault(
            "gripper",
            f"{names[k]} moves between {raw[:, k].min():.3g} and {raw[:, k].max():.3g}: from 0 to "
            "1? LeRobot's go from 0 to 100",
            None,
            names[k],
        )


def least_jerk(states: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return jerks (m - 3, n) that every smooth curve through the samples reaches, and times.

    Between t_0 and t_3 the third derivative of any curve with a continuous one is 6 q[t_0, ..,
    t_3] somewhere, a divided difference.

    Args:
        states: (m, n) [rad or m].
        times: (m,) increasing [s].
    """
    difference = states
    for order in (1, 2, 3):
        spans = (times[order:] - times[:-order])[:, None]
        difference = np.diff(difference, axis=0) / spans
    return 6.0 * difference, times[:-3]
