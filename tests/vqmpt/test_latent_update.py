"""Algorithm 2 on small networks with random weights: values, gradients, guarantees."""

import copy
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from refusals import refused
from small_models import compact_config, random_checkpoint

from cvqmpt_lab.base.errors import CvqmptError
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.task_space_region import upright
from cvqmpt_lab.vqmpt.checkpoint import stored
from cvqmpt_lab.vqmpt.codebook import Codebook
from cvqmpt_lab.vqmpt.latent_update import LatentObjective, LatentOptimizer, LatentSettings


@dataclass(frozen=True)
class Plane:
    """Constraint a . q = b in configuration space, as a minimal class."""

    normal: tuple = (0.5, 0.5, -0.5, 0.0, 0.0, 0.3, 0.4)
    offset: float = 0.2
    dim: int = 1

    def residual_and_jacobian(self, q):
        residual = (q @ self.normal)[:, None] - self.offset
        return residual, np.broadcast_to(self.normal, (len(q), 1, 7)).copy()


@pytest.fixture(scope="module", params=["upright", "plane"])
def constraint(request, panda):
    return RegionConstraint(panda, (upright(),)) if request.param == "upright" else Plane()


@pytest.fixture(scope="module")
def checkpoint(panda):
    checkpoint = random_checkpoint(panda, compact_config())
    with torch.no_grad():  # narrow Gaussians at places all over the joint ranges
        decoder = checkpoint.modules["dictionary"].decoder
        decoder.diag[0].bias -= 3.0
        decoder.l[0].weight *= 0.1
        decoder.mu[0].weight *= 3.0
    return checkpoint


@pytest.fixture(scope="module")
def codebook(panda, checkpoint):
    return Codebook(stored(checkpoint), panda)


@pytest.fixture(scope="module")
def exact(panda, checkpoint):
    return LatentObjective(Codebook(stored(checkpoint), panda, np.float64))


@pytest.fixture(scope="module")
def predicted(codebook):
    return codebook.vectors[:40]


def unit_codes(count, seed=0):
    z = np.random.default_rng(seed).standard_normal((count, 8))
    return z / np.linalg.norm(z, axis=1, keepdims=True)


def optimized(codebook, z, constraint, seed=0, **settings):
    optimizer = LatentOptimizer(codebook, LatentSettings(**settings))
    return optimizer.optimize(z, constraint, np.random.default_rng(seed))


def test_values_are_those_of_torch(panda, checkpoint, codebook, exact, constraint):
    z, noise = unit_codes(25), np.random.default_rng(1).standard_normal((10, 7))
    gaussians = copy.deepcopy(checkpoint.modules["dictionary"]).double().decode(torch.from_numpy(z))
    scale = gaussians.lower * gaussians.diagonal.sqrt()[..., None, :]
    u = gaussians.mean[:, None] + torch.einsum("cij,sj->csi", scale, torch.from_numpy(noise))
    q = panda.lower + u.detach().numpy() * (panda.upper - panda.lower)
    residual = constraint.residual_and_jacobian(q.reshape(-1, 7))[0]
    expected = (residual**2).sum(1).reshape(q.shape[:2]).mean(1)
    slope = exact.value_and_gradient(z, constraint, noise)[1]
    for objective, tolerance in ((exact, 1e-9), (LatentObjective(codebook), 1e-5)):
        value, gradient = objective.value_and_gradient(z, constraint, noise)
        np.testing.assert_allclose(value, expected, rtol=tolerance, atol=tolerance)
        atol = 10 * tolerance * np.abs(slope).max()
        np.testing.assert_allclose(gradient, slope, rtol=tolerance, atol=atol)
        np.testing.assert_allclose(objective.value(z, constraint, noise), value, rtol=tolerance)


def test_gradients_are_those_of_finite_differences(exact, constraint):
    z, noise, h = unit_codes(12, 5), np.random.default_rng(1).standard_normal((8, 7)), 1e-6
    _, gradient = exact.value_and_gradient(z, constraint, noise)
    for entry, step in enumerate(h * np.eye(8)):
        ahead, behind = (exact.value(z + side * step, constraint, noise) for side in (1.0, -1.0))
        slope, atol = (ahead - behind) / (2 * h), 1e-5 * np.abs(gradient).max()
        np.testing.assert_allclose(gradient[:, entry], slope, rtol=1e-4, atol=atol)
    assert np.abs(gradient).max() > 0.1


