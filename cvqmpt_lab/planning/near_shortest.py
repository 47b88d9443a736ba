"""Near-shortest paths by restarts, each among fewer configurations than the last: the labels of training data.

Restarts sample where a path shorter than the best known can pass alone, and that is shortened until it stops helping.
"""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.distributions import Uniform
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.result import Budget, JointPath
from cvqmpt_lab.planning.short_ways import Spheroid
from cvqmpt_lab.planning.simplify import SimplifySettings, simplify
from cvqmpt_lab.planning.space import ConstrainedSpace


@dataclass(frozen=True)
class NearShortestSettings:
    """How hard to try."""

    restarts: int = 12
    """Searches after the first path."""
    first: int = 1500
    """Iterations that the first search may take; it is tried twice."""
    later: int = 200
    """Iterations that each restart may take."""
    finish: int = 512
    """Attempts to shorten the best path in the end."""


def near_shortest(
    space: ConstrainedSpace,
    start: np.ndarray,
    goal: np.ndarray,
    rng: np.random.Generator,
    settings: NearShortestSettings | None = None,
) -> JointPath | None:
    """The shortest free path (on the manifold) found from start to goal (n,), or None when none was found."""
    settings = settings or NearShortestSettings()
    trees, lower, upper = BiRRT(), space.robot.lower, space.robot.upper
    best: JointPath | None = None
    tries = 0
    while tries < (settings.restarts + 1 if best else 2):
        tries += 1
        sampler = Spheroid(start, goal, best.length, lower, upper) if best else Uniform(lower, upper)
        budget = Budget(iterations=settings.later if best else settings.first)
        path = trees.search(space, start, goal[None], sampler, budget, rng).path
        if path is not None:
            path = simplify(space, path, rng).path
            best = path if best is None or path.length < best.length else best
        if best is not None and best.length < (1.0 + 1e-6) * np.linalg.norm(goal - start):
            return best  # the straight line
    if best is None:
        return None
    return simplify(space, best, rng, SimplifySettings(attempts=settings.finish, patience=8)).path
