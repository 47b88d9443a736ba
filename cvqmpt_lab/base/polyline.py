"""Polylines through states (m, n) [rad or m]: lengths, places along them, subdivision.

A place is a fractional index of a state: 12.5 is in the middle between states 12 and 13. Lengths
are Euclidean in joint space [rad or m].
"""

import numpy as np


def step_lengths(states: np.ndarray) -> np.ndarray:
    """Distances (m - 1,) between neighbouring states (m, n)."""
    return np.linalg.norm(np.diff(states, axis=0), axis=1)


def distances_along(states: np.ndarray) -> np.ndarray:
    """Lengths (m,) of the polyline from its first state to each of the states (m, n)."""
    return np.concatenate([[0.0], np.cumsum(step_lengths(states))])


def states_at(states: np.ndarray, marks: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate states (m, n) linearly over a parameter.

    Args:
        states: (m, n) [rad or m].
        marks: increasing values (m,) of the parameter at the states.
        at: values (k,) of the parameter.

    Returns:
        States (k, n) at the values `at`.
    """
    return np.stack([np.interp(at, marks, column) for column in states.T], axis=1)


def evenly_along(states: np.ndarray, spacing: float) -> np.ndarray:
    """States (k, n), k >= 2, at equal distances of at most `spacing`, both ends included."""
    along = distances_along(states)
    count = max(2, int(np.ceil(along[-1] / spacing)) + 1)
    return states_at(states, along, np.linspace(0.0, along[-1], count))


def states_between(states: np.ndarray, segment: np.ndarray, share: np.ndarray) -> np.ndarray:
    """States (..., n) at fractions `share` (...,) of segments: 0 is the start, 1 the end of one."""
    return states[segment] + share[..., None] * (states[segment + 1] - states[segment])


def numbered_parts(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number all parts of the polyline if segment i is cut into counts[i] parts, counts (m - 1,).

    Returns:
        Index of the segment of each part, and index of the part in its segment, (sum of counts,)
        each.
    """
    segment = np.repeat(np.arange(len(counts)), counts)
    part = np.arange(len(segment)) - np.repeat(np.cumsum(counts) - counts, counts)
    return segment, part


def parts_within(states: np.ndarray, longest: float) -> np.ndarray:
    """Smallest numbers (m - 1,) of equal parts per segment with parts of length <= `longest`."""
    return np.maximum(1, np.ceil(step_lengths(states) / longest)).astype(int)


def cut(states: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """States (k, n) of the polyline with segment i cut into counts[i] equal parts."""
    segment, part = numbered_parts(counts)
    steps = np.diff(states, axis=0)
    begins = states[segment] + steps[segment] * part[:, None] / counts[segment, None]
    return np.concatenate([begins, states[-1:]])


def nearest_places(states: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (k,) on a polyline that are nearest to points (k, n), and their distances (k,)."""
    steps = np.diff(states, axis=0)
    squared = np.maximum(np.einsum("mj,mj->m", steps, steps), np.finfo(float).tiny)
    away = points[:, None] - states[:-1]
    share = np.clip(np.einsum("kmj,mj->km", away, steps) / squared, 0.0, 1.0)
    distances = np.linalg.norm(away - share[..., None] * steps, axis=2)
    segment, rows = distances.argmin(axis=1), np.arange(len(points))
    return segment + share[rows, segment], distances[rows, segment]


class Polyline:
    """Polyline parametrised by the distance along it.

    Steps that are too short to change this distance in floating point are left out.
    """

    def __init__(self, states: np.ndarray) -> None:
        along = np.cumsum(step_lengths(states))
        longer = np.diff(along, prepend=0.0) > 0.0
        self._states = states[np.concatenate([[True], longer])]
        self._along = np.concatenate([[0.0], along[longer]])
        self.length = float(self._along[-1])
        self.ends = self._states[[0, -1]]

    def stretches(self, begins: np.ndarray, halves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the middle and all corners of stretches of the polyline.

        Args:
            begins: distances along the polyline at the start of each stretch (k,) [rad or m].
            halves: half lengths of the stretches (k,) [rad or m].

        Returns:
            Middle of each stretch (k, n); and its start, the states of the polyline inside it, and
            its end (k, c, n). The end is repeated if a stretch has fewer than c of these.
        """
        states, along = self._states, self._along
        if len(states) == 1:
            return states, states[None]
        marks = begins[:, None] + halves[:, None] * (0.0, 1.0, 2.0)
        rows = np.searchsorted(along[1:-1], marks, side="right")
        share = (marks - along[rows]) / (along[rows + 1] - along[rows])
        begins, middles, ends = states_between(states, rows, share).transpose(1, 0, 2)
        first, last = rows[:, 0] + 1, rows[:, 2]
        between = first[:, None] + np.arange(max(0, int((last - first).max()) + 1))
        inside = between <= last[:, None]
        corners = np.where(inside[..., None], states[np.where(inside, between, 0)], ends[:, None])
        return middles, np.concatenate([begins[:, None], corners, ends[:, None]], axis=1)