def g_of(codebook, z, constraint, draws=2000):
    """Mean of G (c,) over fresh draws from the Gaussians that planners sample."""
    rng, values = np.random.default_rng(77), []
    for mean, covariance in zip(*codebook.gaussians(z), strict=True):
        q = mean + rng.standard_normal((draws, 7)) @ np.linalg.cholesky(covariance).T
        values.append(np.square(constraint.residual_and_jacobian(q)[0]).sum(1).mean())
    return np.array(values)


@pytest.mark.parametrize(("method", "eta"), [("adam", 0.05), ("gradient", 0.02)])
def test_codes_move_to_the_manifold(codebook, predicted, constraint, method, eta):
    settings = {"method": method, "eta": eta, "steps": 8, "check_samples": 64}
    result = optimized(codebook, predicted, constraint, **settings)
    kept, moved = result.kept, ~result.kept
    np.testing.assert_allclose(np.linalg.norm(result.z, axis=1), 1.0, rtol=1e-6)
    assert result.z.dtype == predicted.dtype and result.seconds > 0.0
    assert (result.g_after <= result.g_before).all()
    assert (result.g_after[moved] < result.g_before[moved]).all()
    np.testing.assert_array_equal(result.z[kept], predicted[kept])
    assert (result.z[moved] != predicted[moved]).any(1).all()
    assert kept.mean() < 0.5 and result.g_after.mean() < 0.9 * result.g_before.mean()
    before, after = (g_of(codebook, z, constraint) for z in (predicted, result.z))
    assert after.mean() < 0.93 * before.mean()


def test_codes_repeat_by_seed_and_do_not_depend_on_other_codes(codebook, predicted, constraint):
    one, same, other = (optimized(codebook, predicted, constraint, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.z, same.z)
    np.testing.assert_array_equal(one.g_after, same.g_after)
    assert (one.z != other.z).any()
    alone = optimized(codebook, predicted[:1], constraint, 1)
    np.testing.assert_allclose(alone.z, one.z[:1], atol=2e-3)


def test_without_put_back_codes_that_got_worse_stay_moved(codebook, predicted, constraint):
    settings = {"method": "gradient", "eta": 3.0, "steps": 1}
    printed = optimized(codebook, predicted, constraint, put_back=False, **settings)
    ours = optimized(codebook, predicted, constraint, **settings)
    worse = printed.g_after >= printed.g_before
    assert worse.any() and not printed.kept.any() and (ours.kept == worse).all()
    np.testing.assert_array_equal(ours.z[~worse], printed.z[~worse])


def test_short_steps_stop_a_code_and_those_on_the_manifold_stay(codebook, predicted, constraint):
    def steps(**settings):
        return optimized(codebook, predicted, constraint, steps=6, **settings).steps

    assert (steps(delta=3.0) == 1).all()
    slow = steps(method="gradient", eta=2e-3, delta=5e-3)
    assert slow.min() == 1 and slow.max() == 6
    assert (steps(delta=0.0) == 6).all()
    everywhere = Plane(normal=(0.0,) * 7, offset=0.0)
    result = optimized(codebook, predicted, everywhere)
    assert result.kept.all() and (result.steps == 1).all() and (result.g_after == 0.0).all()
    np.testing.assert_array_equal(result.z, predicted)
    none = optimized(codebook, predicted[:0], everywhere)
    assert none.z.shape == (0, 8) and none.kept.shape == (0,)


def test_settings_are_checked():
    for changes, message in (
        ({"method": "newton"}, "method 'newton'; valid choices: adam, gradient"),
        ({"steps": 0}, "LatentSettings.steps is 0; it must be 1 or more"),
        ({"eta": 0.0}, "eta is 0.0; it must be more than 0"),
        ({"delta": float("nan")}, "delta is nan; it must be a finite float"),
    ):
        refused(message, LatentSettings, error=CvqmptError, **changes)
