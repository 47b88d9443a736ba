"""Shortcutting on the constraint manifold: the simplification that every planner's path goes through."""

from typing import Annotated

import numpy as np

from cvqmpt_lab.jit import entry, kernel
from cvqmpt_lab.kernels.search.motion import bisect_motion, distance, segment_valid
from cvqmpt_lab.kernels.search.space_arrays import Space

KEEP = 0.999  # a shortcut must be shorter than this share of what it replaces


@kernel
def path_length(states, count):
    """Sum of distances between the first count rows of states (k, n) [rad]."""
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
    """Put detour (size rows, last one equal to states[b]) between states[a] and states[b]; new count."""
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
    """Write a direct, free motion from states[a] to states[b] into detour if it is shorter; its size or 0."""
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

    states: (capacity, n), first count rows the path, changed in place. detour: (k, n) room.

    Returns
    -------
    The new number of states. Every motion put in has been projected and checked at space.resolution.
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
