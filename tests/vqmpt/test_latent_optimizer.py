"""Algorithm 2 on small networks of random weights: values, gradients, and its promises."""

import copy
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from small_models import compact_config, random_checkpoint

from cvqmpt_lab.constraints.task_space_region import RegionConstraint, upright
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.vqmpt.checkpoint import stored
from cvqmpt_lab.vqmpt.codebook import Codebook, CodeDecoder
from cvqmpt_lab.vqmpt.latent_update import LatentObjective, LatentOptimizer, LatentSettings


@dataclass(frozen=True)
class Plane:
    """Joints on a plane in configuration space: a . q = b; nothing but what a `Constraint` needs."""

    normal: tuple = (0.5, 0.5, -0.5, 0.0, 0.0, 0.3, 0.4)
    offset: float = 0.2
    dim: int = 1

    def residual_and_jacobian(self, q, full=False):
        batch = np.atleast_2d(q)
        residual = (batch @ self.normal)[:, None] - self.offset
        jacobian = np.broadcast_to(self.normal, (len(batch), 1, 7)).copy()
        return (residual, jacobian) if np.ndim(q) == 2 else (residual[0], jacobian[0])

    def residual(self, q):
        return self.residual_and_jacobian(q)[0]

    def jacobian(self, q, full=False):
        return self.residual_and_jacobian(q)[1]


@pytest.fixture(scope="module", params=["upright", "plane"])
def constraint(request, panda):
    return RegionConstraint(panda, (upright(),)) if request.param == "upright" else Plane()


@pytest.fixture(scope="module")
def checkpoint(panda):
    checkpoint = random_checkpoint(panda, compact_config())
    with torch.no_grad():  # narrow Gaussians at places all over the joint ranges
        checkpoint.dictionary.decoder.diag[0].bias -= 3.0
        checkpoint.dictionary.decoder.l[0].weight *= 0.1
        checkpoint.dictionary.decoder.mu[0].weight *= 3.0
    return checkpoint


@pytest.fixture(scope="module")
def codebook(panda, checkpoint):
    return Codebook(stored(checkpoint), panda)


@pytest.fixture(scope="module")
def predicted(codebook):
    return codebook.vectors[:40]


def unit_codes(count, seed=0):
    z = np.random.default_rng(seed).standard_normal((count, 8))
    return z / np.linalg.norm(z, axis=1, keepdims=True)


def expected_g(dictionary, z, constraint, panda, noise):
    """G (c,) with Gaussians decoded by torch and the constraint's own residual."""
    gaussians = dictionary.decode(torch.from_numpy(z))
    mean, scale = gaussians.mean, gaussians.lower * gaussians.diagonal.sqrt()[..., None, :]
    u = mean[:, None] + torch.einsum("cij,sj->csi", scale, torch.from_numpy(noise))
    q = panda.lower + u.detach().numpy() * (panda.upper - panda.lower)
    return (constraint.residual(q.reshape(-1, 7)) ** 2).sum(1).reshape(q.shape[:2]).mean(1)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-9), (np.float32, 1e-5)])
