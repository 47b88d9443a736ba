"""Where learning pays: methods against uniform samples on ever harder problems, hard by other seeds than compared."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from statistics import median

import numpy as np

from cvqmpt_lab.distributions import Uniform
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import RUNS_FILE, ResultRow, natural_key, read_rows
from cvqmpt_lab.results.statistics import Interval
from experiments.figures.drawing import save_figure
from experiments.figures.histogram import write_csv
from experiments.figures.lines import Line, Panel, panels_figure
from experiments.suites.suite import suite_named
from paper_tables.measures import RATIOS, REFERENCE, fraction, paired_ratio
from paper_tables.table_engine import by_planner, rows_of_one_suite

SEEDS = range(100, 105)
"""Of the uniform searches that say how hard a problem is; tables use small ones."""
ENOUGH = Budget(iterations=20_000)
BINS = 5
SPREAD = ("work_ratio", "own_time_ratio")
RATIO_NAMES = (*SPREAD, "length_ratio")


def difficulty(problem: PlanningProblem) -> float:
    """Median work of uniform `birrt` over `SEEDS`; infinite where most fail."""
    problem = with_sampled_goals(problem)[0]
    space, trees = ConstrainedSpace(problem), BiRRT()
    uniform = Uniform(problem.robot.lower, problem.robot.upper)
    plans = [
        trees.search(space, problem.start, problem.goals, uniform, ENOUGH, np.random.default_rng(seed))
        for seed in SEEDS
    ]
    efforts = [
        plan.counters.projections + plan.counters.state_checks if plan.path else math.inf for plan in plans
    ]
    return float(median(efforts))


def bins_of(difficulties: Mapping[str, float], bins: int = BINS) -> list[list[str]]:
    """Names of problems from easy to hard in groups of nearly equal size; ties go by name."""
    ordered = sorted(difficulties, key=lambda name: (difficulties[name], natural_key(name)))
    return [list(part) for part in np.array_split(np.array(ordered, dtype=object), min(bins, len(ordered)))]


def draw_difficulty(folder: Path) -> list[Path]:
    """Search with other seeds and draw the rows of a folder, beside them; errors as of `read_rows`."""
    rows = rows_of_one_suite(read_rows(folder / RUNS_FILE))
    suite = suite_named(rows[0].suite)
    named = {
        row.problem: suite.solvable(int(row.item)) for row in rows if row.planner == REFERENCE and row.solved
    }
    hard = {name: difficulty(item) for name, item in named.items() if isinstance(item, PlanningProblem)}
    groups, parts = by_planner(rows, ()), bins_of(hard)
    centres = [float(median(hard[name] for name in part)) for part in parts]
    reference = groups[REFERENCE]
    measures = _measures(reference)
    found = {
        what: {
            name: [measure(group, frozenset(part)) for part in parts]
            for name, group in groups.items()
            if name != REFERENCE or what == "solved"
        }
        for what, measure in measures.items()
    }
    panels = [
        Panel(
            "solved [%]" if what == "solved" else f"{RATIOS[what][0]} / {REFERENCE}",
            f"median work of {REFERENCE} with other seeds",
            "%" if what == "solved" else "ratio",
            [Line(name, centres, values) for name, values in lines.items()],
            log=(True, what in SPREAD),
            bands=what != "solved",  # many lie upon each other at 100 %
            level=None if what == "solved" else 1.0,
        )
        for what, lines in found.items()
    ]
    table = write_csv(folder / "difficulty.csv", list(_cells(found, parts, centres)))
    return [*save_figure(panels_figure(panels), folder, "difficulty"), table]


def _measures(
    reference: Sequence[ResultRow],
) -> dict[str, Callable[[Sequence[ResultRow], frozenset[str]], Interval]]:
    """What is drawn of a planner's rows on some problems."""

    def ratio(name: str) -> Callable[[Sequence[ResultRow], frozenset[str]], Interval]:
        return lambda rows, part: paired_ratio(
            rows, reference, RATIOS[name][1], lambda row: row.problem in part
        )

    def solved(rows: Sequence[ResultRow], part: frozenset[str]) -> Interval:
        return fraction([row for row in rows if row.problem in part], attrgetter("solved")).scaled(100)

    return {**{name: ratio(name) for name in RATIO_NAMES}, "solved": solved}


def _cells(
    found: Mapping[str, Mapping[str, Sequence[Interval]]],
    parts: Sequence[Sequence[str]],
    centres: Sequence[float],
) -> Iterable[dict[str, object]]:
    """A line for each number."""
    for what, lines in found.items():
        for name, values in lines.items():
            for k, interval in enumerate(values):
                yield {
                    "measure": what,
                    "planner": name,
                    "bin": k + 1,
                    "problems": len(parts[k]),
                    "work_of_birrt": centres[k],
                    "value": interval.estimate,
                    "low": interval.low,
                    "high": interval.high,
                    "n": interval.n,
                }
