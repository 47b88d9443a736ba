"""What every planner may ask of a constraint F(q) = 0."""

from typing import Protocol

import numpy as np

from cvqmpt_lab.kernels.manifold.regions import Regions


class Constraint(Protocol):
    """A constraint function on configurations, residual and Jacobian together.

    A state satisfies it when |residual(q)| <= tolerance.
    """

    @property
    def dim(self) -> int:
        """Number m of bounded rows of F."""

    def residual(self, q: np.ndarray) -> np.ndarray:
        """F(q), (m,) for one configuration (n,), (b, m) for a batch (b, n)."""

    def jacobian(self, q: np.ndarray, full: bool = False) -> np.ndarray:
        """dF/dq, (m, n) or (b, m, n); rows inside their bounds are zero unless full."""

    def residual_and_jacobian(self, q: np.ndarray, full: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Both at once, for the price of little more than one."""

    def project(self, q: np.ndarray) -> np.ndarray | None:
        """The configuration on the manifold that Newton's method reaches from q, or None."""

    def regions(self) -> Regions:
        """The same constraint as plain arrays for the compiled kernels."""
