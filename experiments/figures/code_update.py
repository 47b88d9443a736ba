"""The Gaussians of the codes that `cvq-mpt` predicts for one problem, before and after the paper's Algorithm 2.

They are as the decoder gives them: planners widen them before they sample. The draws come from the same standard normal
numbers before and after, so that what differs is the update and not luck.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.constraints.constraint import Constraint
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.methods.loaded import codebook_of
from cvqmpt_lab.methods.sequences import STEPS
from cvqmpt_lab.methods.table import planner_named
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planning.code_proposals import CodeProposal
from cvqmpt_lab.planning.proposal import Observation
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.vqmpt.latent_update import LatentOptimizer, LatentSettings

PLANNER = "cvq-mpt"
ENOUGH = Budget(seconds=60.0)
FAR, NEAR = "far", "near"
RANKS: Mapping[str, float] = {FAR: 0.9, NEAR: 0.1}
"""Which codes stand for those far from and near the constraint: ranks among all predicted, in [0, 1]."""


@dataclass(frozen=True, kw_only=True)
class UpdateSettings:
    """How an update is measured."""

    seed: int = 0
    samples: int = 2000
    """Draws of each code's Gaussian, before and after."""

    def __post_init__(self) -> None:
        for name, least in (("seed", 0), ("samples", 1)):
            if getattr(self, name) < least:
                raise InvalidInputError(
                    f"{name} of the update is {getattr(self, name)}; give {least} or more"
                )


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Gaussians of codes."""

    means: np.ndarray
    """(c, n) [rad]."""
    scales: np.ndarray
    """(c, n, n) [rad], lower triangular: q = mean + scale @ noise."""

    def draws(self, code: int, noise: np.ndarray) -> np.ndarray:
        """Configurations (s, n) [rad] of one code from standard normal noise (s, n)."""
        return self.means[code] + noise @ self.scales[code].T


@dataclass(frozen=True, eq=False)
class CodeUpdate:
    """What a model says of some codes before and after the update."""

    problem: PlanningProblem
    """With its goals."""
    cloud: np.ndarray
    """What the model saw (m, 3) [m]."""
    codes: np.ndarray
    """(c,), predicted: rows of the dictionary."""
    before: Gaussians
    """Of these codes."""
    after: Gaussians
    noise: np.ndarray
    """(s, n), standard normal."""
    centre_before: np.ndarray
    """F^T F at the means (c,) [the constraint's units, squared]."""
    centre_after: np.ndarray
    """Likewise."""
    g_before: np.ndarray
    """F^T F at the draws that noise makes (c, s)."""
    g_after: np.ndarray
    """Likewise."""

    @property
    def kept(self) -> np.ndarray:
        """(c,) bool, codes that stayed where they were."""
        return (self.before.means == self.after.means).all(axis=1)

    def representatives(self) -> dict[str, int]:
        """A code far from the constraint and one near it, by their means' ranks (`RANKS`)."""
        order = np.argsort(self.centre_before, kind="stable")
        return {name: int(order[round(rank * (len(order) - 1))]) for name, rank in RANKS.items()}


def update_codes(problem: PlanningProblem, model: str | None, settings: UpdateSettings) -> CodeUpdate:
    """Look at the scene, predict, update, draw; model: as of `vqmpt.weights.resolve_model`.

    Raises
    ------
    InvalidInputError
        When there is no goal, or too few codes to compare two.
    """
    problem, _ = with_sampled_goals(problem)
    if len(problem.goals) == 0:
        raise InvalidInputError(f"problem {problem.name}: no goal was found; choose another")
    planned, drawn = map(np.random.default_rng, np.random.SeedSequence(settings.seed).spawn(2))
    method = planner_named(PLANNER, model)
    stages = method.stages(problem)
    assert stages.observe is not None and method.weights is not None
    cloud, query = stages.observe(problem), Query.of(ConstrainedSpace(problem), ENOUGH, planned)
    proposal = stages.predict(query, Observation(cloud))
    assert isinstance(proposal, CodeProposal)
    codes = proposal.codes
    if len(codes) < len(RANKS):
        raise InvalidInputError(
            f"problem {problem.name}: the model predicted {len(codes)} codes, {len(RANKS)} are compared; "
            "choose another problem or model"
        )
    codebook = codebook_of(method.weights, problem.robot)
    z = codebook.vectors[codes]
    moved = LatentOptimizer(codebook, LatentSettings(steps=STEPS)).optimize(z, problem.manifold, planned)
    before, after = (_gaussians(*codebook.gaussians(each)) for each in (z, moved.z))
    noise = drawn.standard_normal((settings.samples, problem.robot.dof))
    constraint = problem.manifold
    return CodeUpdate(
        problem=problem,
        cloud=cloud,
        codes=codes,
        before=before,
        after=after,
        noise=noise,
        centre_before=squared_residual(constraint, before.means),
        centre_after=squared_residual(constraint, after.means),
        g_before=_squared_residuals(constraint, before, noise),
        g_after=_squared_residuals(constraint, after, noise),
    )


def _gaussians(means: np.ndarray, covariances: np.ndarray) -> Gaussians:
    return Gaussians(means, np.linalg.cholesky(covariances))


def squared_residual(constraint: Constraint, q: np.ndarray) -> np.ndarray:
    """F^T F (s,) of configurations (s, n) [rad]; zero where the constraint holds."""
    return np.square(constraint.residual(q)).sum(axis=1)


def _squared_residuals(constraint: Constraint, gaussians: Gaussians, noise: np.ndarray) -> np.ndarray:
    """F^T F (c, s) at the draws of every code."""
    codes = range(len(gaussians.means))
    return np.array([squared_residual(constraint, gaussians.draws(code, noise)) for code in codes])
