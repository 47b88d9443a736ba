"""The interface of a constraint F(q) = 0 on configurations q of a robot (paper, section III).

A new constraint is one file with one class: `dim`, `residual`, `jacobian` and `describe`. It can be
projected onto (Algorithm 1, here in numpy), searched on (Algorithm 3, see `search.space`) and codes
can be moved towards it (Algorithm 2). With `bound_between` it can be proven between states.
`RegionConstraint` is the constraint of task-space regions, in compiled code.
"""

from abc import ABC, abstractmethod

import numpy as np

from cvqmpt_lab.constraints.project import (
    LONGEST_STEP,
    PROJECTION_STEPS,
    PROJECTION_TOLERANCE,
)
from cvqmpt_lab.constraints.regions import Regions, no_regions


class Constraint(ABC):
    """A constraint F(q) = 0, F: (n,) -> (m,)."""

    @property
    @abstractmethod
    def dim(self) -> int:
        """Number m of entries of F."""

    @abstractmethod
    def residual(self, q: np.ndarray) -> np.ndarray:
        """Return F(q): (m,) of q (n,), or (b, m) of q (b, n) [m, rad]."""

    @abstractmethod
    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return J(q) = dF/dq: (m, n) of q (n,), or (b, m, n) of q (b, n)."""

    @abstractmethod
    def describe(self) -> str:
        """Return the constraint in words, such as "rotation about y -0.1 to 0.1 rad"."""

    def bound_between(self, states: np.ndarray) -> np.ndarray | None:
        """Return how far F can stray on straight motions between neighbours of states (k, n).

        An array (k - 1,): the largest entry of |F| on motion i exceeds its larger value at both
        ends by at most entry i [m, rad]. None: no bound is known.
        """
        return None

    def inner_regions(self, inset: float = 0.0) -> Regions:
        """Return the compiled regions of the constraint; none where it is Python code.

        inset: bounds are moved inwards by this much [m, rad].
        """
        return no_regions()

    def residual_and_jacobian(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `residual` and `jacobian` of q (n,) or (b, n)."""
        return self.residual(q), self.jacobian(q)


def project_in_numpy(
    constraint: Constraint, q: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray | None:
    """Project a configuration by Algorithm 1, q <- q - J^+ F(q).

    Args:
        constraint: F and J.
        q: (n,) [rad or m].
        lower: joint limits (n,) that hold in every step [rad or m].
        upper: joint limits (n,) [rad or m].

    Returns:
        The projected configuration, or None if |F| stays above the tolerance.
    """
    q = np.array(q, dtype=float)
    for _ in range(PROJECTION_STEPS):
        residual, jacobian = constraint.residual_and_jacobian(q)
        if np.linalg.norm(residual) <= PROJECTION_TOLERANCE:
            return q
        step = np.linalg.pinv(jacobian, rcond=1e-6) @ residual
        length = float(np.linalg.norm(step))
        if not np.isfinite(length):
            return None
        q = np.clip(q - step * min(1.0, LONGEST_STEP / max(length, 1e-12)), lower, upper)
    return q if np.linalg.norm(constraint.residual(q)) <= PROJECTION_TOLERANCE else None
