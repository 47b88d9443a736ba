"""Move predicted codes so that samples of their Gaussians lie nearer to the constraint (paper, algorithm 2).

Minimised is G(z) = E[F(q)^T F(q)], q ~ N(mu(z), Sigma(z)) in radians, by reparameterised Monte Carlo:
q = q_min + range (mu(z) + L(z) eps) with the same eps in every step, so that
dG/dz = E[2 F^T J_F range d(mu + L eps)/dz], through mean and covariance. The published code drops the
mean's part and the factor range and takes F at normalised joints; the paper prints no factor for F.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from cvqmpt_lab.constraints.constraint import Constraint
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.vqmpt.codebook import Codebook, CodeDecoder, CodeGaussians

Method = Literal["adam", "gradient", "slsqp"]
_MEAN_DECAY, _SQUARE_DECAY, _TINY = 0.9, 0.999, 1e-12
_SLSQP_ITERATIONS = 100


@dataclass(frozen=True, kw_only=True)
class LatentSettings:
    """How codes are moved."""

    method: Method = "adam"
    """``adam``; ``gradient``, plain descent as the paper prints it; ``slsqp``, the published code's solver on one
    code after the other, unconstrained, its result scaled to unit length."""
    eta: float = 0.05
    """Step size; of ``adam`` roughly how far each entry of z moves in a step."""
    steps: int = 5
    """At most; ``slsqp`` has its own 100."""
    samples: int = 16
    """Draws per code that G and its gradient are estimated with."""
    delta: float = 1e-3
    """A code stops after a step shorter than this."""
    trust: float = 0.0
    """Weight of |z - z0|^2, added to G, which keeps codes near where they were predicted."""
    check_samples: int = 32
    """Fresh draws per code on which a moved code must be better, or it is moved back."""

    def __post_init__(self) -> None:
        if self.method not in get_args(Method):
            raise UnknownChoiceError("method of the latent optimizer", self.method, get_args(Method))
        for name in ("steps", "samples", "check_samples"):
            if getattr(self, name) < 1:
                raise InvalidInputError(
                    f"{name} of the latent optimizer is {getattr(self, name)}; give 1 or more"
                )
        for name, least in (("eta", "more than 0"), ("delta", "0 or more"), ("trust", "0 or more")):
            value = getattr(self, name)
            if not (np.isfinite(value) and (value > 0.0 or (value == 0.0 and name != "eta"))):
                raise InvalidInputError(f"{name} of the latent optimizer is {value}; give {least}")


@dataclass(frozen=True, eq=False)
class Optimized:
    """Codes after optimization."""

    z: np.ndarray
    """(c, code_dim), unit length."""
    g_before: np.ndarray
    """(c,), G estimated on fresh draws [the constraint's units, squared]."""
    g_after: np.ndarray
    """(c,), G on the same draws afterwards."""
    kept: np.ndarray
    """(c,) bool, codes left where they were because moving did not lower G."""
    steps: np.ndarray
    """(c,) int64, steps taken; of ``slsqp`` its iterations."""
    seconds: float
    """Wall-clock time of everything."""


class LatentOptimizer:
    """Algorithm 2 for codes of a dictionary, all of them in one batch."""

    def __init__(self, codebook: Codebook, settings: LatentSettings | None = None) -> None:
        self.settings = LatentSettings() if settings is None else settings
        of = codebook.configurations
        self._objective = LatentObjective(codebook.decoder, of.lower, of.range)

    def optimize(self, z0: np.ndarray, constraint: Constraint, rng: np.random.Generator) -> Optimized:
        """Move codes z0 (c, code_dim) towards a constraint."""
        began = time.perf_counter()
        settings, n = self.settings, len(self._objective.range)
        noise = rng.standard_normal((settings.samples, n))
        fresh = rng.standard_normal((settings.check_samples, n))
        problem = _Problem(self._objective, constraint, z0, noise, settings.trust)
        z, steps = _METHODS[settings.method](problem, settings)
        before = self._objective.value(z0, constraint, fresh)
        after = before.copy()
        moved = np.flatnonzero((z != z0).any(axis=1))
        if len(moved):
            after[moved] = self._objective.value(z[moved], constraint, fresh)
        kept = ~(after < before)
        return Optimized(
            z=np.where(kept[:, None], z0, z),
            g_before=before,
            g_after=np.where(kept, before, after),
            kept=kept,
            steps=steps,
            seconds=time.perf_counter() - began,
        )


@dataclass(frozen=True, eq=False)
class LatentObjective:
    """G and its gradient for codes of a decoder; lower, range: (n,) of the joints [rad or m]."""

    decoder: CodeDecoder
    lower: np.ndarray
    range: np.ndarray

    def value(self, z: np.ndarray, constraint: Constraint, noise: np.ndarray) -> np.ndarray:
        """G (c,) of codes (c, code_dim), with draws from standard normal noise (s, n)."""
        q = self._samples(self.decoder.decode(z), noise)
        return _mean_square(constraint.residual_and_jacobian(q)[0], (len(z), len(noise)))

    def value_and_gradient(
        self, z: np.ndarray, constraint: Constraint, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """G (c,) and dG/dz (c, code_dim)."""
        c, (s, n) = len(z), noise.shape
        gaussians = self.decoder.decode(z)
        residual, jacobian = constraint.residual_and_jacobian(self._samples(gaussians, noise))
        by_q = np.einsum("bm,bmn->bn", residual, jacobian).reshape(c, s, n)
        by_u = np.ascontiguousarray(by_q.swapaxes(1, 2)) * (2.0 / s * self.range[:, None])
        by_scale = (by_u.reshape(c * n, s) @ noise).reshape(c, n, n)
        gradient = gaussians.pull_back(by_u.sum(axis=2), by_scale)
        return _mean_square(residual, (c, s)), gradient.astype(np.float64)

    def _samples(self, gaussians: CodeGaussians, noise: np.ndarray) -> np.ndarray:
        """Configurations (c s, n) [rad or m]."""
        c, n = gaussians.mean.shape
        drawn = gaussians.scale.reshape(c * n, n) @ noise.T.astype(gaussians.scale.dtype)
        u = drawn.reshape(c, n, len(noise)).swapaxes(1, 2) + gaussians.mean[:, None]
        return (self.lower + u * self.range).reshape(-1, n)


def _mean_square(residual: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Mean (c,) of |F|^2 over s draws, residuals (c s, m), shape (c, s)."""
    return np.einsum("bm,bm->b", residual, residual).reshape(shape).mean(axis=1)


@dataclass(frozen=True, eq=False)
class _Problem:
    """What a method minimises from z0 (c, code_dim): G of every code, plus trust."""

    objective: LatentObjective
    constraint: Constraint
    z0: np.ndarray
    noise: np.ndarray
    trust: float

    def value_and_gradient(self, z: np.ndarray, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (a,) and gradients (a, code_dim) at z (a, code_dim) of some codes (a,)."""
        value, gradient = self.objective.value_and_gradient(z, self.constraint, self.noise)
        away = z - self.z0[codes]
        return value + self.trust * np.square(away).sum(axis=1), gradient + 2.0 * self.trust * away


def _descend(problem: _Problem, settings: LatentSettings) -> tuple[np.ndarray, np.ndarray]:
    """Codes (c, code_dim) and steps (c,) by gradient steps, each back onto the unit sphere."""
    z = problem.z0.astype(np.float64)
    steps = np.zeros(len(z), dtype=np.int64)
    mean, square = np.zeros_like(z), np.zeros_like(z)
    moving = np.arange(len(z))
    for step in range(1, settings.steps + 1):
        if len(moving) == 0:
            break
        _, gradient = problem.value_and_gradient(z[moving], moving)
        change = settings.eta * gradient
        if settings.method == "adam":
            # Along z the sphere has no slope: left in, that part would only shorten the steps.
            gradient -= z[moving] * (gradient * z[moving]).sum(axis=1, keepdims=True)
            mean[moving] = _MEAN_DECAY * mean[moving] + (1.0 - _MEAN_DECAY) * gradient
            square[moving] = _SQUARE_DECAY * square[moving] + (1.0 - _SQUARE_DECAY) * gradient**2
            root = np.sqrt(square[moving] / (1.0 - _SQUARE_DECAY**step))
            change = settings.eta * mean[moving] / (1.0 - _MEAN_DECAY**step) / (root + _TINY)
        onto = _on_sphere(z[moving] - change, z[moving])
        far = np.linalg.norm(onto - z[moving], axis=1) >= settings.delta
        z[moving] = onto
        steps[moving] = step
        moving = moving[far & (np.abs(gradient).max(axis=1) > 0.0)]
    z = z.astype(problem.z0.dtype)
    still = (np.abs(z - problem.z0) <= 1e-6).all(axis=1)  # unit length anew is no move
    return np.where(still[:, None], problem.z0, z), steps


def _slsqp(problem: _Problem, settings: LatentSettings) -> tuple[np.ndarray, np.ndarray]:
    """The same by scipy's SLSQP; a code whose solve fails stays."""
    from scipy.optimize import minimize  # half a second to import, for a method that is seldom chosen

    z = problem.z0.copy()
    steps = np.zeros(len(z), dtype=np.int64)
    for code in range(len(z)):
        chosen = np.array([code])

        def function(vector: np.ndarray, chosen: np.ndarray = chosen) -> tuple[float, np.ndarray]:
            value, gradient = problem.value_and_gradient(vector[None], chosen)
            return float(value[0]), gradient[0]

        start = problem.z0[code].astype(np.float64)
        result = minimize(function, start, jac=True, method="SLSQP", options={"maxiter": _SLSQP_ITERATIONS})
        steps[code] = result.nit
        if result.success and result.nit > 0 and not np.array_equal(result.x, start):
            z[code] = _on_sphere(result.x[None], start[None])[0]
    return z, steps


_METHODS: dict[str, Callable[[_Problem, LatentSettings], tuple[np.ndarray, np.ndarray]]] = {
    "adam": _descend,
    "gradient": _descend,
    "slsqp": _slsqp,
}


def _on_sphere(z: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Rows z (c, d) at unit length; `otherwise` for those without a direction."""
    length = np.linalg.norm(z, axis=1, keepdims=True)
    usable = np.isfinite(length) & (length > _TINY)
    return np.where(usable, z / np.where(usable, length, 1.0), otherwise)
