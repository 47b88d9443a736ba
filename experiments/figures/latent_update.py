"""One problem's predicted Gaussians before and after the latent update (paper, algorithm 2), and draws of both.

The update chooses its steps and judges them by draws of its own. Everything measured here comes from other
draws, the same standard normal ones before and after, so that what differs is the update and not luck.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from cvqmpt_lab.constraints.constraint import Constraint
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.stored import StoredModel
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.prediction.latent_optimizer import LatentOptimizer, LatentSettings, Optimized
from cvqmpt_lab.prediction.prediction import Prediction
from cvqmpt_lab.prediction.predictor import Predictor
from cvqmpt_lab.prediction.settings import PredictorSettings
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.cameras import CameraSettings, camera_cloud

FAR, NEAR = "far", "near"
RANKS: Mapping[str, float] = {FAR: 0.9, NEAR: 0.1}
"""Which codes stand for those far from and near the constraint: ranks among all predicted, in [0, 1]."""


@dataclass(frozen=True, kw_only=True)
class UpdateSettings:
    """What is predicted and how it is measured."""

    seed: int = 0
    samples: int = 2000
    """Draws of each code's Gaussian, before and after."""
    cameras: CameraSettings = field(default_factory=CameraSettings.like_training)
    predictor: PredictorSettings = field(default_factory=PredictorSettings)
    latent: LatentSettings = field(default_factory=LatentSettings)

    def __post_init__(self) -> None:
        for name, least in (("seed", 0), ("samples", 1)):
            if getattr(self, name) < least:
                raise InvalidInputError(
                    f"{name} of the latent update is {getattr(self, name)}; give {least} or more"
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
class LatentUpdate:
    """A prediction before and after the update."""

    problem: PlanningProblem
    """With its goals."""
    cloud: np.ndarray
    """What the model saw (m, 3) [m]."""
    prediction: Prediction
    optimized: Optimized
    before: Gaussians
    """Of the c predicted codes."""
    after: Gaussians
    noise: np.ndarray
    """(s, n), standard normal."""
    g_before: np.ndarray
    """F^T F at the draws that noise makes (c, s) [the constraint's units, squared]."""
    g_after: np.ndarray

    def representatives(self) -> dict[str, int]:
        """A code far from the constraint and one near it, by their ranks (`RANKS`).

        Ranked by the update's own estimate, not by the draws that are shown.
        """
        order = np.argsort(self.optimized.g_before, kind="stable")
        return {name: int(order[round(rank * (len(order) - 1))]) for name, rank in RANKS.items()}


def update_latents(problem: PlanningProblem, model: StoredModel, settings: UpdateSettings) -> LatentUpdate:
    """Look at the scene, predict, update, draw.

    Raises
    ------
    InvalidInputError
        When there is no goal, or too few codes to compare two.
    """
    problem, _ = with_sampled_goals(problem)
    if len(problem.goals) == 0:
        raise InvalidInputError(f"problem {problem.name}: no goal was found; choose another")
    seen, predicted, moved, drawn = map(np.random.default_rng, np.random.SeedSequence(settings.seed).spawn(4))
    cloud = camera_cloud(problem.scene, settings.cameras, seen)
    predictor = Predictor(model, problem.robot, settings.predictor)
    prediction = predictor.predict(cloud, problem.start, problem.goals, predicted)
    if len(prediction.codes) < len(RANKS):
        raise InvalidInputError(
            f"problem {problem.name}: the model predicted {len(prediction.codes)} codes, {len(RANKS)} are "
            "compared; choose another problem, seed or model"
        )
    constraint = problem.manifold
    optimized = LatentOptimizer(predictor, settings.latent).optimize(prediction, constraint, moved)
    noise = drawn.standard_normal((settings.samples, problem.robot.dof))
    before, after = (gaussians_of(predictor, prediction, z) for z in (prediction.z, optimized.z))
    return LatentUpdate(
        problem=problem,
        cloud=cloud,
        prediction=prediction,
        optimized=optimized,
        before=before,
        after=after,
        noise=noise,
        g_before=_squared_residuals(constraint, before, noise),
        g_after=_squared_residuals(constraint, after, noise),
    )


def gaussians_of(predictor: Predictor, prediction: Prediction, z: np.ndarray) -> Gaussians:
    """Gaussians in radians of a prediction's codes moved to z (c, code_dim)."""
    decoded = predictor.decoder.decode(z, prediction.refinement)
    configurations = predictor.configurations
    return Gaussians(
        configurations.radians(decoded.mean.astype(float)), configurations.range[:, None] * decoded.scale
    )


def squared_residual(constraint: Constraint, q: np.ndarray) -> np.ndarray:
    """F^T F (s,) of configurations (s, n) [rad]; zero where the constraint holds."""
    return np.square(constraint.residual(q)).sum(axis=1)


def _squared_residuals(constraint: Constraint, gaussians: Gaussians, noise: np.ndarray) -> np.ndarray:
    """F^T F (c, s) at the draws of every code."""
    codes = range(len(gaussians.means))
    return np.array([squared_residual(constraint, gaussians.draws(code, noise)) for code in codes])
