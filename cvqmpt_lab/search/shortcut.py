"""Shortcuts on the manifold: the same post-processing of paths for every planner."""

import time
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel, placed
from cvqmpt_lab.search.motion import (
    Space,
    chord_on_manifold,
    distance,
    motion_between,
    path_blocked,
)
from cvqmpt_lab.search.result import Counters, JointPath
from cvqmpt_lab.search.space import ConstrainedSpace

SHORTCUTS_PER_SWEEP = 112  # from the longest to the shortest


@kernel
def path_length(states, count):
    """Return sum_i |q_(i+1) - q_i| [rad] of the first `count` rows of states (k, n)."""
    total = 0.0
    for i in range(count - 1):
        total += distance(states[i], states[i + 1])
    return total


@kernel
def _locate(states, count, along):
    """Return the index of the last state before the arc length `along` [rad]."""
    total = 0.0
    for i in range(count - 1):
        total += distance(states[i], states[i + 1])
        if total > along:
            return i
    return count - 1


@kernel
def _replace(states, count, a, b, detour, size):
    """Replace states a to b by the first size + 1 rows of detour, which begin and end like them.

    Returns:
        The new number of states.
    """
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
            states[a + 1 + i, j] = detour[i + 1, j]
    return count + shift


@kernel(inline="source")
def _shorter_motion(space, states, a, b, detour):
    """Write a direct, free, shorter motion from state a to state b into detour, after state a.

    Returns:
        The number of its states without state a; 0 if there is none.
    """
    share = 0.999  # largest ratio of the new length to the old one
    if b - a < 2:
        return 0
    old = 0.0
    for i in range(a, b):
        old += distance(states[i], states[i + 1])
    if distance(states[a], states[b]) > share * old:
        return 0
    size = motion_between(space, states[a], states[b], share * old, detour[1:])
    for j in range(states.shape[1]):
        detour[0, j] = states[a, j]
    for i in range(size):
        if not chord_on_manifold(space, detour[i], detour[i + 1]):
            return 0
    return size if path_blocked(space, detour, size + 1) < 0 else 0


@entry
def shortcut(
    space: Space,
    states: Annotated[np.ndarray, "capacity n"],
    count: int,
    picks: Annotated[np.ndarray, "tries 2"],
    detour: Annotated[np.ndarray, "room n"],
):
    """Try one shortcut for each row of picks; new motions are projected and checked finely.

    Args:
        space: the planning space.
        states: (capacity, n) [rad or m]; the first `count` rows are the path, changed in place.
        count: number of the path's states.
        picks: (m, 2), ends of the shortcuts as fractions of the path's length, in [0, 1].
        detour: (k, n), work array for one new motion.

    Returns:
        The new number of the path's states.
    """
    space = placed(space)
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
    """A path after `simplify`, and its cost."""

    path: JointPath
    seconds: float  # wall time of the simplification [s]
    counters: Counters  # work of the simplification


def simplify(
    space: ConstrainedSpace,
    path: JointPath,
    rng: np.random.Generator,
    attempts: int = SHORTCUTS_PER_SWEEP,
    seconds: float = np.inf,
    patience: int = 4,
    gain: float = 0.002,
) -> Simplified:
    """Replace stretches of a path by direct projected motions as long as that shortens it.

    Start and goal stay. Every new motion is on the manifold and checked at the fine resolution.
    Without a limit in seconds, the result depends only on the path and the random numbers.

    Args:
        space: the planning space.
        path: on the manifold and free.
        rng: random number generator.
        attempts: maximum number of shortcuts.
        seconds: maximum wall time [s].
        patience: number of rounds of 16 shortcuts without gain after which it stops.
        gain: relative reduction of the length that counts as a gain.
    """
    shortcuts_per_round = 16  # the clock is read after each round
    began = time.perf_counter()
    before = space.counters
    capacity = 2 * len(path.states) + 1024
    states = np.empty((capacity, space.robot.dof))
    states[: len(path.states)] = path.states
    detour = np.empty((capacity, space.robot.dof))
    count, length, stale, tried = len(path.states), path.length, 0, 0
    while tried < attempts and stale < patience and time.perf_counter() - began <= seconds:
        picks = _picks(rng, tried, min(shortcuts_per_round, attempts - tried))
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
    """Draw the ends (count, 2) of the next shortcuts, as shares of the path's length.

    Args:
        rng: random number generator.
        tried: number of shortcuts drawn before.
        count: number of shortcuts.
        longest: span of the first shortcut of a sweep.
        shortest: span of the last one.
        spread: largest relative change of a span.
    """
    swept = (tried + np.arange(count)) % SHORTCUTS_PER_SWEEP / SHORTCUTS_PER_SWEEP
    spans = longest * (shortest / longest) ** swept * rng.uniform(1.0 - spread, 1.0 + spread, count)
    begins = rng.random(count) * (1.0 - spans)
    picks = np.stack([begins, begins + spans], axis=1)
    if tried == 0:
        picks[0] = (0.0, 1.0)  # the whole path at once
    return picks
