"""Constraint functions of a user, as `--constraint own_constraints:circle` names them."""

from cvqmpt_lab.constraints.function import FunctionConstraint


def on_circle(q):
    """Return |(q_0, q_2) - centre|^2 - radius^2 of q (n,) or (b, n)."""
    return q[..., 0:1] ** 2 + (q[..., 2:3] - 0.5) ** 2 - 0.25


circle = FunctionConstraint(1, on_circle, name="circle", units="rad^2")


def bounded_circle(bound=20.0):
    """Return the same with a Lipschitz constant."""
    return FunctionConstraint(1, on_circle, bound=bound, name="circle", units="rad^2")
