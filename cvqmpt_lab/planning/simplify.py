"""Shortening a path on the manifold: the same routine, bounded the same way, for every planner."""

import time
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.search.shortcut import shortcut
from cvqmpt_lab.planning.result import Counters, JointPath
from cvqmpt_lab.planning.space import ConstrainedSpace

ROUND = 16  # shortcuts tried between looks at the clock


@dataclass(frozen=True)
class SimplifySettings:
    """When to stop. Without seconds the result depends on path and seed alone."""

    attempts: int = 64
    """Shortcuts tried at most."""
    seconds: float | None = None
    """Wall time at most [s]; None: not limited."""
    patience: int = 4
    """Rounds of ROUND shortcuts without `gain` after which it stops."""
    gain: float = 0.002
    """Relative, in length."""

    def __post_init__(self) -> None:
        if self.attempts < 0 or (self.seconds is not None and not self.seconds > 0) or self.patience < 1:
            raise InvalidInputError(f"simplification bounds must be positive: {self}")


@dataclass(frozen=True)
class Simplified:
    """A shorter path and what it took."""

    path: JointPath
    """The shorter path."""
    seconds: float
    """Wall time [s]."""
    counters: Counters
    """Work done."""


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
        picks = rng.random((min(ROUND, settings.attempts - tried), 2))
        if tried == 0:
            picks[0] = (0.0, 1.0)  # the whole path at once
        count = shortcut(space.arrays, states, count, picks, detour)
        space.reraise()
        tried += len(picks)
        shorter = JointPath(states[:count]).length
        stale = stale + 1 if shorter > (1.0 - settings.gain) * length else 0
        length = shorter
    return Simplified(
        JointPath(states[:count].copy()), time.perf_counter() - began, space.counters_since(before)
    )
