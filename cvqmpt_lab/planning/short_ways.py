"""Where a path shorter than one that is known can be.

Of length c, it can only pass through configurations x with |x - start| + |x - goal| < c, a prolate hyperspheroid
(Gammell, Srinivasa and Barfoot 2014).
"""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.distributions import SamplingDistribution

CROWD = 4  # samples drawn for one that is used
LEAST = 1e-9  # [rad or m] between start and goal, so that there is a direction


@dataclass(frozen=True, eq=False)
class Spheroid:
    """Uniform over configurations on motions no longer than `length` from start to goal, clipped to the limits."""

    start: np.ndarray
    goal: np.ndarray
    length: float
    lower: np.ndarray
    upper: np.ndarray
    name: str = "spheroid"

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n)."""
        n, along = len(self.start), self.goal - self.start
        straight = float(np.linalg.norm(along))
        ball = rng.normal(size=(count, n))
        ball *= (rng.random((count, 1)) ** (1.0 / n)) / np.linalg.norm(ball, axis=1, keepdims=True)
        across = 0.5 * np.sqrt(max(self.length**2 - straight**2, 0.0))
        axis = along / max(straight, LEAST)
        stretched = across * ball + np.outer((0.5 * self.length - across) * (ball @ axis), axis)
        return np.clip(0.5 * (self.start + self.goal) + stretched, self.lower, self.upper)


@dataclass(frozen=True, eq=False)
class Detours:
    """Samples of another distribution that may lie on a way shorter than `length` come first."""

    base: SamplingDistribution
    start: np.ndarray
    """(n,) [rad or m]."""
    goals: np.ndarray
    """(k, n) [rad or m]."""
    length: float
    """Of the best path known [rad]."""

    @property
    def name(self) -> str:
        """That of the distribution."""
        return self.base.name

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n)."""
        drawn = self.base.sample(rng, CROWD * count)
        to_goal = np.linalg.norm(drawn[:, None] - self.goals, axis=2).min(axis=1)
        too_long = np.linalg.norm(drawn - self.start, axis=1) + to_goal > self.length
        return drawn[np.argsort(too_long, kind="stable")[:count]]


@dataclass(frozen=True, eq=False)
class ShortWays:
    """Uniform in spheroids around straight lines, each as likely as the others."""

    spheroids: tuple[Spheroid, ...]
    name: str = "short-ways"

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n)."""
        counts = np.bincount(rng.integers(len(self.spheroids), size=count), minlength=len(self.spheroids))
        parts = [one.sample(rng, k) for one, k in zip(self.spheroids, counts.tolist(), strict=True)]
        return rng.permutation(np.concatenate(parts))
