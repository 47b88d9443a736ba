"""What planners would cost if a state check cost something else: where does learning pay?"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import Interval
from paper_tables.cells import number
from paper_tables.comparison import PROJECTION_COST, REFERENCE, Value, network_time, paired_ratio

COSTS = tuple(float(cost) for cost in 3.5 * 10.0 ** np.linspace(-7.0, -2.0, 11))
"""Of a state check [s], 0.35 µs to 35 ms; the paper's 3.5 ms is one of them."""
NEVER = "nowhere here"


def price(cost: float) -> Value:
    """Search at `cost` [s] a state check, networks as measured [s]; a projection costs as much, at most the paper's."""

    def priced(row: ResultRow) -> float | None:
        if row.n_projections is None or row.n_state_checks is None:
            return None
        searched = row.n_projections * min(cost, PROJECTION_COST) + row.n_state_checks * cost
        return searched + network_time(row)

    return priced


@dataclass(frozen=True)
class Repriced:
    """A planner against `comparison.REFERENCE` at every one of COSTS."""

    planner: str
    ratios: tuple[Interval, ...]

    @property
    def pays(self) -> str:
        """At which costs the whole interval is below 1."""
        cheaper = [
            cost for cost, ratio in zip(COSTS, self.ratios, strict=True) if (ratio.high or np.inf) < 1.0
        ]
        return f"{duration(cheaper[0])} to {duration(cheaper[-1])}" if cheaper else NEVER


def repriced(groups: Mapping[str, Sequence[ResultRow]]) -> tuple[Repriced, ...]:
    """Every planner that tells its work; nothing without the reference."""
    reference = groups.get(REFERENCE)
    if not reference:
        return ()
    found = (
        Repriced(name, tuple(paired_ratio(rows, reference, price(cost)) for cost in COSTS))
        for name, rows in groups.items()
        if name != REFERENCE
    )
    return tuple(item for item in found if item.ratios[0].estimate is not None)


def duration(seconds: float) -> str:
    """With a unit that fits."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{number(seconds / size)} {unit}".replace(".00 ", " ")
    return f"{number(seconds * 1e9)} ns"
