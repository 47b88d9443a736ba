"""Proof that a motion is free at every state, not only at samples (conservative advancement).

A stretch of a motion is free if the distance at its middle, by coal, is larger than the motion of
any link inside the stretch. A stretch that is not proven is cut in two. A stretch of the smallest
length that is still not proven is reported, although its middle is free.

A stretch is proven to keep some distance in addition where this costs few more checks; the least of
these is a distance that every state keeps. The exact least distance takes as long again: then every
stretch is proven to keep a little less than the least distance found so far. The result does not
depend on the arbitrary order in which coal reports colliding pairs.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.polyline import Polyline
from cvqmpt_lab.collision.exact import (
    COAL_ROUNDING_M,
    Cleared,
    CollidingPair,
    CollisionChecker,
    Nearest,
)


class Unproven(NamedTuple):
    """Stretch that is not proven free although its middle is free."""

    length: float  # [rad]
    middle: np.ndarray  # (n,)
    hull: np.ndarray  # (c, n), the ends and the states between them


class LeastDistance(NamedTuple):
    """Least distance along a motion: distance - bound <= true least distance <= distance."""

    distance: float  # the least that was found, negative in collision; inf without pairs [m]
    bound: float  # inf if nothing is proven, after a collision [m]
    pair: CollidingPair | None
    q: np.ndarray  # (n,) state with this distance


@dataclass(frozen=True, eq=False)
class MotionProof:
    """Result of `prove_free`."""

    colliding: np.ndarray | None  # (n,), the first colliding configuration found, or None
    unproven: Unproven | None  # the longest unproven stretch; None after a collision
    checks: int  # number of stretches that were checked
    # distances that every state keeps from obstacles, and between own pieces [m]; -inf if one
    # stretch is not proven, inf without pairs
    kept: tuple[float, float]
    # least distances from obstacles, and between own pieces; None if they were not computed
    obstacles: LeastDistance | None = None
    itself: LeastDistance | None = None


def prove_free(
    checker: CollisionChecker, states: np.ndarray, exact_clearance: bool = False
) -> MotionProof:
    """Prove that straight joint motions through states (m, n), m >= 1, touch nothing.

    The proof ends at the first collision.

    Args:
        checker: the exact checker.
        states: (m, n) [rad or m].
        exact_clearance: whether least distances are computed and proven.
    """
    line = Polyline(states)
    to_itself = _LeastSearch(checker.nearest_of_itself, line) if exact_clearance else None
    to_obstacles = _LeastSearch(checker.nearest_obstacle, line) if exact_clearance else None
    proof = _prove(line, checker.links, checker.clear_of_obstacles, to_obstacles, checker.outer)
    if proof.colliding is None:
        itself = _prove(line, checker.pairs, checker.clear_of_itself, to_itself, checker.margin)
        both = proof.unproven, itself.unproven
        longest = max(both, key=lambda stretch: stretch.length if stretch else -1.0)
        unproven = None if itself.colliding is not None else longest
        kept = proof.kept[0], itself.kept[1]
        proof = MotionProof(itself.colliding, unproven, proof.checks + itself.checks, kept)
    kept = (
        proof.kept[0] if checker.links * checker.obstacles else np.inf,
        proof.kept[1] if checker.pairs else np.inf,
    )
    proof = replace(proof, kept=kept)
    if to_obstacles is None or to_itself is None:
        return proof
    if proof.colliding is not None:
        for least in (to_obstacles, to_itself):
            least.lower = -np.inf
            least.measure(proof.colliding)
    return replace(proof, obstacles=to_obstacles.result(), itself=to_itself.result())


class _LeastSearch:
    """Least distance found so far, and a distance that every state is proven to keep.

    Args:
        nearest: function of a state and a distance; returns the distance and the pair at the state
            if they are closer.
        line: the motion. Its ends are measured first: most motions come closest there.
        rel_tol: relative tolerance of the proven distance; a small one takes long.
        abs_tol: absolute tolerance of the proven distance [m].
        far: larger distances are only proven to be larger than this [m].
    """

    def __init__(
        self,
        nearest: Callable[[np.ndarray, float], Nearest],
        line: Polyline,
        rel_tol: float = 0.2,
        abs_tol: float = 1e-3,
        far: float = 0.1,
    ) -> None:
        self._nearest, self._rel_tol, self._abs_tol, self._far = nearest, rel_tol, abs_tol, far
        self.found, self._q = Nearest(np.inf, None), line.ends[0]
        self.lower = far  # proven of the stretches so far [m]
        for q in line.ends:
            self.measure(q)

    def measure(self, q: np.ndarray) -> float:
        """Update the least distance by the one at q (n,); return a lower bound on both [m]."""
        found = self._nearest(q, self.found.distance)
        if found.distance < self.found.distance:
            self.found, self._q = found, q
        return (1.0 - 2.0 * COAL_ROUNDING_M) * found.distance - 2.0 * COAL_ROUNDING_M

    def aim(self, doublings: int) -> float:
        """Return the distance to prove of the next stretches [m]; doublings: of `rel_tol`."""
        unproven = min(1.0, self._rel_tol * 2.0**doublings) * self.found.distance
        return max(0.0, min(self.found.distance - max(unproven, self._abs_tol), self._far))

    def result(self) -> LeastDistance:
        """Return the least distance with the bound that is proven."""
        distance, pair = self.found
        if pair is None:
            return LeastDistance(distance, 0.0, None, self._q)
        return LeastDistance(distance, max(0.0, distance - self.lower), pair, self._q)


class _Effort(NamedTuple):
    """How finely a motion is cut into stretches; lengths are half of a stretch's."""

    longest: float = 0.2  # length of the first stretches [rad]
    finest: float = 1e-7  # a stretch with a free middle is not cut below this length [rad]
    coarse: float = 1e-4  # replaces `finest` after an unproven stretch or `max_fine_checks` [rad]
    doubtful: float = 0.01  # from here on, an unproven stretch's middle is checked [rad]
    # Limit on checks of stretches shorter than `coarse`, about 0.2 s. Without it, a motion
    # micrometres above an obstacle would take hours.
    max_fine_checks: int = 4000
    most_at_once: int = 64  # stretches in one call; few, as a collision makes the rest useless
    # number of checks, or ten for each of the first stretches, after which the relative tolerance
    # of the least distance doubles
    checks: int = 200
    far: float = 0.01  # distance that long stretches keep without a search for the least one [m]
    rate: float = 0.05  # that distance per length of shorter stretches [m/rad]


