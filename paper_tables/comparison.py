"""Planners against a baseline: paired ratios, work at another price, and problems split into easy and hard.

Pure functions of rows. A run's work is its projections and state checks, which do not depend on the machine.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np

from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import (
    Interval,
    ProblemKey,
    geometric_mean_interval,
    mean_of_solved,
    median_interval,
    problem_key,
    wilson_interval,
)

REFERENCE = "birrt"
"""Whose work says how hard a problem is, and what the split's ratios are taken against."""
HARD_SHARE = 1 / 3

Value = Callable[[ResultRow], float | None]
"""A number of a run, None where the row does not say."""
Seeds = Sequence[Sequence[float]]
"""Numbers of problems, one a seed: seeds of one problem are not independent, so a problem counts once."""
Statistic = Callable[[Seeds], Interval]


STATE_CHECK_COST = 3.5e-3
"""PyBullet asked for all distances of a Panda in this kitchen, 0.7 ms to itself and 2.8 ms to obstacles [s]."""
PROJECTION_COST = 2e-5
"""Newton's method in Python, on numpy and a compiled kinematics library [s]. The published code does more in Python,
so this is a lower bound and favours planners that project much."""


def paper_cost(row: ResultRow) -> float | None:
    """Search at what work costs in a setting like the paper's, and networks as measured [s]; nothing else."""
    if row.n_projections is None or row.n_state_checks is None:
        return None
    searched = row.n_projections * PROJECTION_COST + row.n_state_checks * STATE_CHECK_COST
    return searched + network_time(row)


def network_time(row: ResultRow) -> float:
    """What networks and the latent update took [s]."""
    return sum(t or 0.0 for t in (row.t_encode_s, row.t_predict_s, row.t_optimize_s))


def work(row: ResultRow) -> float | None:
    """Projections and state checks of the search."""
    if row.n_projections is None or row.n_state_checks is None:
        return None
    return float(row.n_projections + row.n_state_checks)


def own_time(row: ResultRow) -> float | None:
    """Total time without goal inverse kinematics, which is the same for all planners [s]."""
    return None if row.t_total_s is None else row.t_total_s - (row.t_goals_s or 0.0)


RATIOS: Mapping[str, tuple[str, Value]] = {
    "work_ratio": ("work", work),
    "time_ratio": ("time", lambda row: row.t_total_s),
    "own_time_ratio": ("time without goals", own_time),
    "length_ratio": ("path length", lambda row: row.path_length_rad),
}
"""What the split compares: metric name, its label, its value."""


def by_problem(rows: Iterable[ResultRow]) -> list[list[ResultRow]]:
    """Rows of equal problems together, in the order in which they come."""
    found: dict[str, list[ResultRow]] = {}
    for row in rows:
        found.setdefault(row.problem, []).append(row)
    return list(found.values())


def values_of(rows: Iterable[ResultRow], value: Value) -> list[list[float]]:
    """Values of the rows that say one; problems where none does are left out."""
    found = ([number for row in seeds if (number := value(row)) is not None] for seeds in by_problem(rows))
    return [numbers for numbers in found if numbers]


def censored(rows: Sequence[ResultRow], value: Value) -> list[list[float]]:
    """Values of solved runs and +inf for failures; nothing when no solved run has one."""
    solved = [row for row in rows if row.solved]
    if solved and not values_of(solved, value):
        return []
    return values_of(rows, lambda row: value(row) if row.solved else math.inf)


def fraction(rows: Iterable[ResultRow], counted: Callable[[ResultRow], bool]) -> Interval:
    """Share of the rows, of a problem with several seeds in part."""
    shares = [fmean(map(counted, seeds)) for seeds in by_problem(rows)]
    return wilson_interval(math.fsum(shares), len(shares))


def share(rows: Iterable[ResultRow], counted: Callable[[ResultRow], bool]) -> Interval:
    """The same in percent."""
    return fraction(rows, counted).scaled(100)


def typical(values: Seeds) -> Interval:
    """Median over problems, of each one's median over seeds."""
    return median_interval([median(seeds) for seeds in values])


def mean(values: Seeds) -> Interval:
    """Mean of finite values; each bootstrap starts from the same seed, so that metrics do not interact."""
    finite = ([number for number in seeds if math.isfinite(number)] for seeds in values)
    return mean_of_solved([fmean(seeds) for seeds in finite if seeds], np.random.default_rng(0))


def paired_ratio(
    rows: Iterable[ResultRow],
    baseline: Iterable[ResultRow],
    value: Value,
    counted: Callable[[ResultRow], bool] | None = None,
) -> Interval:
    """Geometric mean of value against the baseline's, over problems that both solved, with a bootstrap interval.

    Runs are paired by problem and seed. Seeds of one problem are not independent: their logarithms are averaged
    first. Values that are not positive have no ratio and are left out.

    Parameters
    ----------
    counted
        Which rows count; all when None.
    """
    reference = {problem_key(row): value(row) for row in baseline if row.solved}
    logs: dict[str, list[float]] = {}
    for row in rows:
        own, other = value(row) if row.solved else None, reference.get(problem_key(row))
        if own and other and min(own, other) > 0.0 and (counted is None or counted(row)):
            logs.setdefault(row.problem, []).append(math.log(own / other))
    ratios = [math.exp(math.fsum(values) / len(values)) for values in logs.values()]
    return geometric_mean_interval(ratios, np.random.default_rng(0))


@dataclass(frozen=True)
class Split:
    """Easy and hard runs, by problem and seed."""

    easy: frozenset[ProblemKey]
    hard: frozenset[ProblemKey]

    @property
    def parts(self) -> Mapping[str, frozenset[ProblemKey]]:
        """All runs, the easy ones, the hard ones."""
        return {"all": self.easy | self.hard, "easy": self.easy, "hard": self.hard}


def split_by_work(reference: Iterable[ResultRow]) -> Split:
    """Split the runs of one planner: hard are those whose problem is above two thirds of the others in median work.

    The median is over the planner's other seeds, so that a problem is not called hard because of the very run that
    others are compared with; with one seed it is that one. A failed run's work is infinite. At most a third are hard:
    ties are easy. Runs of problems whose rows do not say their work are left out.
    """
    rows = [row for row in reference if not row.solved or work(row) is not None]
    hard: set[ProblemKey] = set()
    for seed in {row.seed for row in rows}:
        problems = _hard_problems([row for row in rows if row.seed != seed] or rows)
        hard |= {problem_key(row) for row in rows if row.seed == seed and row.problem in problems}
    return Split(frozenset(map(problem_key, rows)) - hard, frozenset(hard))


def _hard_problems(rows: Iterable[ResultRow]) -> frozenset[str]:
    efforts: dict[str, list[float]] = {}
    for row in rows:
        effort = work(row) if row.solved else math.inf
        assert effort is not None
        efforts.setdefault(row.problem, []).append(effort)
    medians = {problem: median(values) for problem, values in efforts.items()}
    ordered = sorted(medians.values())
    last_easy = math.ceil((1.0 - HARD_SHARE) * len(ordered) - 1e-9) - 1
    return frozenset(problem for problem, effort in medians.items() if effort > ordered[last_easy])


def split_metric(ratio: str, part: str) -> str:
    """Name of the metric `ratio` on a part of the split."""
    return f"{ratio}_{part}_of_{REFERENCE}"
