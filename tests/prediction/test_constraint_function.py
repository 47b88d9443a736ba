"""Constraints inside torch: values, analytic gradients, shapes and dtypes."""

import numpy as np
import pytest
import torch

from cvqmpt_lab.constraints.task_space_region import RegionConstraint, TaskSpaceRegion, upright
from cvqmpt_lab.prediction.constraint_function import residual, squared_residual

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])


def six_rows(panda):
    """A pose of the hand with every entry bounded, narrowly."""
    bounds = np.array([(-0.02, 0.03)] * 3 + [(-0.1, 0.05)] * 3)
    return TaskSpaceRegion(panda.pose(HOME), np.eye(4), bounds)


@pytest.fixture(scope="module", params=["upright", "six rows", "both"])
def constraint(request, panda):
    members = {"upright": (upright(),), "six rows": (six_rows(panda),), "both": (upright(), six_rows(panda))}
    return RegionConstraint(panda, members[request.param])


def configurations(panda, *shape, dtype=torch.float64):
    q = panda.random_configurations(np.random.default_rng(0), int(np.prod(shape))).reshape(*shape, 7)
    return torch.from_numpy(q).to(dtype)


@pytest.mark.parametrize("function", [residual, squared_residual])
@pytest.mark.parametrize("shape", [(), (5,), (2, 3)], ids=str)
def test_gradients_are_those_of_finite_differences(panda, constraint, function, shape):
    q = configurations(panda, *shape).requires_grad_()
    assert torch.autograd.gradcheck(lambda q: function(constraint, q), q, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3), (0,)], ids=str)
def test_values_are_the_constraint_s_for_every_batch_shape(panda, constraint, shape):
    q = configurations(panda, *shape)
    value, square = residual(constraint, q), squared_residual(constraint, q)
    assert value.shape == (*shape, constraint.dim) and square.shape == shape
    expected = constraint.residual(q.reshape(-1, 7).numpy()).reshape(value.shape)
    np.testing.assert_array_equal(value.numpy(), expected)
    np.testing.assert_allclose(square.numpy(), (expected**2).sum(-1), rtol=1e-14)


def test_single_precision_is_kept_and_close(panda, constraint):
    q = configurations(panda, 40, dtype=torch.float32).requires_grad_()
    exact = q.detach().double().requires_grad_()
    value, square = residual(constraint, q), squared_residual(constraint, q)
    assert value.dtype == square.dtype == torch.float32
    square.sum().backward()
    squared_residual(constraint, exact).sum().backward()
    assert q.grad.dtype == torch.float32
    torch.testing.assert_close(q.grad.double(), exact.grad, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(value.double(), residual(constraint, exact), rtol=1e-6, atol=1e-6)


def test_strided_input_is_read_in_order(panda, constraint):
    q = configurations(panda, 2, 3)
    turned = q.transpose(0, 1)
    assert not turned.is_contiguous()
    torch.testing.assert_close(residual(constraint, turned), residual(constraint, q).transpose(0, 1))
    back = turned.detach().requires_grad_()
    (gradient,) = torch.autograd.grad(squared_residual(constraint, back).sum(), back)
    same = q.detach().requires_grad_()
    (expected,) = torch.autograd.grad(squared_residual(constraint, same).sum(), same)
    torch.testing.assert_close(gradient, expected.transpose(0, 1))


def test_the_input_is_left_alone_and_the_minimum_has_no_slope(panda):
    region = RegionConstraint(panda, (six_rows(panda),))
    q = torch.from_numpy(HOME.copy()).requires_grad_()
    squared_residual(region, q).backward()
    np.testing.assert_array_equal(q.detach().numpy(), HOME)
    assert torch.equal(q.grad, torch.zeros(7, dtype=torch.float64))


def test_gradient_descent_reaches_the_manifold(panda):
    """What a latent optimiser does, without the latents."""
    manifold = RegionConstraint(panda, (upright(),))
    q = configurations(panda, 50).requires_grad_()
    before = squared_residual(manifold, q).detach()
    optimiser = torch.optim.Adam([q], lr=0.05)
    for _ in range(200):
        optimiser.zero_grad()
        squared_residual(manifold, q).sum().backward()
        optimiser.step()
    after = squared_residual(manifold, q).detach()
    assert before.median() > 1.0 and after.median() < 1e-4
