"""Quantities in tables: values of a row, statistics, ratios to a baseline, easy and hard problems.

Pure functions of rows. The work of a run is its projections, state checks and clearances, which
do not depend on the machine. Seeds of one problem are not independent: everywhere a problem counts
once.
"""

import math
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from statistics import fmean, median
from typing import Literal, NamedTuple, TypeVar

from cvqmpt_lab.benchmarks.results.row import ResultRow
from cvqmpt_lab.benchmarks.results.statistics import (
    UNDEFINED,
    Interval,
    ProblemKey,
    geometric_mean_interval,
    mean_of_solved,
    median_interval,
    problem_key,
    wilson_interval,
)
from cvqmpt_lab.search.work import CLEARANCE_COST, PRICES, search_work

PUBLISHED_PRICES = PRICES["published"]
REFERENCE = "birrt"  # baseline of ratios; its work is the measure of difficulty of a problem
WORK = f"projections, state checks and {CLEARANCE_COST:.2g} of the clearances"
HARD_SHARE = 1 / 3

Key = TypeVar("Key")
Item = TypeVar("Item")
Rows = Sequence[ResultRow]
Value = Callable[[ResultRow], float | None]  # value of a run; None if the row does not have it
solved = attrgetter("solved")


def work(row: ResultRow) -> float | None:
    """Work of the search, see `search_work`: clearances that were not counted add nothing."""
    if row.n_projections is None or row.n_state_checks is None:
        return None
    return search_work(row.n_projections, row.n_state_checks, row.n_clearances or 0)


def search_cost(row: ResultRow, prices: str = "published") -> float | None:
    """Return the price of a run's work [s]; prices: a key of `search.work.PRICES`."""
    if row.n_projections is None or row.n_state_checks is None:
        return None
    steps = row.n_newton_iterations or 0
    return PRICES[prices].cost(row.n_state_checks, row.n_projections, steps)


def network_time(row: ResultRow) -> float:
    """Return the time of encoding the scene, predicting and updating [s]."""
    return (row.t_encode_s or 0.0) + (row.t_predict_s or 0.0) + (row.t_optimize_s or 0.0)


def paper_cost(row: ResultRow) -> float | None:
    """Return `search_cost` and measured network time [s], without goals and shortcutting."""
    search = search_cost(row)
    return None if search is None else search + network_time(row)


def gpu_cost(row: ResultRow, prediction: float = 0.010) -> float | None:
    """Return `search_cost` and a GPU's time for each goal that a network predicted [s].

    prediction: time of one prediction, see docs/judgement.md.
    """
    search = search_cost(row)
    if search is None or not network_time(row):
        return search
    return search + prediction * (row.n_goals_tried or 1)


def stored_vertices(row: ResultRow) -> int | None:
    """Return the number of states that OMPL's PlannerData counts, see `ResultRow.n_roots`."""
    if row.n_extensions is None or row.n_roots is None:
        return None
    return row.n_extensions + row.n_roots


def time_at(row: ResultRow, check: float) -> float | None:
    """Return `own_time` if a state check costs `check` [s] more, and other work in proportion."""
    own, search = own_time(row), search_cost(row)
    return (
        None
        if own is None or search is None
        else own + check / PUBLISHED_PRICES.state_check * search
    )


def newton_steps(row: ResultRow) -> float | None:
    """Return Newton steps per projection (Algorithm 1); None where only steps are counted."""
    if row.sampler_used == "atlas-charts" or not row.n_projections:
        return None
    return None if row.n_newton_iterations is None else row.n_newton_iterations / row.n_projections


def draw_newton_steps(row: ResultRow) -> float | None:
    """Return Newton steps per projection of samples, before trees extend towards them."""
    if row.n_draw_projections is None or row.n_draw_newton_iterations is None:
        return None
    return row.n_draw_newton_iterations / row.n_draw_projections


def own_time(row: ResultRow) -> float | None:
    """Return the total time without goal inverse kinematics, equal for all planners [s]."""
    return None if row.t_total_s is None else row.t_total_s - (row.t_goals_s or 0.0)


