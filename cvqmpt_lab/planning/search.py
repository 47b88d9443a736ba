"""The one interface behind which all searches stand, and how one is used on a proposal."""

from dataclasses import replace
from typing import Protocol

import numpy as np

from cvqmpt_lab.distributions import SamplingDistribution
from cvqmpt_lab.planning.proposal import Proposal
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import Budget, PlanResult, PlanStatus
from cvqmpt_lab.planning.space import ConstrainedSpace


class Search(Protocol):
    """A search for a path on the constraint manifold."""

    def search(
        self,
        space: ConstrainedSpace,
        start: np.ndarray,
        goals: np.ndarray,
        distribution: SamplingDistribution,
        budget: Budget,
        rng: np.random.Generator,
    ) -> PlanResult:
        """Search a path from start (n,) to any row of goals (k, n) [rad or m]."""


def search(method: Search, query: Query, proposal: Proposal) -> PlanResult:
    """Search where a proposal says, with what is left of the budget; time and work of both are added up."""
    allowance, sampler = query.allowance, proposal.distribution.name
    if proposal.path is not None:
        result = allowance.ended(PlanStatus.SOLVED, sampler, proposal.path)
    elif (status := proposal.failure or allowance.spent()) is not None:
        result = allowance.ended(status, sampler)
    else:
        result = method.search(
            query.space, query.start, query.goals, proposal.distribution, allowance.rest(), query.rng
        )
    return replace(
        result,
        seconds=allowance.seconds,
        counters=allowance.counters,
        vertices=proposal.vertices + result.vertices,
        timings=proposal.timings,
        detail="; ".join(filter(None, (proposal.detail, result.detail))),
        fallback=proposal.fallback,
    )
