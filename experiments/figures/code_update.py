"""The mixtures that `cvq-mpt` and `opt-cvq-mpt` sample: before and after the paper's Algorithm 2.

The planner's own stages run: the transformer predicts codes from cloud, start and goals, the
decoder makes Gaussians of them, Algorithm 2 moves the codes. Gaussians around goals are part of
what is sampled and are not moved. Draws are taken before limits and projection, with the same
standard normal numbers before and after. All Gaussians of a mixture are equally likely, so equally
many draws of each are draws of the mixture.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, whole_number
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.planning.pipeline import with_drawn_goals
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.planner_interface import GaussianMixture, Observation, Query
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.vqmpt.code_predictors import CodeProposal
from cvqmpt_lab.vqmpt.learned_sampler import model_of

PLANNER, PUBLISHED = "opt-cvq-mpt", "cvq:published+algorithm-2"
WHEN = ("before", "after")


@dataclass(frozen=True, kw_only=True)
class UpdateSettings:
    """Seed and number of draws of a measured update."""

    seed: int = 0
    samples: int = 500  # draws of each Gaussian, before and after

    def __post_init__(self) -> None:
        whole_number("seed of the update", self.seed)
        whole_number("samples of the update", self.samples, 1)


@dataclass(frozen=True, eq=False)
class CodeUpdate:
    """A mixture of c codes and k goals before and after the update; F^T F [constraint units^2]."""

    problem: PlanningProblem  # with its goals
    cloud: np.ndarray  # what the model saw (m, 3) [m]
    codes: np.ndarray  # (c,), predicted: rows of the dictionary
    before: GaussianMixture  # of c codes, then of k goals
    after: GaussianMixture
    noise: np.ndarray  # (s, n), standard normal

    def draws(self, when: str, component: int) -> np.ndarray:
        """Configurations (s, n) [rad] of one Gaussian, before or after."""
        mixture: GaussianMixture = getattr(self, when)
        scale = np.linalg.cholesky(mixture.covariances[component])
        return mixture.means[component] + self.noise @ scale.T

    def g(self, when: str) -> np.ndarray:
        """F^T F at the draws of every Gaussian (c + k, s)."""
        every = range(len(self.before.means))
        return np.array(
            [squared_residual(self.problem.manifold, self.draws(when, i)) for i in every]
        )

    def rows(self) -> list[dict[str, object]]:
        """A row for each Gaussian: F^T F at its mean, its mean over draws, share of F = 0."""
        means = {"before": self.before.means, "after": self.after.means}
        centres = {when: squared_residual(self.problem.manifold, means[when]) for when in WHEN}
        g = {when: self.g(when) for when in WHEN}
        return [
            {
                "problem": self.problem.name,
                "code": int(self.codes[i]) if i < len(self.codes) else "goal",
                **{f"centre_{when}": float(centres[when][i]) for when in WHEN},
                **{f"g_{when}": float(g[when][i].mean()) for when in WHEN},
                **{f"satisfied_{when}": float((g[when][i] == 0.0).mean()) for when in WHEN},
                "kept": int((self.before.means[i] == self.after.means[i]).all()),
            }
            for i in range(len(self.before.means))
        ]


def update_codes(
    problem: PlanningProblem, model: str | None, settings: UpdateSettings
) -> CodeUpdate:
    """Observe the scene, predict, update; model: as of `vqmpt.weights.resolve_model`.

    InvalidInputError: there is no goal, or no code was predicted.
    """
    problem = with_drawn_goals(problem)
    if len(problem.goals) == 0:
        raise InvalidInputError(f"problem {problem.name}: no goal was found; choose another")
    planned, drawn = map(np.random.default_rng, np.random.SeedSequence(settings.seed).spawn(2))
    published = model is not None and model_of(model).config.kind == "published"
    stages = planner_named(PUBLISHED if published else PLANNER, model).stages(problem)
    assert stages.observe is not None and stages.update is not None
    cloud = stages.observe(problem.scene)
    query = Query.of(
        ConstrainedSpace.of(problem), problem.start, problem.goals, Budget(seconds=60.0), planned
    )
    proposal = stages.predict(query, Observation(cloud))
    assert isinstance(proposal, CodeProposal)
    before, after = proposal.distribution, stages.update(query, proposal).distribution
    if not isinstance(before, GaussianMixture) or not isinstance(after, GaussianMixture):
        raise InvalidInputError(
            f"problem {problem.name}: the model predicted no codes; choose another problem or model"
        )
    noise = drawn.standard_normal((settings.samples, problem.robot.dof))
    return CodeUpdate(problem, cloud, proposal.codes, before, after, noise)


def squared_residual(constraint: RegionConstraint, q: np.ndarray) -> np.ndarray:
    """F^T F (s,) of configurations (s, n) [rad]; zero where the constraint holds."""
    return np.square(constraint.residual(q)).sum(axis=1)


def pooled_g(updates: Sequence[CodeUpdate], what: str, when: str) -> np.ndarray:
    """F^T F at the draws of all problems' codes (what: "codes"), or of all that is sampled."""
    every = [u.g(when)[: len(u.codes) if what == "codes" else None].ravel() for u in updates]
    return np.concatenate(every)


def exceedance_rows(
    updates: Sequence[CodeUpdate], deltas: Sequence[float] = (1e-4, 1e-3, 0.01, 0.1, 1.0)
) -> list[dict[str, object]]:
    """P(G > delta) and its bound E[G] / delta (paper, Markov's inequality), G = F(q)^T F(q).

    Shares of draws before limits and projection; deltas [constraint units^2].
    """
    rows: list[dict[str, object]] = []
    for what in ("codes", "all"):
        g = {when: pooled_g(updates, what, when) for when in WHEN}
        rows += [
            {
                "of": what,
                "delta": delta,
                **{when: float((g[when] > delta).mean()) for when in WHEN},
                **{f"bound_{when}": min(1.0, float(g[when].mean()) / delta) for when in WHEN},
            }
            for delta in deltas
        ]
    return rows


def histogram_rows(
    updates: Sequence[CodeUpdate], bins: int = 40, shown: float = 0.99
) -> list[dict[str, object]]:
    """Draws in even bins of |F(q)|, of the codes alone and of all that is sampled, goals included.

    The bins cover the share `shown` of all draws; a last one holds the others.
    """
    every = np.sqrt(np.concatenate([pooled_g(updates, "all", when) for when in WHEN]))
    top = float(np.quantile(every, shown))
    edges = np.append(np.linspace(0.0, top if top > 0.0 else 1.0, bins + 1), np.inf)
    rows: list[dict[str, object]] = []
    for what in ("codes", "all"):
        counts = [np.histogram(np.sqrt(pooled_g(updates, what, when)), edges)[0] for when in WHEN]
        rows += [
            {"of": what, "from": low, "to": high, "before": int(b), "after": int(a)}
            for (low, high), b, a in zip(pairwise(map(float, edges)), *counts, strict=True)
        ]
    return rows