def known_time(row: ResultRow) -> float | None:
    """Return the time in a known scene: `own_time` without encoding the scene [s]."""
    own = own_time(row)
    return None if own is None else own - (row.t_encode_s or 0.0)


def suite_measure(name: str, row: ResultRow) -> float | None:
    """Return a number that only one suite measures; None if the row has none."""
    return row.measures.get(name)


VALUES: Mapping[str, Value] = {  # values of a row by name; times in [s]
    "time": attrgetter("t_total_s"),
    "own_time": own_time,
    "known_time": known_time,
    # only for runs that computed everything from the scene's cloud
    "new_time": lambda row: own_time(row) if row.scene_new else None,
    "goals_time": attrgetter("t_goals_s"),
    "network_time": network_time,
    "search_time": attrgetter("t_plan_s"),
    "simplify_time": attrgetter("t_simplify_s"),
    "certificate_time": attrgetter("t_certify_s"),
    "sense_time": attrgetter("t_sense_s"),
    "whole_time": attrgetter("t_whole_s"),
    "wall_time": attrgetter("t_wall_s"),
    "planning_time": attrgetter("t_total_s"),
    "execution_time": attrgetter("execution_time_s"),
    "total_time": lambda row: (
        None if row.execution_time_s is None else (row.t_total_s or 0.0) + row.execution_time_s
    ),
    "work": work,
    "paper_cost": paper_cost,
    # the price of the search alone: the published code times no network
    "search_cost": search_cost,
    "gpu_cost": gpu_cost,
    "search_cost_pybullet": partial(search_cost, prices="pybullet"),
    "stored_vertices": stored_vertices,
    "ompl_length": attrgetter("path_length_ompl_rad"),
    "goals_tried": attrgetter("n_goals_tried"),
    "projections": attrgetter("n_projections"),
    "newton_iterations": attrgetter("n_newton_iterations"),
    "newton_steps": newton_steps,
    "draw_newton_steps": draw_newton_steps,
    "state_checks": attrgetter("n_state_checks"),
    "clearances": attrgetter("n_clearances"),
    "vertices": attrgetter("vertices"),
    "extensions": attrgetter("n_extensions"),
    "path_length": attrgetter("path_length_rad"),
    "raw_length": attrgetter("path_length_raw_rad"),
    "true_clearance": attrgetter("true_clearance_m"),
    "g_sampled": attrgetter("g_sampled"),
    # values of executions in simulation
    **{
        name: partial(suite_measure, name)
        for name in ("off_path_mm", "tilt_rad", "contacts", "saturated_ms", "drift_mm", "placed")
    },
}

RATIOS: Mapping[str, tuple[str, Value]] = {  # by name: what is compared, and its value
    "work_ratio": ("work", work),
    "time_ratio": ("time", VALUES["time"]),
    "own_time_ratio": ("time without goals", own_time),
    "length_ratio": ("path length", VALUES["path_length"]),
}


# ---------------------------------------------------------------- statistics over rows


def grouped(pairs: Iterable[tuple[Key, Item]]) -> dict[Key, list[Item]]:
    """Return items of (key, item) pairs by key, in order of first appearance."""
    found: dict[Key, list[Item]] = {}
    for key, item in pairs:
        found.setdefault(key, []).append(item)
    return found


def censored(rows: Rows, value: Value) -> list[list[float]]:
    """Return values by problem, with +inf for failures; [] if no solved run has a value."""
    numbers = [value(row) if row.solved else math.inf for row in rows]
    if set(numbers) - {math.inf} == {None}:
        return []
    known = [(row.problem, x) for row, x in zip(rows, numbers, strict=True) if x is not None]
    return [*grouped(known).values()]


def fraction(rows: Iterable[ResultRow], counted: Callable[[ResultRow], bool]) -> Interval:
    """Return the mean over problems of the share of counted rows [%], with Wilson's interval."""
    return problem_share([(row.problem, counted(row)) for row in rows])


