"""Algorithm 2 of the paper, UpdateDistribution(z): codes are moved towards the constraint.

For every code z separately, the expected constraint violation of its samples is minimised,

    L(z) = E[G(q)],    G(q) = F(q)^T F(q),    q = q_min + R (mu(z) + L D^(1/2)(z) eps),

with R = diag(q_max - q_min) and eps ~ N(0, I). The expectation is the mean over N draws eps_k that
are the same in all steps. With J = dF/dq, the steps are

    dL/dz = 1/N sum_k 2 F(q_k)^T J(q_k) R d(mu + L D^(1/2) eps_k)/dz,
    z <- z - eta dL/dz,    z <- z / |z|,

until a step is shorter than delta. (The published code omits R and the derivative of mu.)
"""

import time
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from cvqmpt_lab.base.codec import Checked
from cvqmpt_lab.base.values import Condition
from cvqmpt_lab.constraints.constraint import Constraint
from cvqmpt_lab.vqmpt.codebook import Codebook, CodeGaussians

Count = Annotated[int, Condition(int, {"minimum": 1}, "1 or more")]


@dataclass(frozen=True, kw_only=True, eq=False)
class LatentSettings(Checked):
    """Settings of Algorithm 2; the paper gives no eta, delta and N: they are tuned."""

    method: Literal["adam", "gradient"] = "adam"  # gradient: plain gradient descent, as printed
    # step size; with Adam roughly the distance that each entry of z moves in a step
    eta: Annotated[float, Condition(float, {"exclusiveMinimum": 0.0}, "more than 0")] = 0.05
    steps: Count = 5  # maximum number of steps
    samples: Count = 16  # N, draws per code
    # a code stops after a step shorter than this
    delta: Annotated[float, Condition(float, {"minimum": 0.0}, "0 or more")] = 1e-3
    check_samples: Count = 32  # fresh draws per code, on which G is compared after the update
    put_back: bool = True  # whether codes whose G did not decrease return to their first value


@dataclass(frozen=True, eq=False)
class Optimized:
    """Codes after the update."""

    z: np.ndarray  # (c, code_dim), unit length
    g_before: np.ndarray  # (c,), mean of G before the update, on fresh draws [units of F squared]
    g_after: np.ndarray  # (c,), the same after the update, on the same draws
    kept: np.ndarray  # (c,) bool, codes left unchanged because moving did not decrease G
    steps: np.ndarray  # (c,) int64, number of steps
    seconds: float  # wall-clock time of the update


