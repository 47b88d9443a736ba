"""The work of a search, and its price: numbers that do not depend on the machine.

The price turns counts into the paper's seconds: its state checks took 3.5 ms in a simulator, ours
take 1 us. Sources of prices: docs/judgement.md, "Prices of the published code".
"""

from collections.abc import Mapping
from dataclasses import dataclass

from cvqmpt_lab.base.errors import InvalidInputError

# cost of reading one clearance, in state checks; see docs/performance.md
CLEARANCE_COST = 1 / 3


# `cell_trees` compiles this function with cvqmpt_lab.base.jit: a change compiles all kernels anew
def search_work(projections: float, state_checks: float, clearances: float) -> float:
    """Return `projections + state checks + CLEARANCE_COST * clearances`."""
    return projections + state_checks + CLEARANCE_COST * clearances


@dataclass(frozen=True)
class Prices:
    """Price of each operation [s]."""

    state_check: float
    projection: float  # the constraint's value, once a projection
    newton_step: float  # value, Jacobian and least squares

    def __post_init__(self) -> None:
        for name, price in vars(self).items():
            if not 0.0 < price < float("inf"):
                raise InvalidInputError(
                    f"price {name} is {price}: give seconds above 0, or choose one of the price "
                    f"sets {', '.join(PRICES)}"
                )

    def cost(self, state_checks: float, projections: float, newton_steps: float) -> float:
        """Return the price of numbers of operations [s]."""
        checks = self.state_check * state_checks
        return checks + self.projection * projections + self.newton_step * newton_steps


# PyBullet checks states in both: all distances of a Panda in the kitchen, `bench paper-check`
PRICES: Mapping[str, Prices] = {
    # the constraint in Python on roboticstoolbox's kinematics, as the published code has it
    "published": Prices(3.5e-3, 1.3e-4, 5e-4),
    # the constraint on PyBullet's kinematics
    "pybullet": Prices(3.5e-3, 5.5e-5, 8e-5),
}
