"""Refinement of a path where straight motions leave the manifold, and its fine check, compiled."""

from typing import Annotated

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel, placed
from cvqmpt_lab.search.motion import (
    MAX_LENGTH_RATIO,
    Space,
    chord_on_manifold,
    distance,
    path_blocked,
    project_state,
)


@entry
def refine_and_check(
    space: Space,
    states: Annotated[np.ndarray, "count n"],
    out: Annotated[np.ndarray, "capacity n"],
    segment: Annotated[np.ndarray, "int64 capacity"],
    check: bool,
):
    """Copy a path, insert projected states where it leaves the manifold, and check all motions.

    Args:
        space: the planning space.
        states: the path (m, n) [rad or m].
        out: (capacity, n), written.
        segment: (capacity,), written: the segment of `states` that ends at, or contains, each state
            of out.
        check: whether motions are checked; False: they are known to be free.

    Returns:
        Number of states in out; a segment of `states` that cannot be refined or is not free, or -1;
        and the number of segments, from the first one on, that are refined and free.
    """
    space = placed(space)
    count, n = states.shape
    most_halvings = 8  # per segment
    last = out.shape[0] - 1  # the last rows of out hold states that come later, the next one first
    for j in range(n):
        out[0, j] = states[0, j]
    written = 1
    for i in range(1, count):
        waiting = 1
        for j in range(n):
            out[last, j] = states[i, j]
        while waiting > 0:
            if written + most_halvings + 1 > last:
                return written, i - 1, 0
            before, after = out[written - 1], out[last - waiting + 1]
            if distance(before, after) > MAX_LENGTH_RATIO * space.step or not chord_on_manifold(
                space, before, after
            ):
                for j in range(n):
                    out[last - waiting, j] = 0.5 * (before[j] + after[j])
                if waiting > most_halvings or not project_state(space, out[last - waiting]):
                    return written, i - 1, 0
                waiting += 1
                continue
            for j in range(n):
                out[written, j] = after[j]
            segment[written] = i - 1
            written += 1
            waiting -= 1
    blocked = path_blocked(space, out, written) if check else -1
    if blocked < 0:
        return written, -1, count - 1
    return written, segment[blocked + 1], segment[space.proven[0] + 1]


@kernel
def _cut(proven, first, last, way, longest, pieces, count):
    """Cut a stretch of motions into pieces of proven ones, and of at most `longest` others.

    Args:
        proven: (m - 1,) bool.
        first: motion at which to begin.
        last: motion before which to stop.
        way: 1: forwards; -1: backwards, from `last` on.
        longest: largest number of unproven motions of a piece.
        pieces: (m - 1, 5), written from row `count` on: first and last state, and whether proven.
        count: number of its rows so far.

    Returns:
        Number of rows.
    """
    left, at = last - first, first if way > 0 else last - 1
    while left > 0:
        known, size = proven[at], 1
        while size < left and proven[at + way * size] == known and (known or size < longest):
            size += 1
        begin = at if way > 0 else at - size + 1
        pieces[count, 0], pieces[count, 1], pieces[count, 2] = begin, begin + size, int(known)
        count, at, left = count + 1, at + way * size, left - size
    return count


@entry
def refine_pieces(
    space: Space,
    states: Annotated[np.ndarray, "count n"],
    proven: Annotated[np.ndarray, "bool motions"],
    middle: int,
    longest: int,
    out: Annotated[np.ndarray, "capacity n"],
    segment: Annotated[np.ndarray, "int64 capacity"],
    pieces: Annotated[np.ndarray, "int64 motions 5"],
):
    """Call `refine_and_check` on pieces of a path: first on those that may fail, until one does.

    Args:
        space: the planning space.
        states: the path (m, n) [rad or m].
        proven: (m - 1,), whether each motion is known to be free; those that pass are marked.
        middle: pieces before this motion are checked from the first one on, others from the last.
        longest: largest number of motions that are checked together.
        out: (capacity, n), written: the refined states of one piece after another.
        segment: (capacity,), work array.
        pieces: (m - 1, 5), written: first and last state of each piece, whether it was known to be
            free, and where its states begin and end in out.

    Returns:
        Number of pieces, or -1 less the index of a motion that fails.
    """
    space = placed(space)
    count = _cut(proven, 0, middle, 1, longest, pieces, 0)
    count = _cut(proven, middle, proven.shape[0], -1, longest, pieces, count)
    begin = 0
    for known in range(2):
        for k in range(count):
            first, last = pieces[k, 0], pieces[k, 1]
            if pieces[k, 2] != known:
                continue
            written, bad, passed = refine_and_check(
                space, states[first : last + 1], out[begin:], segment[begin:], known == 0
            )
            for i in range(passed):
                proven[first + i] = True
            if bad >= 0:
                return -1 - first - bad
            pieces[k, 3], pieces[k, 4] = begin, begin + written
            begin += written
    return count