class LatentOptimizer:
    """Algorithm 2 for codes of a dictionary, computed in one batch."""

    def __init__(self, codebook: Codebook, settings: LatentSettings | None = None) -> None:
        self.settings = LatentSettings() if settings is None else settings
        self._objective = LatentObjective(codebook)

    def optimize(
        self, z0: np.ndarray, constraint: Constraint, rng: np.random.Generator
    ) -> Optimized:
        """Compute UpdateDistribution(z).

        With `put_back`, codes whose G does not decrease on fresh draws stay unchanged.

        Args:
            z0: (c, code_dim), unit vectors.
            constraint: F(q) and J(q).
            rng: random numbers for eps.
        """
        began = time.perf_counter()
        n = len(self._objective.range)
        noise = rng.standard_normal((self.settings.samples, n))  # fixed draws: L(z) is smooth
        # G is compared on other draws, since codes may fit the noise of the first
        fresh = rng.standard_normal((self.settings.check_samples, n))
        z, steps = self._descend(z0, constraint, noise)
        before = self._objective.value(z0, constraint, fresh)
        after = before.copy()
        moved = np.flatnonzero((z != z0).any(axis=1))
        if len(moved):
            after[moved] = self._objective.value(z[moved], constraint, fresh)
        kept = ~(after < before) & self.settings.put_back
        z = np.where(kept[:, None], z0, z)
        after = np.where(kept, before, after)
        return Optimized(z, before, after, kept, steps, time.perf_counter() - began)

    def _descend(
        self, z0: np.ndarray, constraint: Constraint, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Iterate z <- z - eta dL/dz, z <- z / |z|; return codes (c, code_dim) and steps (c,)."""
        settings = self.settings
        z = z0.astype(np.float64)
        steps = np.zeros(len(z), dtype=np.int64)
        mean, square = np.zeros_like(z), np.zeros_like(z)  # Adam's means of gradient and square
        moving = np.arange(len(z))
        for step in range(1, settings.steps + 1):
            if len(moving) == 0:
                break
            _, gradient = self._objective.value_and_gradient(z[moving], constraint, noise)
            change = settings.eta * gradient
            if settings.method == "adam":
                # remove the component along z, which normalisation cancels: it would only shorten
                # the steps of Adam
                gradient -= z[moving] * (gradient * z[moving]).sum(axis=1, keepdims=True)
                a, b = 0.9, 0.999  # decay of Adam's means of gradient and square
                mean[moving] = a * mean[moving] + (1.0 - a) * gradient
                square[moving] = b * square[moving] + (1.0 - b) * gradient**2
                root = np.sqrt(square[moving] / (1.0 - b**step))
                change = settings.eta * mean[moving] / (1.0 - a**step) / (root + 1e-12)
            new = z[moving] - change
            length = np.linalg.norm(new, axis=1, keepdims=True)
            usable = np.isfinite(length) & (length > 1e-12)
            new = np.where(usable, new / np.where(usable, length, 1.0), z[moving])
            far = np.linalg.norm(new - z[moving], axis=1) >= settings.delta
            z[moving] = new
            steps[moving] = step
            moving = moving[far & (np.abs(gradient).max(axis=1) > 0.0)]
        z = z.astype(z0.dtype)
        unmoved = (np.abs(z - z0) <= 1e-6).all(axis=1)  # only rounding of the unit length
        return np.where(unmoved[:, None], z0, z), steps


class LatentObjective:
    """L(z) = E[G(q)] and its gradient for codes of a dictionary."""

    def __init__(self, codebook: Codebook) -> None:
        self.decoder = codebook.decoder
        self.lower = codebook.configurations.lower  # (n,) [rad or m]
        self.range = codebook.configurations.range  # (n,) [rad or m]

    def value(self, z: np.ndarray, constraint: Constraint, noise: np.ndarray) -> np.ndarray:
        """Compute L(z) (c,).

        Args:
            z: (c, code_dim).
            constraint: F(q).
            noise: (s, n), standard normal eps of s draws.
        """
        q = self._samples(self.decoder.decode(z), noise)
        return _mean_square(constraint.residual_and_jacobian(q)[0], (len(z), len(noise)))

    def value_and_gradient(
        self, z: np.ndarray, constraint: Constraint, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute L(z) (c,) and dL/dz (c, code_dim); arguments as of `value`."""
        c = len(z)
        s, n = noise.shape
        gaussians = self.decoder.decode(z)
        residual, jacobian = constraint.residual_and_jacobian(self._samples(gaussians, noise))
        by_q = np.einsum("bm,bmn->bn", residual, jacobian).reshape(c, s, n)
        by_u = np.ascontiguousarray(by_q.swapaxes(1, 2)) * (2.0 / s * self.range[:, None])
        by_scale = (by_u.reshape(c * n, s) @ noise).reshape(c, n, n)
        gradient = self.decoder.gradient(gaussians, by_u.sum(axis=2), by_scale)
        return _mean_square(residual, (c, s)), gradient.astype(np.float64)

    def _samples(self, gaussians: CodeGaussians, noise: np.ndarray) -> np.ndarray:
        """Draw q = q_min + R (mu + L D^(1/2) eps), (c s, n) [rad or m]."""
        c, n = gaussians.mean.shape
        drawn = gaussians.scale.reshape(c * n, n) @ noise.T.astype(gaussians.scale.dtype)
        u = drawn.reshape(c, n, len(noise)).swapaxes(1, 2) + gaussians.mean[:, None]
        return (self.lower + u * self.range).reshape(-1, n)


def _mean_square(residual: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Mean of |F|^2 over draws, (c,); residual (c s, m), shape (c, s)."""
    return np.einsum("bm,bm->b", residual, residual).reshape(shape).mean(axis=1)
