"""Shortcuts on the manifold: the same post-processing of paths for every planner."""

import time
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel
from cvqmpt_lab.search.motion import Space, bisect_motion, distance, segment_valid
from cvqmpt_lab.search.result import Counters, JointPath
from cvqmpt_lab.search.space import ConstrainedSpace

KEEP = 0.999  # a shortcut must be shorter than this share of what it replaces
ROUND = 16  # shortcuts tried before the clock is read
SWEEP = 112  # shortcuts from the longest to the shortest


@kernel
def path_length(states, count):
    """sum_i |q_(i+1) - q_i| over the first count rows of states (k, n) [rad]."""
    total = 0.0
    for i in range(count - 1):
        total += distance(states[i], states[i + 1])
    return total


@kernel
def _locate(states, count, along):
    """Index of the state nearest before arc length along [rad]."""
    total = 0.0
    for i in range(count - 1):
        total += distance(states[i], states[i + 1])
        if total > along:
            return i
    return count - 1


@kernel
def _replace(states, count, a, b, detour, size):
    """Put detour (size rows, the last one is states[b]) after states[a]; return the new count."""
    shift = a + size - b
    n = states.shape[1]
    if shift > 0:
        for i in range(count - 1, b, -1):
            for j in range(n):
                states[i + shift, j] = states[i, j]
    elif shift < 0:
        for i in range(b + 1, count):
            for j in range(n):
                states[i + shift, j] = states[i, j]
    for i in range(size):
        for j in range(n):
            states[a + 1 + i, j] = detour[i, j]
    return count + shift


@kernel(inline="source")
def _shorter_motion(space, states, a, b, detour):
    """Write a direct, free, shorter motion between two states into detour; its size or 0."""
    if b - a < 2:
        return 0
    old = 0.0
    for i in range(a, b):
        old += distance(states[i], states[i + 1])
    if distance(states[a], states[b]) > KEEP * old:
        return 0
    size = bisect_motion(space, states[a], states[b], KEEP * old, detour)
    for i in range(size):
        if not segment_valid(space, states[a] if i == 0 else detour[i - 1], detour[i]):
            return 0
    return size


@entry
def shortcut(
    space: Space,
    states: Annotated[np.ndarray, "capacity n"],
    count: int,
    picks: Annotated[np.ndarray, "tries 2"],
    detour: Annotated[np.ndarray, "room n"],
):
    """Try one shortcut per row of picks (m, 2), two fractions of the path's length in [0, 1].

    Motions put in are projected and checked at space.resolution. states: (capacity, n), its first
    count rows are the path, changed in place. detour: (k, n) room. Returns the number of states.
    """
    for i in range(picks.shape[0]):
        length = path_length(states, count)
        low, high = min(picks[i, 0], picks[i, 1]), max(picks[i, 0], picks[i, 1])
        a = _locate(states, count, low * length)
        b = min(_locate(states, count, high * length) + 1, count - 1)
        size = _shorter_motion(space, states, a, b, detour)
        if size > 0 and count + size <= states.shape[0]:
            count = _replace(states, count, a, b, detour, size)
    return count


@dataclass(frozen=True)
class Simplified:
    """A shorter path and what it took."""

    path: JointPath  # the shorter path
    seconds: float  # wall time [s]
    counters: Counters  # work done


def simplify(
    space: ConstrainedSpace,
    path: JointPath,
    rng: np.random.Generator,
    attempts: int = SWEEP,
    seconds: float = np.inf,
    patience: int = 4,
    gain: float = 0.002,
) -> Simplified:
    """Replace stretches of a path by direct projected motions as long as that shortens it.

    Start and goal stay; every motion put in is on the manifold and checked at the fine resolution.
    Without seconds the result depends on path and random numbers alone.

    Args:
        space: the planning space.
        path: on the manifold and free.
        rng: random numbers.
        attempts: shortcuts tried at most.
        seconds: wall time at most [s].
        patience: rounds of ROUND shortcuts without gain after which it stops.
        gain: relative, in length.
    """
    began = time.perf_counter()
    before = space.counters
    capacity = 2 * len(path.states) + 1024
    states = np.empty((capacity, space.robot.dof))
    states[: len(path.states)] = path.states
    detour = np.empty((capacity, space.robot.dof))
    count, length, stale, tried = len(path.states), path.length, 0, 0
    while tried < attempts and stale < patience and time.perf_counter() - began <= seconds:
        picks = _picks(rng, tried, min(ROUND, attempts - tried))
        count = shortcut.unchecked(space.arrays, states, count, picks, detour)
        space.reraise()
        tried += len(picks)
        shorter = JointPath(states[:count]).length
        stale = stale + 1 if shorter > (1.0 - gain) * length else 0
        length = shorter
    return Simplified(
        JointPath(states[:count].copy()), time.perf_counter() - began, space.counters_since(before)
    )


def _picks(
    rng: np.random.Generator,
    tried: int,
    count: int,
    longest: float = 0.5,
    shortest: float = 0.05,
    spread: float = 0.3,
) -> np.ndarray:
    """Ends (count, 2) of the next shortcuts, as shares of the path's length.

    Spans fall from the longest to the shortest in a sweep, each varied by up to `spread`.
    """
    swept = (tried + np.arange(count)) % SWEEP / SWEEP
    spans = longest * (shortest / longest) ** swept * rng.uniform(1.0 - spread, 1.0 + spread, count)
    begins = rng.random(count) * (1.0 - spans)
    picks = np.stack([begins, begins + spans], axis=1)
    if tried == 0:
        picks[0] = (0.0, 1.0)  # the whole path at once
    return picks