_USUAL = _Effort()


def _prove(
    line: Polyline,
    parts: int,
    clear: Callable[..., Cleared],
    least: _LeastSearch | None,
    margin: float,
    effort: _Effort = _USUAL,
) -> MotionProof:
    """Prove stretch after stretch with `CollisionChecker.clear_of_obstacles` or `clear_of_itself`.

    Args:
        line: the motion.
        parts: number of links or pairs that are proven in each stretch, one after the other.
        clear: one of these two methods.
        least: search for the least distance, or None.
        margin: margin of the checker [m].
        effort: lengths of stretches and numbers of checks.
    """
    half_length = 0.5 * line.length
    count = max(1, int(np.ceil(half_length / effort.longest)))
    # begin and half the length of each stretch, and number of its parts that are proven
    half = half_length / count
    ahead = deque((2.0 * k * half, half, 0) for k in range(count))
    checks = fine = 0
    kept = np.inf
    unproven: Unproven | None = None
    while ahead:
        batch = [ahead.popleft() for _ in range(min(effort.most_at_once, len(ahead)))]
        begins, halves, known = np.array(batch).T
        middles, hulls = line.stretches(begins, halves)
        aims = np.minimum(effort.far, effort.rate * halves)
        if least:
            aims[:] = aim = least.aim(checks // max(effort.checks, 10 * count))
            least.lower = min(least.lower, aim)
        found = clear(middles, hulls, known.astype(int), aims, halves <= effort.doubtful)
        left: list[tuple[float, float, int]] = []
        columns = (values.tolist() for values in (aims, *found))
        results = zip(batch, middles, hulls, *columns, strict=True)
        for (begin, half, _), middle, hull, aim, free, motion, hit in results:
            checks += 1
            fine += half < effort.coarse
            if free == parts:
                kept = min(kept, max(aim, margin))
                continue
            if hit:
                return MotionProof(middle, None, checks, (-np.inf, -np.inf))
            if least and motion < 0.5 * least.found.distance:
                # the middle may be the closest so far; no state is closer by more than `motion`
                reached = least.measure(middle) - motion
                if reached > margin and reached >= least.aim(
                    checks // max(effort.checks, 10 * count)
                ):
                    least.lower, kept = min(least.lower, reached), min(kept, reached)
                    continue
            if half > (
                effort.coarse if unproven or fine > effort.max_fine_checks else effort.finest
            ):
                left += (begin, 0.5 * half, free), (begin + half, 0.5 * half, free)
                continue
            if least:
                least.lower = min(least.lower, least.measure(middle) - motion)
            kept = -np.inf
            if unproven is None or 2.0 * half > unproven.length:
                unproven = Unproven(2.0 * half, middle, hull)
        ahead.extendleft(reversed(left))
    return MotionProof(None, unproven, checks, (kept, kept))
