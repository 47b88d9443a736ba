"""What a search is told before it starts: where to sample, or a path at once.

A proposer is anything that answers a `Query` and an `Observation` with a `Proposal`: uniform samples, Gaussians
along a straight line, around an unconstrained path or at predicted codes, a path through a roadmap.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from cvqmpt_lab.distributions import SamplingDistribution
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import JointPath, PlanStatus, Timings


@dataclass(frozen=True, eq=False)
class Observation:
    """What a method has seen of the world."""

    cloud: np.ndarray | None = None
    """(m, 3) [m, robot base frame]; None for methods that do not look."""
    seconds: float = 0.0
    """What looking took; a camera's work, charged to nobody."""
    new: bool = False
    """What is made of the cloud is made anew, and charged, although it may have been seen lately."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """Where to sample, what that took to find out, and possibly a path already found."""

    distribution: SamplingDistribution
    timings: Timings = field(default_factory=Timings)
    detail: str = ""
    """A few words about it for the result's row."""
    fallback: str = ""
    """Why this is not what the method's name promises, or ""."""
    vertices: int = 0
    """Nodes of searches made on the way."""
    path: JointPath | None = None
    """On the manifold and free; the search then has nothing left to do."""
    failure: PlanStatus | None = None
    """Why searching is pointless, or None."""


Proposer = Callable[[Query, Observation], Proposal]


def uniform(query: Query, observation: Observation) -> Proposal:
    """Sample anywhere between the joint limits."""
    return Proposal(query.uniform)