def test_values_are_those_of_torch_and_precision_matters_little(
    panda, checkpoint, constraint, dtype, tolerance
):
    dictionary = copy.deepcopy(checkpoint.dictionary).double()
    z, noise = unit_codes(25), np.random.default_rng(1).standard_normal((10, 7))
    objective, exact = (
        LatentObjective(CodeDecoder(stored(checkpoint), kind), panda.lower, panda.upper - panda.lower)
        for kind in (dtype, np.float64)
    )
    value, gradient = objective.value_and_gradient(z, constraint, noise)
    expected = expected_g(dictionary, z, constraint, panda, noise)
    slope = exact.value_and_gradient(z, constraint, noise)[1]
    np.testing.assert_allclose(value, expected, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(gradient, slope, rtol=tolerance, atol=10 * tolerance * np.abs(slope).max())
    np.testing.assert_allclose(objective.value(z, constraint, noise), value, rtol=tolerance)


def test_gradients_are_those_of_finite_differences(panda, checkpoint, constraint):
    decoder = CodeDecoder(stored(checkpoint), np.float64)
    objective = LatentObjective(decoder, panda.lower, panda.upper - panda.lower)
    z, noise, h = unit_codes(12, 5), np.random.default_rng(1).standard_normal((8, 7)), 1e-6
    _, gradient = objective.value_and_gradient(z, constraint, noise)
    for entry in range(8):
        ahead, behind = z.copy(), z.copy()
        ahead[:, entry] += h
        behind[:, entry] -= h
        slope = (objective.value(ahead, constraint, noise) - objective.value(behind, constraint, noise)) / (
            2 * h
        )
        np.testing.assert_allclose(gradient[:, entry], slope, rtol=1e-4, atol=1e-5 * np.abs(gradient).max())
    assert np.abs(gradient).max() > 0.1


def g_of(codebook, z, constraint, draws=2000):
    """G (c,) from draws that the optimizer never saw, through the Gaussians that planners sample."""
    rng, values = np.random.default_rng(77), []
    for mean, covariance in zip(*codebook.gaussians(z), strict=True):
        q = mean + rng.standard_normal((draws, 7)) @ np.linalg.cholesky(covariance).T
        values.append(np.square(constraint.residual_and_jacobian(q)[0]).sum(1).mean())
    return np.array(values)


@pytest.mark.parametrize("method", ["adam", "gradient", "slsqp"])
def test_codes_move_towards_the_manifold_and_never_get_worse(codebook, predicted, constraint, method):
    few = predicted if method != "slsqp" else predicted[:30]
    eta = 0.05 if method == "adam" else 0.02
    settings = LatentSettings(method=method, steps=8, eta=eta, check_samples=64)
    result = LatentOptimizer(codebook, settings).optimize(few, constraint, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(result.z, axis=1), 1.0, rtol=1e-6)
    assert result.z.dtype == few.dtype and result.seconds > 0.0
    assert (result.g_after <= result.g_before).all() and (
        result.g_after[~result.kept] < result.g_before[~result.kept]
    ).all()
    np.testing.assert_array_equal(result.z[result.kept], few[result.kept])
    assert (result.z[~result.kept] != few[~result.kept]).any(1).all()
    # slsqp leaves the sphere, and scaling back to it undoes part of what it gained
    most, share = (0.9, 0.97) if method == "slsqp" else (0.5, 0.9)
    assert result.kept.mean() < most and result.g_after.mean() < share * result.g_before.mean()
    before, after = (g_of(codebook, z, constraint) for z in (few, result.z))
    assert after.mean() < 1.03 * share * before.mean()


def test_the_same_seed_gives_the_same_codes(codebook, predicted, constraint):
    optimizer = LatentOptimizer(codebook)
    one, same, other = (
        optimizer.optimize(predicted, constraint, np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.z, same.z)
    np.testing.assert_array_equal(one.g_after, same.g_after)
    assert (one.z != other.z).any()


def test_one_code_moves_as_among_others(codebook, predicted, constraint):
    optimizer = LatentOptimizer(codebook)
    together = optimizer.optimize(predicted, constraint, np.random.default_rng(1))
    alone = optimizer.optimize(predicted[:1], constraint, np.random.default_rng(1))
    np.testing.assert_allclose(alone.z, together.z[:1], atol=2e-3)


def test_short_steps_stop_a_code(codebook, predicted, constraint):
    def steps(**changes):
        settings = LatentSettings(steps=6, **changes)
        return (
            LatentOptimizer(codebook, settings)
            .optimize(predicted, constraint, np.random.default_rng(0))
            .steps
        )

    assert (steps(delta=3.0) == 1).all()
    slow = steps(method="gradient", eta=2e-3, delta=5e-3)
    assert slow.min() == 1 and slow.max() == 6
    assert (steps(delta=0.0) == 6).all()


def test_codes_on_the_manifold_stay(codebook, predicted):
    everywhere = Plane(normal=(0.0,) * 7, offset=0.0)
    result = LatentOptimizer(codebook).optimize(predicted, everywhere, np.random.default_rng(0))
    assert result.kept.all() and (result.steps == 1).all() and (result.g_after == 0.0).all()
    np.testing.assert_array_equal(result.z, predicted)


def test_trust_keeps_codes_near(codebook, predicted, constraint):
    def moved(trust):
        settings = LatentSettings(steps=30, trust=trust)
        result = LatentOptimizer(codebook, settings).optimize(predicted, constraint, np.random.default_rng(0))
        return np.linalg.norm(result.z - predicted, axis=1)[~result.kept].mean()

    assert moved(30.0) < 0.6 * moved(0.0)


def test_no_codes_are_no_trouble(codebook, predicted, constraint):
    for method in ("adam", "gradient", "slsqp"):
        optimizer = LatentOptimizer(codebook, LatentSettings(method=method))
        result = optimizer.optimize(predicted[:0], constraint, np.random.default_rng(0))
        assert result.z.shape == (0, 8) and result.kept.shape == (0,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "newton"}, "unknown method of the latent optimizer 'newton'; valid choices: adam, gradient, slsqp"),
        ({"steps": 0}, "steps of the latent optimizer is 0"),
        ({"eta": 0.0}, "eta of the latent optimizer is 0.0; give more than 0"),
        ({"trust": -1.0}, "trust of the latent optimizer is -1.0; give 0 or more"),
        ({"delta": float("nan")}, "delta of the latent optimizer is nan"),
    ],
)  # fmt: skip
def test_settings_are_checked(changes, message):
    with pytest.raises((InvalidInputError, UnknownChoiceError), match=message):
        LatentSettings(**changes)
