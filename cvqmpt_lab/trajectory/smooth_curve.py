"""A curve along a path with rounded corners.

A robot can pass a corner of a planner's path without stopping only if the corner is rounded. The
curve q(s) is Schoenberg's spline: a cubic B-spline over arc length whose i-th control point is the
polyline at the average of knots i + 1 to i + 3. It keeps straight stretches, rounds corners on the
inside (an interpolating spline would leave the checked clearance), stays in the range of each joint
and has continuous curvature. Its distance from a corner is about a sixth of the knot spacing times
the change of direction, so knots are packed at corners until that distance is small enough.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from cvqmpt_lab.errors import InvalidInputError


@dataclass(frozen=True, eq=False)
class SmoothCurve:
    """A twice continuously differentiable curve q(s), s about arc length [rad or m]."""

    spline: BSpline  # q(s) (n,) [rad or m]
    grid: np.ndarray  # (g,) places at which speeds are computed: knots, and points between [rad]
    deviation: float  # largest distance measured between q(s) and the polyline at s [rad]
    marks: np.ndarray  # (m,) of the waypoints, the last the length of the polyline [rad]


def smooth_curve(
    states: np.ndarray,
    deviation: float,
    widest: float = 0.08,
    spans: int = 20,
    refinements: int = 40,
    samples: int = 8,
) -> SmoothCurve:
    """Curve along waypoints, nowhere further than deviation from their polyline.

    Args:
        states: waypoints (m, n) [rad or m], neighbours distinct.
        deviation: [rad].
        widest: spacing of knots on smooth stretches [rad].
        spans: between knots at least, however short the path.
        refinements: how often knots are packed more densely.
        samples: places a knot span at which the distance is measured.
    """
    if not (np.isfinite(deviation) and deviation > 0.0):
        raise InvalidInputError(f"deviation {deviation}: give a distance above 0 [rad]")
    steps = np.diff(states, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    marks = np.concatenate([[0.0], np.cumsum(lengths)])
    turns = np.linalg.norm(np.diff(steps / lengths[:, None], axis=0), axis=1)

    def polyline(s: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(s, marks, joint) for joint in states.T], axis=1)

    spacing, aim = min(widest, marks[-1] / spans), deviation
    for _ in range(refinements):
        knots = _knots(marks, turns, spacing, aim, spans)
        t = np.concatenate([np.repeat(knots[0], 3), knots, np.repeat(knots[-1], 3)])
        spline = BSpline(t, polyline((t[1:-3] + t[2:-2] + t[3:-1]) / 3.0), 3)
        inside = np.arange(samples) / samples * np.diff(knots)[:, None]
        s = np.concatenate([(knots[:-1, None] + inside).ravel(), marks])
        # at equal s: no less than the distance between the two sets
        measured = float(np.linalg.norm(spline(s) - polyline(s), axis=1).max())
        if measured <= deviation:
            # points between knots: spans are cut in three, short ones at corners in four
            steps = np.diff(knots)
            parts = np.where(steps < 0.6 * steps.max(), 4, 3)
            cuts = [a + np.arange(m) / m * d for a, d, m in zip(knots, steps, parts, strict=False)]
            return SmoothCurve(spline, np.concatenate([*cuts, knots[-1:]]), measured, marks)
        aim *= 0.9 * deviation / measured
        spacing *= np.sqrt(0.9 * deviation / measured)
    raise InvalidInputError(
        f"no smooth curve within {deviation} rad of the path was found; give a larger deviation"
    )


def _knots(
    marks: np.ndarray,
    turns: np.ndarray,
    spacing: float,
    aim: float,
    spans: int,
    flat: float = 1.5,
    growth: float = 0.5,
) -> np.ndarray:
    """Knots (k,) from 0 to the end, dense enough at waypoints to cut their corners by aim.

    Args:
        marks: (m,) of the waypoints [rad].
        turns: (m - 2,) changes of direction.
        spacing: on smooth stretches [rad].
        aim: distance from a corner [rad].
        spans: at least.
        flat: finest spacings, either side of a corner, before the spacing grows.
        growth: the spacing grows by this share of the distance from a corner.
    """
    at_corner = 6.0 * aim / np.maximum(turns, 1e-12)
    sharp = at_corner < spacing
    corners, finest = marks[1:-1][sharp], at_corner[sharp]
    # the spacing wished for is sampled on a lattice and, as it changes fast there, at corners
    lattice = np.linspace(0.0, marks[-1], 4 * int(np.ceil(marks[-1] / spacing)) + 1)
    around = corners[:, None] + np.outer(finest, (-6, -4, -2.5, -flat, 0, flat, 2.5, 4, 6))
    s = np.unique(np.clip(np.concatenate([lattice, around.ravel()]), 0.0, marks[-1]))
    wish = np.full(len(s), spacing)
    for corner, fine in zip(corners, finest, strict=True):
        wish = np.minimum(wish, fine + growth * np.maximum(np.abs(s - corner) - flat * fine, 0.0))
    density = 0.5 * (1.0 / wish[1:] + 1.0 / wish[:-1]) * np.diff(s)
    count = np.concatenate([[0.0], np.cumsum(density)])
    most = max(spans, int(np.ceil(count[-1])))
    return np.interp(np.linspace(0.0, count[-1], most + 1), count, s)
