"""Whether a motion is free at every state of it, not only at samples.

At a state, distances by coal say how far any link may move before it can touch anything; the next state to look at
is where the stretch proven so far ends. Where the robot is so close that this leads nowhere, the motion is passed
in steps of FINEST, and the proof says so.
"""

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.scene.exact_checker import CollisionChecker

FIRST, LONGEST = 0.02, 0.4
"""[rad] half of the first stretch tried, and of the longest."""
FINEST = 1e-4
"""[rad] half of a stretch that is passed when it cannot be proven and its middle is free."""
WIDER, NARROWER = 1.4, 0.5
"""How stretches change after a proof and after none."""


@dataclass(frozen=True, eq=False)
class MotionProof:
    """What is known of a motion."""

    colliding: np.ndarray | None
    """(n,), the first colliding configuration found, or None."""
    unproven: float
    """Length of the longest stretch that was passed without a proof [rad]; 0 when there is none."""
    tightest: np.ndarray
    """(k, n), middles of all stretches, those proven with the least room first."""
    looks: int
    """Configurations looked at."""


def prove_free(checker: CollisionChecker, states: np.ndarray) -> MotionProof:
    """Prove that straight joint motions through states (m, n), m >= 1, touch nothing; stops at a collision."""
    line = _Polyline(states)
    obstacles = _march(line, checker.clear_of_obstacles, checker.in_collision)
    if obstacles.colliding is not None:
        return obstacles
    itself = _march(line, checker.clear_of_itself, checker.in_collision)
    return MotionProof(
        itself.colliding,
        max(obstacles.unproven, itself.unproven),
        obstacles.tightest,
        obstacles.looks + itself.looks,
    )


def _march(
    line: "_Polyline", clear: Callable[[np.ndarray, np.ndarray], bool], hits: Callable[[np.ndarray], bool]
) -> MotionProof:
    """Walk along a line in stretches that are clear around their middle."""
    done, half, looks, unproven = 0.0, FIRST, 0, 0.0
    proven: list[tuple[float, np.ndarray]] = []
    while done < line.length or looks == 0:
        half = min(half, 0.5 * (line.length - done))
        middle, hull = line.stretch(done, half)
        looks += 1
        if not clear(middle, hull):
            if half > FINEST:
                half *= NARROWER
                continue
            if hits(middle):
                return MotionProof(middle, unproven, np.empty((0, len(middle))), looks)
            unproven = max(unproven, 2.0 * half)
        proven.append((half, middle))
        done += 2.0 * half
        half = min(WIDER * max(half, FINEST), LONGEST)
        if line.length - done < 1e-12:
            break
    order = np.argsort([room for room, _ in proven], kind="stable")
    return MotionProof(None, unproven, np.array([proven[k][1] for k in order]), looks)


class _Polyline:
    """Straight joint motions through states, by the distance along them."""

    def __init__(self, states: np.ndarray) -> None:
        along = np.cumsum(np.linalg.norm(np.diff(states, axis=0), axis=1))
        apart = np.diff(along, prepend=0.0) > 0.0  # steps too short to change the distance are none
        self._states = states[np.concatenate([[True], apart])]
        self._along = [0.0, *along[apart].tolist()]
        self.length = self._along[-1]

    def stretch(self, begin: float, half: float) -> tuple[np.ndarray, np.ndarray]:
        """The middle (n,) of a stretch, and its ends with all states between them (k, n)."""
        states, along = self._states, self._along
        if len(states) == 1:
            return states[0], states
        ends, rows = [], []
        for mark in (begin, begin + half, begin + 2.0 * half):
            row = min(bisect_right(along, mark) - 1, len(along) - 2)
            share = (mark - along[row]) / (along[row + 1] - along[row])
            ends.append(states[row] + share * (states[row + 1] - states[row]))
            rows.append(row)
        return ends[1], np.vstack((ends[0], *states[rows[0] + 1 : rows[2] + 1], ends[2]))
