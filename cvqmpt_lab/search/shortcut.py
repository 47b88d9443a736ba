"""Shortening a path on the manifold: the same routine, bounded the same way, for every planner."""

import time
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.search.shortcut import shortcut
from cvqmpt_lab.search.result import Counters, JointPath
from cvqmpt_lab.search.space import ConstrainedSpace

ROUND = 16  # shortcuts tried between looks at the clock
SWEEP = 112  # shortcuts from the longest to the shortest
LONGEST, SHORTEST = 0.5, 0.05  # share of the path's length that a shortcut replaces, give or take SPREAD
SPREAD = 0.3


@dataclass(frozen=True)
class SimplifySettings:
    """When to stop. Without seconds the result depends on path and seed alone."""

    attempts: int = SWEEP  # shortcuts tried at most
    seconds: float | None = None  # wall time at most [s]; None: not limited
    patience: int = 4  # rounds of ROUND shortcuts without `gain` after which it stops
    gain: float = 0.002  # relative, in length

    def __post_init__(self) -> None:
        if self.attempts < 0 or (self.seconds is not None and not self.seconds > 0) or self.patience < 1:
            raise InvalidInputError(f"simplification bounds must be positive: {self}")


@dataclass(frozen=True)
class Simplified:
    """A shorter path and what it took."""

    path: JointPath  # the shorter path
    seconds: float  # wall time [s]
    counters: Counters  # work done


def simplify(
    space: ConstrainedSpace,
    path: JointPath,
    rng: np.random.Generator,
    settings: SimplifySettings | None = None,
) -> Simplified:
    """Replace stretches of a path by direct projected motions as long as that shortens it.

    Start and goal stay; every motion put in is on the manifold and checked at the fine resolution.
    """
    settings = settings or SimplifySettings()
    began = time.perf_counter()
    before = space.counters
    capacity = 2 * len(path.states) + 1024
    states = np.empty((capacity, space.robot.dof))
    states[: len(path.states)] = path.states
    detour = np.empty((capacity, space.robot.dof))
    count, length, stale, tried = len(path.states), path.length, 0, 0
    while tried < settings.attempts and stale < settings.patience:
        if settings.seconds is not None and time.perf_counter() - began > settings.seconds:
            break
        picks = _picks(rng, tried, min(ROUND, settings.attempts - tried))
        count = shortcut(space.arrays, states, count, picks, detour)
        space.reraise()
        tried += len(picks)
        shorter = JointPath(states[:count]).length
        stale = stale + 1 if shorter > (1.0 - settings.gain) * length else 0
        length = shorter
    return Simplified(
        JointPath(states[:count].copy()), time.perf_counter() - began, space.counters_since(before)
    )


def _picks(rng: np.random.Generator, tried: int, count: int) -> np.ndarray:
    """Ends (count, 2) of the next shortcuts, as shares of the path's length: long ones first, then ever shorter."""
    swept = (tried + np.arange(count)) % SWEEP / SWEEP
    spans = LONGEST * (SHORTEST / LONGEST) ** swept * rng.uniform(1.0 - SPREAD, 1.0 + SPREAD, count)
    begins = rng.random(count) * (1.0 - spans)
    picks = np.stack([begins, begins + spans], axis=1)
    if tried == 0:
        picks[0] = (0.0, 1.0)  # the whole path at once
    return picks