def problem_share(flags: Iterable[tuple[str, bool]]) -> Interval:
    """Return the mean over problems of the share of true flags [%], with Wilson's interval.

    flags: problem, and whether one of its runs is counted.
    """
    shares = [sum(seeds) / len(seeds) for seeds in grouped(flags).values()]
    return wilson_interval(math.fsum(shares), len(shares)).mapped(lambda share: 100.0 * share)


def problem_median(values: Iterable[Sequence[float]]) -> Interval:
    """Return the median over problems of the median over seeds."""
    return median_interval([median(seeds) for seeds in values])


def problem_mean(values: Iterable[Sequence[float]]) -> Interval:
    """Return the mean of finite values; every bootstrap has the same random seed."""
    finite = ([number for number in seeds if math.isfinite(number)] for seeds in values)
    return mean_of_solved([fmean(seeds) for seeds in finite if seeds])


class Pair(NamedTuple):
    """Values of two planners on a problem, seed by seed."""

    problem: str
    values: Sequence[tuple[float, float]]

    @property
    def own(self) -> float:
        """Mean over seeds."""
        return fmean([own for own, _ in self.values])

    @property
    def other(self) -> float:
        """Mean of the other over seeds."""
        return fmean([other for _, other in self.values])

    @property
    def ratio(self) -> float:
        """Geometric mean of the ratios: `exp(mean(log(own / other)))`."""
        logs = [math.log(own / other) for own, other in self.values]
        return math.exp(math.fsum(logs) / len(logs))


def paired(
    rows: Iterable[ResultRow],
    baseline: Iterable[ResultRow],
    value: Value,
    key: Callable[[ResultRow], Hashable] = problem_key,
    cutoff: float | None = None,
) -> list[Pair]:
    """Return problems that both solved; runs are paired by problem and seed, or by `key`.

    Values that are not positive have no ratio and are left out.

    Args:
        rows: rows of the planner.
        baseline: rows of the planner to compare with.
        value: function that returns the value of a row.
        key: function that returns a key; rows with equal keys are paired.
        cutoff: value of a failed run and largest value of any run; then all problems that both
            tried are compared.
    """

    def counted(row: ResultRow) -> float | None:
        number = value(row) if row.solved else cutoff
        return number if cutoff is None or number is None else min(number, cutoff)

    reference = {key(row): counted(row) for row in baseline}
    found: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        own, other = counted(row), reference.get(key(row))
        if own and other and own > 0.0 < other:
            found.setdefault(row.problem, []).append((own, other))
    return [Pair(problem, values) for problem, values in found.items()]


def mean_ratio(pairs: Iterable[Pair]) -> Interval:
    """`exp(mean(log(own / other)))` over problems, with a bootstrap interval."""
    return geometric_mean_interval([pair.ratio for pair in pairs])


# ---------------------------------------------------------------- easy and hard problems


def split_by_work(reference: Iterable[ResultRow]) -> Mapping[str, frozenset[ProblemKey]]:
    """Return all, easy and hard runs of a planner.

    Hard problems have more median work than two thirds of the others.
    The median is over the planner's other seeds, so that a problem is not called hard because of
    the run that others are compared with; with one seed it is that one. Failed runs have infinite
    work. At most a third are hard: ties are easy. Problems of unknown work are left out.
    """
    rows = [row for row in reference if not row.solved or work(row) is not None]
    hard: set[ProblemKey] = set()
    for seed in {row.seed for row in rows}:
        problems = _hard_problems([row for row in rows if row.seed != seed] or rows)
        hard |= {problem_key(row) for row in rows if row.seed == seed and row.problem in problems}
    every = frozenset(map(problem_key, rows))
    return {"all": every, "easy": every - hard, "hard": frozenset(hard)}


def _hard_problems(rows: Rows) -> frozenset[str]:
    efforts = {
        problem: median(censored([row], work)[0][0] for row in seeds)
        for problem, seeds in grouped((row.problem, row) for row in rows).items()
    }
    ordered = sorted(efforts.values())
    last_easy = math.ceil((1.0 - HARD_SHARE) * len(ordered) - 1e-9) - 1
    return frozenset(problem for problem, effort in efforts.items() if effort > ordered[last_easy])


