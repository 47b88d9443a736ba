"""Constraints inside torch: compiled kinematics, residual and analytic Jacobian behind one autograd function."""

from typing import Any

import numpy as np
import torch

from cvqmpt_lab.constraints.constraint import Constraint


class _Residual(torch.autograd.Function):
    """F(q) forward, gradient times J backward."""

    @staticmethod
    def forward(ctx: Any, q: torch.Tensor, constraint: Constraint) -> torch.Tensor:
        flat = np.ascontiguousarray(q.detach().cpu().numpy().reshape(-1, q.shape[-1]), dtype=np.float64)
        residual, jacobian = constraint.residual_and_jacobian(flat)
        shape = q.shape[:-1]
        ctx.jacobian = torch.from_numpy(jacobian).to(q).reshape(*shape, *jacobian.shape[1:])
        return torch.from_numpy(residual).to(q).reshape(*shape, residual.shape[1])

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        return torch.einsum("...m,...mn->...n", gradient, ctx.jacobian), None


def residual(constraint: Constraint, q: torch.Tensor) -> torch.Tensor:
    """F(q) (..., m) of configurations q (..., n) [rad or m], differentiable in q.

    One compiled call for the whole batch; only the Protocol's `residual_and_jacobian` is asked.
    """
    return _Residual.apply(q, constraint)


def squared_residual(constraint: Constraint, q: torch.Tensor) -> torch.Tensor:
    """F(q)^T F(q) (...,) of configurations q (..., n), the integrand of G in the paper's Algorithm 2."""
    return residual(constraint, q).square().sum(-1)
