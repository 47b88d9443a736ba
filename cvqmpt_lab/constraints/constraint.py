"""What the prediction may ask of a constraint F(q) = 0."""

from typing import Protocol

import numpy as np


class Constraint(Protocol):
    """A constraint function on configurations, residual and Jacobian together.

    A state satisfies it when |residual(q)| <= tolerance.
    """

    def residual(self, q: np.ndarray) -> np.ndarray:
        """F(q), (m,) for one configuration (n,), (b, m) for a batch (b, n)."""

    def residual_and_jacobian(self, q: np.ndarray, full: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """F(q) and dF/dq, (m, n) or (b, m, n); rows inside their bounds are zero unless full."""
