"""The interface of a constraint F(q) = 0 on configurations q of a robot (paper, section III)."""

from typing import Protocol

import numpy as np

from cvqmpt_lab.constraints.regions import Regions


class Constraint(Protocol):
    """A constraint F(q) = 0."""

    def residual(self, q: np.ndarray) -> np.ndarray:
        """F(q) (m,) of q (n,), or (b, m) of (b, n) [m, rad]."""

    def residual_and_jacobian(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F(q) (m,) and J(q) = dF/dq (m, n) of q (n,), or (b, m) and (b, m, n) of (b, n)."""

    def inner_regions(self, inset: float = 0.0) -> Regions:
        """Compiled regions, bounds moved inwards by `inset` [m, rad]."""
