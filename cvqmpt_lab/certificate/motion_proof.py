"""Proof that a motion is free at every state, not only at samples (conservative advancement).

A stretch of a motion is free when the distance by coal at its middle exceeds how far any link can
move inside the stretch. A stretch that is not proven is cut in two, down to `finest`; one still not
proven is reported, although its middle is free. The least distance is found in the same walk: every
stretch is proven to keep a little less than the least distance found so far. The result does not
depend on the arbitrary order in which coal reports several colliding pairs.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.collision.exact import ROUNDING, CollidingPair, CollisionChecker, Nearest
from cvqmpt_lab.geometry.polyline import Polyline


class Unproven(NamedTuple):
    """A stretch that is not proven free although its middle is."""

    length: float  # [rad]
    middle: np.ndarray  # (n,)
    hull: np.ndarray  # (c, n), its ends and the states between them


class Least(NamedTuple):
    """The least distance found along a motion, and what is proven of every state.

    distance - bound <= true least distance <= distance
    """

    distance: float  # [m], negative in collision; inf without pairs
    bound: float  # [m]; inf where nothing is proven, after a collision
    pair: CollidingPair | None
    q: np.ndarray  # (n,), where it was found


@dataclass(frozen=True, eq=False)
class MotionProof:
    """The result of `prove_free`."""

    colliding: np.ndarray | None  # (n,), the first colliding configuration found, or None
    unproven: Unproven | None  # the longest such stretch; None when there is none, or a collision
    looks: int  # stretches whose middles were compared
    obstacles: Least | None = None  # to obstacles; None when it was not asked for
    itself: Least | None = None  # of the robot's own pieces, likewise


def prove_free(
    checker: CollisionChecker, states: np.ndarray, clearance: bool = False
) -> MotionProof:
    """Prove that straight joint motions through states (m, n), m >= 1, touch nothing.

    Returns at the first collision. clearance: whether least distances are found and proven, too.
    """
    line, itself = Polyline(states), None
    own = _Least(checker.nearest_of_itself, line) if clearance else None
    room = _Least(checker.nearest_obstacle, line) if clearance else None
    clear, hits = checker.clear_of_obstacles, checker.in_collision
    proof = _walk(line, checker.links, clear, hits, room, checker.outer)
    if proof.colliding is None:
        clear = checker.clear_of_itself
        itself = _walk(line, checker.pairs, clear, hits, own, checker.margin)
        both = proof.unproven, itself.unproven
        longest = max(both, key=lambda it: it.length if it else -1.0)
        unproven = None if itself.colliding is not None else longest
        proof = MotionProof(itself.colliding, unproven, proof.looks + itself.looks)
    if room is None or own is None:
        return proof
    if proof.colliding is not None:
        for least in (room, own):
            least.lower = -np.inf
            least.measure(proof.colliding)
    return replace(proof, obstacles=room.result(), itself=own.result())


class _Least:
    """The least distance found so far, and a distance that every state is proven to keep.

    Args:
        nearest: distance and pair at a configuration, if it is below a distance.
        line: the motion, whose ends are measured first: most motions come closest there.
        share: of the least distance that is not proven, in order to be fast.
        finest: the same at least [m].
        far: distances above it are only proven to exceed it [m].
    """

    def __init__(
        self,
        nearest: Callable[[np.ndarray, float], Nearest],
        line: Polyline,
        share: float = 0.2,
        finest: float = 1e-3,
        far: float = 0.1,
    ) -> None:
        self._nearest, self._share, self._finest, self._far = nearest, share, finest, far
        self.found, self._q, self.lower = Nearest(np.inf, None), line.ends[0], far
        for q in line.ends:
            self.measure(q)

    def measure(self, q: np.ndarray) -> float:
        """At most the distance at q (n,) [m], or the least found so far, which may change."""
        found = self._nearest(q, self.found.distance)
        if found.distance < self.found.distance:
            self.found, self._q = found, q
        return (1.0 - 2.0 * ROUNDING) * found.distance - 2.0 * ROUNDING

    def aim(self, doublings: int) -> float:
        """The distance that is to be proven of the next stretches [m]."""
        unproven = min(1.0, self._share * 2.0**doublings) * self.found.distance
        return max(0.0, min(self.found.distance - max(unproven, self._finest), self._far))

    def result(self) -> Least:
        """What was found."""
        distance, pair = self.found
        if pair is None:
            return Least(distance, 0.0, None, self._q)
        return Least(distance, max(0.0, distance - self.lower), pair, self._q)


def _walk(
    line: Polyline,
    parts: int,
    clear: Callable[[np.ndarray, np.ndarray, np.ndarray, float], tuple[np.ndarray, np.ndarray]],
    hits: Callable[[np.ndarray], bool],
    least: _Least | None,
    margin: float,
    longest: float = 0.2,
    finest: float = 1e-7,
    coarse: float = 1e-4,
    doubtful: float = 0.01,
    most_fine: int = 4000,
    most_at_once: int = 64,
    effort: int = 200,
) -> MotionProof:
    """Prove stretch after stretch with `CollisionChecker.clear_of_obstacles` or `_of_itself`.

    Args:
        line: the motion.
        parts: of the robot, links or pairs, that a stretch is proven for, one after the other.
        clear: (middles, hulls, known parts, distance) -> how many parts are proven to keep it in
            each stretch, how far points of the others move.
        hits: whether a configuration collides.
        least: where the least distance is kept; None: it is not asked for.
        margin: that the checker keeps [m].
        longest: half of a stretch that is tried first [rad].
        finest: half of the shortest stretches: unproven ones whose middle is free are not cut
            further [rad].
        coarse: the same after the first such stretch, or after most_fine checks of shorter ones
            [rad].
        doubtful: half of the unproven stretches whose middle is checked for collision [rad].
        most_fine: about 0.2 s; else sliding along an obstacle at micrometres would take hours.
        most_at_once: neighbouring stretches in one call: few, because work behind a collision is
            wasted.
        effort: checks, or ten for each stretch that is tried first, after which the share of the
            least distance that is not proven doubles.
    """
    half_length = 0.5 * line.length
    count = max(1, int(np.ceil(half_length / longest)))
    # begin and half the length of each stretch, and how many parts are proven for it
    half = half_length / count
    ahead = deque((2.0 * k * half, half, 0) for k in range(count))
    looks = fine = 0
    unproven: Unproven | None = None
    while ahead:
        batch = [ahead.popleft() for _ in range(min(most_at_once, len(ahead)))]
        begins, halves, known = np.array(batch).T
        middles, hulls = line.stretches(begins, halves)
        aim = least.aim(looks // max(effort, 10 * count)) if least else 0.0
        proven, moved = clear(middles, hulls, known.astype(int), aim)
        if least:
            least.lower = min(least.lower, aim)
        left: list[tuple[float, float, int]] = []
        judged = zip(batch, middles, hulls, proven.tolist(), moved.tolist(), strict=True)
        for (begin, half, _), middle, hull, free, apart in judged:
            looks += 1
            fine += half < coarse
            if free == parts:
                continue
            if half <= doubtful and hits(middle):
                return MotionProof(middle, None, looks)
            if least and apart < 0.5 * least.found.distance:
                # the middle may be closer than any before; no state is `apart` closer than it
                kept = least.measure(middle) - apart
                if kept > margin and kept >= least.aim(looks // max(effort, 10 * count)):
                    least.lower = min(least.lower, kept)
                    continue
            if half > (coarse if unproven or fine > most_fine else finest):
                left += (begin, 0.5 * half, free), (begin + half, 0.5 * half, free)
                continue
            if least:
                least.lower = min(least.lower, least.measure(middle) - apart)
            if unproven is None or 2.0 * half > unproven.length:
                unproven = Unproven(2.0 * half, middle, hull)
        ahead.extendleft(reversed(left))
    return MotionProof(None, unproven, looks)
