"""A smooth curve along a polyline, at a measured distance from it.

A robot can pass a corner of a planner's path without stopping only if the corner is rounded. The
curve is Schoenberg's
spline: a cubic B-spline over arc length whose i-th control point is the polyline at the average of
    knots i + 1 to i + 3. It keeps straight stretches, rounds corners on the inside (an
    interpolating spline would leave the checked clearance), stays in the range of each joint and
    has continuous curvature. Its distance from a corner is about a sixth of the knot spacing times
    the change of direction, so knots are packed at corners until that distance is small enough.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline

from cvqmpt_lab.errors import InvalidInputError

SPACING = 0.08  # [rad] between knots on smooth stretches
SPANS = 20  # at least, however short the path
FLAT = 1.5  # finest spacings, either side of a corner, before the spacing grows
GROWTH = 0.5  # knot spacing grows by this share of the distance from a corner
FINE_BELOW = 0.6  # of the longest knot span: shorter ones are cut in four, others in three
SAMPLES = 8  # places a knot span at which the distance is measured
REFINEMENTS = 40


@dataclass(frozen=True, eq=False)
class SmoothCurve:
    """A twice continuously differentiable curve q(s), s from 0 to `length`, about arc length [rad
    or m].
    """

    spline: BSpline  # q(s) (n,) [rad or m]
    knots: np.ndarray  # (k,) distinct knots [rad]
    deviation: float  # Largest distance measured between q(s) and the polyline at s [rad]
    marks: np.ndarray  # (m,) of the waypoints [rad]

    @cached_property
    def grid(self) -> np.ndarray:
        """Places (g,) [rad] at which speeds are computed:
        knots, and points between them, more at corners.
        """
        spans = np.diff(self.knots)
        parts = np.where(spans < FINE_BELOW * spans.max(), 4, 3)
        cuts = [a + np.arange(m) / m * d for a, d, m in zip(self.knots, spans, parts, strict=False)]
        return np.concatenate([*cuts, self.knots[-1:]])

    @property
    def length(self) -> float:
        """Length of the polyline [rad]."""
        return float(self.marks[-1])

    def waypoint(self, s: float) -> int:
        """Index of the waypoint next to s."""
        return int(np.argmin(np.abs(self.marks - s)))


def smooth_curve(waypoints: np.ndarray, deviation: float) -> SmoothCurve:
    """Curve along waypoints (m, n), nowhere further than deviation [rad] from their polyline."""
    if not (np.isfinite(deviation) and deviation > 0.0):
        raise InvalidInputError(f"deviation {deviation}: give a distance above 0 [rad]")
    states = checked_waypoints(waypoints)
    steps = np.diff(states, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    marks = np.concatenate([[0.0], np.cumsum(lengths)])
    turns = np.linalg.norm(np.diff(steps / lengths[:, None], axis=0), axis=1)
    spacing, aim = min(SPACING, marks[-1] / SPANS), deviation
    for _ in range(REFINEMENTS):
        knots = _knots(marks, turns, spacing, aim)
        spline = _schoenberg(states, marks, knots)
        measured = _distance(states, marks, knots, spline)
        if measured <= deviation:
            return SmoothCurve(spline, knots, measured, marks)
        aim *= 0.9 * deviation / measured
        spacing *= np.sqrt(0.9 * deviation / measured)
    raise InvalidInputError(
        f"no smooth curve within {deviation} rad of the path was found; give a larger deviation"
    )


def checked_waypoints(waypoints: np.ndarray) -> np.ndarray:
    """The waypoints (m, n) as floats; refused unless m >= 2, all finite, neighbours distinct."""
    try:
        states = np.array(waypoints, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(
            "waypoints are not an array of numbers: give (m, n) joint values [rad]"
        ) from error
    if states.ndim != 2 or len(states) < 2 or states.shape[1] == 0:
        raise InvalidInputError(
            f"waypoints have shape {states.shape}: give (m, n), two or more, one value a joint "
            f"[rad]"
        )
    broken = np.argwhere(~np.isfinite(states))
    if len(broken):
        k, j = (int(i) for i in broken[0])
        raise InvalidInputError(
            f"waypoint {k} has {states[k, j]} at joint index {j}: give finite numbers"
        )
    same = np.flatnonzero(np.linalg.norm(np.diff(states, axis=0), axis=1) < 1e-9)
    if len(same):
        k = int(same[0])
        raise InvalidInputError(f"waypoint {k + 1} repeats waypoint {k}: leave one of the two out")
    return states


def _knots(marks: np.ndarray, turns: np.ndarray, spacing: float, aim: float) -> np.ndarray:
    """Knots (k,) from 0 to the end, so dense at waypoints with turns (m - 2,) that the corner is
    cut by aim.
    """
    at_corner = 6.0 * aim / np.maximum(turns, 1e-12)
    sharp = at_corner < spacing
    corners, finest = marks[1:-1][sharp], at_corner[sharp]
    # The spacing wished for is sampled on a lattice and, as it changes fast there, close to
    # corners.
    lattice = np.linspace(0.0, marks[-1], 4 * int(np.ceil(marks[-1] / spacing)) + 1)
    around = corners[:, None] + np.outer(finest, (-6, -4, -2.5, -FLAT, 0, FLAT, 2.5, 4, 6))
    s = np.unique(np.clip(np.concatenate([lattice, around.ravel()]), 0.0, marks[-1]))
    wish = np.full(len(s), spacing)
    for corner, fine in zip(corners, finest, strict=True):
        wish = np.minimum(wish, fine + GROWTH * np.maximum(np.abs(s - corner) - FLAT * fine, 0.0))
    density = 0.5 * (1.0 / wish[1:] + 1.0 / wish[:-1]) * np.diff(s)
    count = np.concatenate([[0.0], np.cumsum(density)])
    spans = max(SPANS, int(np.ceil(count[-1])))
    return np.interp(np.linspace(0.0, count[-1], spans + 1), count, s)


def _schoenberg(states: np.ndarray, marks: np.ndarray, knots: np.ndarray) -> BSpline:
    """Cubic B-spline with control points on the polyline, at the averages of three knots."""
    t = np.concatenate([np.repeat(knots[0], 3), knots, np.repeat(knots[-1], 3)])
    averages = (t[1:-3] + t[2:-2] + t[3:-1]) / 3.0
    return BSpline(t, _polyline(states, marks, averages), 3)


def _polyline(states: np.ndarray, marks: np.ndarray, s: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(s, marks, joint) for joint in states.T], axis=1)


def _distance(states: np.ndarray, marks: np.ndarray, knots: np.ndarray, spline: BSpline) -> float:
    """Largest distance between spline and polyline at equal s:
    no less than that between the two sets.
    """
    inside = np.arange(SAMPLES) / SAMPLES * np.diff(knots)[:, None]
    s = np.concatenate([(knots[:-1, None] + inside).ravel(), marks])
    return float(np.linalg.norm(spline(s) - _polyline(states, marks, s), axis=1).max())