# ---------------------------------------------------------------- columns


@dataclass(frozen=True)
class SuiteRuns:
    """Rows of one suite, and the sets of runs by which columns compare planners."""

    rows: Rows
    groups: Mapping[str, Rows]  # rows by planner (and backend, if a planner ran with several)
    solving: Sequence[str]  # planners that solved at least one run
    joint: Collection[ProblemKey]  # runs that all planners in `solving` solved
    # all, easy and hard runs by the work of REFERENCE; empty where that was not run
    split: Mapping[str, Collection[ProblemKey]]
    unmade: Mapping[str, str] = field(default_factory=dict)  # problems left out -> reason

    def baseline(self, planner: str) -> Rows:
        """Rows of the baseline of ratios; empty if it was not run."""
        return next((rows for rows in self.groups.values() if rows[0].planner == planner), ())


Measure = Callable[[Rows, SuiteRuns], Interval]
"""Function that returns the number of a column for a planner's rows."""
Over = Literal["all", "solved", "joint", "stated"]
"""Runs that a statistic uses: all, with failures as infinite; solved; jointly solved; stated."""


def share_of(
    counted: Callable[[ResultRow], bool], among: Callable[[ResultRow], bool] | None = None
) -> Measure:
    """Return the percentage of counted runs as a measure, with Wilson's interval."""
    return lambda rows, runs: fraction(filter(among, rows) if among else rows, counted)


def solved_within(time: float) -> Measure:
    """Percentage of the runs that are solved within a time [s], with Wilson's interval."""

    def measure(rows: Rows, runs: SuiteRuns) -> Interval:
        # no call of Python for each row: a table has many times, and many rows
        taken = [(row.problem, row.solved, row.t_total_s) for row in rows]
        done = [(name, good and s is not None and s <= time) for name, good, s in taken]
        return problem_share(done)

    return measure


def median_of(value: str, over: Over = "all") -> Measure:
    """Return the median of a value of `VALUES` as a measure, with an order-statistic interval."""
    return lambda rows, runs: problem_median(_numbers(rows, runs, value, over))


def mean_of(value: str, over: Over = "all") -> Measure:
    """Return the mean of finite values as a measure, with a bootstrap interval."""
    return lambda rows, runs: problem_mean(_numbers(rows, runs, value, over))


def most_of(value: str) -> Measure:
    """Return the largest value of the runs that have one, as a measure without interval."""

    def measure(rows: Rows, runs: SuiteRuns) -> Interval:
        stated = [x for row in rows if (x := VALUES[value](row)) is not None]
        return Interval(max(stated), None, None, len(stated)) if stated else UNDEFINED

    return measure


def number_of(value: Value) -> Measure:
    """Return the number of runs with a value other than 0, as a measure without interval."""

    def measure(rows: Rows, runs: SuiteRuns) -> Interval:
        stated = [x for row in rows if (x := value(row)) is not None]
        counted = float(sum(x != 0 for x in stated))
        return Interval(counted, None, None, len(stated)) if stated else UNDEFINED

    return measure


def _numbers(rows: Rows, runs: SuiteRuns, value: str, over: Over) -> list[list[float]]:
    if over == "all":
        return censored(rows, VALUES[value])
    chosen = [row for row in rows if row.solved or over == "stated"]
    if over == "joint":
        chosen = [row for row in chosen if problem_key(row) in runs.joint]
    known = [(row.problem, x) for row in chosen if (x := VALUES[value](row)) is not None]
    return [*grouped(known).values()]


def ratio_to(baseline: str, value: Value, part: str | None = None) -> Measure:
    """`mean_ratio` to the baseline; on a part of the split, or everywhere."""

    def measure(rows: Rows, runs: SuiteRuns) -> Interval:
        if part is not None:
            counted = runs.split[part]
            rows = [row for row in rows if problem_key(row) in counted]
        return mean_ratio(paired(rows, runs.baseline(baseline), value))

    return measure
