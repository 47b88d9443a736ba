"""Constraints of numbers x(q) within bounds, which compiled code and numpy compute separately."""

from abc import abstractmethod
from functools import cached_property

import numpy as np

from cvqmpt_lab.constraints.constraint import Constraint
from cvqmpt_lab.constraints.regions import FunctionRows


class BoundedRows(Constraint):
    """lower <= x(q) <= upper for m numbers x; F is their signed distance outside.

    Compiled code calls `compiled`; the certificate takes `values`, which numpy computes.
    """

    @property
    @abstractmethod
    def compiled(self) -> FunctionRows:
        """The rows as machine code, with their bounds."""

    @abstractmethod
    def values(self, q: np.ndarray) -> np.ndarray:
        """Return x (b, m) of q (b, n)."""

    @abstractmethod
    def slopes(self, q: np.ndarray) -> np.ndarray:
        """Return dx/dq (b, m, n) of q (b, n)."""

    @cached_property
    def rows(self) -> FunctionRows:
        """The rows that compiled code calls."""
        return self.compiled

    @property
    def dim(self) -> int:
        """Number m of entries of F."""
        return len(self.rows.lower)

    def residual(self, q: np.ndarray) -> np.ndarray:
        """Return F(q), (m,) or (b, m)."""
        x = self.values(np.atleast_2d(q))
        F: np.ndarray = x - x.clip(self.rows.lower, self.rows.upper)
        return F if np.ndim(q) == 2 else F[0]

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return J(q), (m, n) or (b, m, n); rows inside their bounds are zero."""
        batch = np.atleast_2d(q)
        J: np.ndarray = np.where((self.residual(batch) != 0.0)[..., None], self.slopes(batch), 0.0)
        return J if np.ndim(q) == 2 else J[0]

    def reraise(self) -> None:
        """Do nothing: machine code raises no errors."""
