"""The mixtures that `cvq-mpt` and `opt-cvq-mpt` sample: before and after the paper's Algorithm 2.

The stages of the planner are run: the transformer predicts codes from cloud, start and goals, the
decoder maps each code to a Gaussian, Algorithm 2 moves the codes. A mixture also has a Gaussian
around each goal, which Algorithm 2 does not move. Samples are not clipped to limits and not
projected; they use the same standard normal numbers before and after the update. All Gaussians of
a mixture are equally likely, so an equal number of samples of each represents the mixture.
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
    """Seed and number of samples of a measured update."""

    seed: int = 0
    samples: int = 500  # samples of each Gaussian, both before and after the update

    def __post_init__(self) -> None:
        whole_number("seed of the update", self.seed)
        whole_number("samples of the update", self.samples, 1)


@dataclass(frozen=True, eq=False)
class CodeUpdate:
    """Mixture of c codes and k goals before and after the update; F^T F in [rad^2 or m^2]."""

    problem: PlanningProblem  # with its goals
    cloud: np.ndarray  # input points of the model (m, 3) [m]
    codes: np.ndarray  # predicted codes (c,), as row indices of the dictionary
    before: GaussianMixture  # c Gaussians of codes, then k Gaussians of goals
    after: GaussianMixture  # the same Gaussians after the update
    noise: np.ndarray  # (s, n), standard normal numbers for s samples of each Gaussian

    def draws(self, when: str, component: int) -> np.ndarray:
        """Samples (s, n) [rad] of one Gaussian; when: "before" or "after"."""
        mixture: GaussianMixture = getattr(self, when)
        scale = np.linalg.cholesky(mixture.covariances[component])
        return mixture.means[component] + self.noise @ scale.T

    def g(self, when: str) -> np.ndarray:
        """F^T F at the samples of every Gaussian (c + k, s)."""
        every = range(len(self.before.means))
        return np.array(
            [squared_residual(self.problem.manifold, self.draws(when, i)) for i in every]
        )

    def rows(self) -> list[dict[str, object]]:
        """Table rows of Gaussians: F^T F at the mean; mean F^T F and fraction F = 0 of samples."""
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
    """Observe the scene, predict codes and update them.

    Args:
        problem: the problem; goals are sampled if it has only a goal region.
        model: name or folder of weights, see `vqmpt.weights.resolve_model`; None: shipped weights.
        settings: seed and number of samples.

    Raises:
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
    """F^T F (s,) of configurations q (s, n) [rad]; zero where the constraint holds."""
    return np.square(constraint.residual(q)).sum(axis=1)


def pooled_g(updates: Sequence[CodeUpdate], what: str, when: str) -> np.ndarray:
    """F^T F at samples of the Gaussians of all problems, as one array.

    Args:
        updates: updates of all problems.
        what: "codes": Gaussians of codes only; "all": Gaussians of goals, too.
        when: "before" or "after" the update.
    """
    every = [u.g(when)[: len(u.codes) if what == "codes" else None].ravel() for u in updates]
    return np.concatenate(every)


def exceedance_rows(
    updates: Sequence[CodeUpdate], deltas: Sequence[float] = (1e-4, 1e-3, 0.01, 0.1, 1.0)
) -> list[dict[str, object]]:
    """Table rows of P(G > delta) and its bound E[G] / delta (Markov's inequality, in the paper).

    G = F(q)^T F(q), at samples that are not clipped to limits and not projected.

    Args:
        updates: updates of all problems.
        deltas: values of delta, in squared units of the constraint [rad^2 or m^2].
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
    """Table rows of a histogram of |F(q)|, for Gaussians of codes only and for all Gaussians.

    Args:
        updates: updates of all problems.
        bins: number of bins of equal width.
        shown: fraction of all samples that these bins cover; one more bin counts the others.
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
