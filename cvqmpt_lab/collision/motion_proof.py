"""Proof that a motion is free at every state, not only at samples (conservative advancement).

A stretch of a motion is free when the distance by coal at its middle exceeds how far any link can
move inside the stretch. A stretch that is not proven is cut in two, down to `finest`; one still not
proven is reported, although its middle is free. The result does not depend on the arbitrary order
in which coal reports several colliding pairs.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.collision.exact import CollisionChecker


class Unproven(NamedTuple):
    """A stretch that is not proven free although its middle is."""

    length: float  # [rad]
    middle: np.ndarray  # (n,)
    hull: np.ndarray  # (c, n), its ends and the states between them


@dataclass(frozen=True, eq=False)
class MotionProof:
    """The result of `prove_free`."""

    colliding: np.ndarray | None  # (n,), the first colliding configuration found, or None
    unproven: Unproven | None  # the longest such stretch; None when there is none, or a collision
    tightest: np.ndarray  # (k, n), middles of all stretches, those proven with the least room first
    looks: int  # stretches whose middles were measured


def prove_free(checker: CollisionChecker, states: np.ndarray) -> MotionProof:
    """Prove that straight joint motions through states (m, n), m >= 1, touch nothing.

    Returns at the first collision.
    """
    line = _Polyline(states)
    obstacles = _walk(line, checker.clear_of_obstacles, checker.in_collision)
    if obstacles.colliding is not None:
        return obstacles
    itself = _walk(line, checker.clear_of_itself, checker.in_collision)
    looks = obstacles.looks + itself.looks
    if itself.colliding is not None:
        return replace(itself, looks=looks)
    unproven = max(obstacles.unproven, itself.unproven, key=lambda it: it.length if it else -1.0)
    return MotionProof(None, unproven, obstacles.tightest, looks)


def _walk(
    line: "_Polyline",
    clear: Callable[[np.ndarray, np.ndarray], np.ndarray],
    hits: Callable[[np.ndarray], bool],
    longest: float = 0.2,
    finest: float = 1e-7,
    coarse: float = 1e-4,
    doubtful: float = 0.01,
    most_fine: int = 4000,
    most_at_once: int = 64,
) -> MotionProof:
    """Prove stretch after stretch with `CollisionChecker.clear_of_obstacles` or `_of_itself`.

    Args:
        line: the motion.
        clear: (middles, hulls) -> which stretches are proven free.
        hits: whether a configuration collides.
        longest: half of a stretch that is tried first [rad].
        finest: half of the shortest stretches: unproven ones whose middle is free are not cut
            further [rad].
        coarse: the same after the first such stretch, or after most_fine checks of shorter ones
            [rad].
        doubtful: half of the unproven stretches whose middle is checked for collision [rad].
        most_fine: about 0.2 s; else sliding along an obstacle at micrometres would take hours.
        most_at_once: neighbouring stretches in one call: few, because work behind a collision is
            wasted.
    """
    half_length = 0.5 * line.length
    count = max(1, int(np.ceil(half_length / longest)))
    # begin and half the length of each stretch
    ahead = deque((2.0 * k * half_length / count, half_length / count) for k in range(count))
    looks = fine = 0
    unproven: Unproven | None = None
    proven: list[tuple[float, np.ndarray]] = []
    while ahead:
        batch = [ahead.popleft() for _ in range(min(most_at_once, len(ahead)))]
        middles, hulls = line.stretches(np.array(batch))
        left: list[tuple[float, float]] = []
        judged = zip(batch, middles, hulls, clear(middles, hulls), strict=True)
        for (begin, half), middle, hull, free in judged:
            looks += 1
            fine += half < coarse
            if not free:
                if half <= doubtful and hits(middle):
                    return MotionProof(middle, None, np.empty((0, len(middle))), looks)
                if half > (coarse if unproven or fine > most_fine else finest):
                    left += (begin, 0.5 * half), (begin + half, 0.5 * half)
                    continue
                if unproven is None or 2.0 * half > unproven.length:
                    unproven = Unproven(2.0 * half, middle, hull)
            proven.append((half, middle))
        ahead.extendleft(reversed(left))
    order = np.argsort([half for half, _ in proven], kind="stable")
    return MotionProof(None, unproven, np.array([proven[k][1] for k in order]), looks)


class _Polyline:
    """Straight joint motions through states, by the distance along them."""

    def __init__(self, states: np.ndarray) -> None:
        along = np.cumsum(np.linalg.norm(np.diff(states, axis=0), axis=1))
        apart = np.diff(along, prepend=0.0) > 0.0  # steps too short to change the distance are none
        self._states = states[np.concatenate([[True], apart])]
        self._along = np.concatenate([[0.0], along[apart]])
        self.length = float(self._along[-1])

    def stretches(self, stretches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Middles (k, n) of stretches (k, 2), begin and half length, and their hulls.

        Hulls (k, c, n) are the ends with all states between them; shorter ones repeat their end.
        """
        states, along = self._states, self._along
        if len(states) == 1:
            return states, states[None]
        marks = stretches[:, :1] + stretches[:, 1:] * (0.0, 1.0, 2.0)
        rows = np.clip(np.searchsorted(along, marks, side="right") - 1, 0, len(along) - 2)
        share = (marks - along[rows]) / (along[rows + 1] - along[rows])
        along = states[rows] + share[..., None] * (states[rows + 1] - states[rows])
        begins, middles, ends = np.moveaxis(along, 1, 0)
        first, last = rows[:, 0] + 1, rows[:, 2]
        between = first[:, None] + np.arange(max(0, int((last - first).max()) + 1))
        inside = between <= last[:, None]
        corners = np.where(inside[..., None], states[np.where(inside, between, 0)], ends[:, None])
        return middles, np.concatenate([begins[:, None], corners, ends[:, None]], axis=1)
