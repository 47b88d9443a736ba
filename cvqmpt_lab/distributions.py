"""Distributions over configurations that planners sample from; always radians."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from cvqmpt_lab.errors import InvalidInputError


class SamplingDistribution(Protocol):
    """Anything that draws configurations."""

    @property
    def name(self) -> str:
        """What result rows call it."""

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n) [rad or m]."""


@dataclass(frozen=True, eq=False)
class Uniform:
    """Uniform between the joint limits."""

    lower: np.ndarray  # (n,) [rad or m]
    upper: np.ndarray  # (n,) [rad or m]
    name: str = "uniform"

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n)."""
        return rng.uniform(self.lower, self.upper, (count, len(self.lower)))


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """Weighted Gaussians, optionally mixed with a uniform share (paper, eqn. sample_dist)."""

    means: np.ndarray  # (k, n) [rad or m]
    covariances: np.ndarray  # (k, n, n) [rad^2]
    weights: np.ndarray  # (k,), summing to 1
    uniform: Uniform | None = None  # distribution mixed in
    uniform_share: float = 0.0  # its share in [0, 1]; at 0 a planner is not probabilistically complete
    name: str = "gaussian-mixture"

    @classmethod
    def equal(
        cls, means: np.ndarray, covariances: np.ndarray, uniform: Uniform, uniform_share: float, name: str
    ) -> "GaussianMixture | Uniform":
        """Equally likely Gaussians (k, n), (k, n, n) and a uniform share; uniform alone when k is 0.

        A single covariance (n, n) serves all means.
        """
        k = len(means)
        if k == 0:
            return replace(uniform, name=f"{name}: uniform")
        covariances = np.broadcast_to(covariances, (k, *np.shape(covariances)[-2:]))
        return cls(means, covariances, np.full(k, 1.0 / k), uniform, uniform_share, name)

    def __post_init__(self) -> None:
        k, n = self.means.shape
        if self.covariances.shape != (k, n, n) or self.weights.shape != (k,):
            raise InvalidInputError(
                f"mixture of {k} means in {n} joints: covariances {self.covariances.shape}, "
                f"weights {self.weights.shape}"
            )
        if not np.isclose(self.weights.sum(), 1.0) or (self.weights < 0).any():
            raise InvalidInputError(
                f"mixture weights must be non-negative and sum to 1, not {self.weights.sum()}"
            )
        if not np.isfinite(self.means).all():
            raise InvalidInputError("mixture means must be finite")
        if not np.isfinite(self.covariances).all() or (np.linalg.eigvalsh(self.covariances) <= 0).any():
            raise InvalidInputError("mixture covariances must be positive definite")
        if not 0.0 <= self.uniform_share <= 1.0 or (self.uniform_share > 0 and self.uniform is None):
            raise InvalidInputError(
                f"uniform share {self.uniform_share}: give 0 to 1, with a uniform distribution"
            )

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n); Gaussian draws may leave the limits, planners clip them."""
        component = rng.choice(len(self.weights), count, p=self.weights)
        noise = rng.standard_normal((count, self.means.shape[1]))
        factors = np.linalg.cholesky(self.covariances)
        draws = self.means[component] + np.einsum("kij,kj->ki", factors[component], noise)
        if self.uniform is not None and self.uniform_share > 0:
            elsewhere = rng.random(count) < self.uniform_share
            draws[elsewhere] = self.uniform.sample(rng, int(elsewhere.sum()))
        return draws
