"""What planners would need if a state check cost something else: where does learning pay?"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import Interval
from paper_tables.measures import PROJECTION_COST, REFERENCE, Value, paired_ratio, search_cost
from paper_tables.writers import number

COSTS = tuple(float(cost) for cost in 3.5 * 10.0 ** np.linspace(-7.0, -2.0, 11))
"""Of a state check [s], 0.35 µs to 35 ms; the paper's 3.5 ms is one of them."""
NEVER = "nowhere here"


def time_at(cost: float) -> Value:
    """Time [s] where a state check costs `cost` [s]; a projection costs as much, at most the paper's."""
    return lambda row: search_cost(row, min(cost, PROJECTION_COST), cost)


@dataclass(frozen=True)
class CostRatios:
    """A planner against `measures.REFERENCE` at every one of COSTS."""

    planner: str
    ratios: tuple[Interval, ...]

    @property
    def pays(self) -> str:
        """At which costs the whole interval is below 1."""
        below = [cost for cost, ratio in zip(COSTS, self.ratios, strict=True) if (ratio.high or np.inf) < 1.0]
        return f"{duration(below[0])} to {duration(below[-1])}" if below else NEVER


def against_reference(groups: Mapping[str, Sequence[ResultRow]]) -> list[CostRatios]:
    """Every planner whose rows say its work; nothing without the reference."""
    reference = groups.get(REFERENCE, ())
    found = (
        CostRatios(name, tuple(paired_ratio(rows, reference, time_at(cost)) for cost in COSTS))
        for name, rows in groups.items()
        if name != REFERENCE
    )
    return [item for item in found if item.ratios[0].estimate is not None]


def duration(seconds: float) -> str:
    """With a unit that fits."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{number(seconds / size)} {unit}".replace(".00 ", " ")
    return f"{number(seconds * 1e9)} ns"
