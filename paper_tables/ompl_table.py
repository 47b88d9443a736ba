"""Table of the paper's experiment inside OMPL: Table I in the paper's currency and statistic.

Cost is priced work, see `search.work.PRICES`. Ratios follow the rule in docs/judgement.md:
arithmetic means, each over its own solved problems, with BCa intervals.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from statistics import fmean

from cvqmpt_lab.benchmarks.results.row import ResultRow
from cvqmpt_lab.benchmarks.results.statistics import (
    CONFIDENCE,
    UNDEFINED,
    Interval,
    ProblemKey,
    jointly_solved,
    problem_key,
)
from cvqmpt_lab.paper_tables import table_engine as table
from cvqmpt_lab.paper_tables.bootstrap import ratio_of_means
from cvqmpt_lab.paper_tables.layouts import group_table
from cvqmpt_lab.paper_tables.measures import (
    VALUES,
    Measure,
    Rows,
    SuiteRuns,
    Value,
    grouped,
    mean_of,
    median_of,
    problem_mean,
    share_of,
    solved,
)
from cvqmpt_lab.paper_tables.statements import CBIRRT, UNIFORM, PublishedValue, in_ompl
from cvqmpt_lab.paper_tables.table_engine import Column, SuiteTable
from cvqmpt_lab.paper_tables.within import FEWEST_PROBLEMS
from cvqmpt_lab.paper_tables.writers import Ratio

PAPER_CUTOFF_S = 100.0
TABLE_DRAWS = 10_000  # of the bootstrap; verdicts have more


def capped(value: str) -> Value:
    """Return a cost as a value of a row, at most the cut-off, which the last iteration can pass."""

    def cost(row: ResultRow) -> float | None:
        found = VALUES[value](row)
        return None if found is None else min(found, PAPER_CUTOFF_S)

    return cost


def mean_cost(value: str) -> Measure:
    """Return the arithmetic mean over the problems that a planner solved as a measure."""

    def measure(rows: Rows, runs: SuiteRuns) -> Interval:
        costs = [(row.problem, x) for row in rows if row.solved and (x := capped(value)(row))]
        return problem_mean([*grouped(costs).values()])

    return measure


def solved_at(cost: float) -> Measure:
    """Return the share of problems solved at a cost or less as a measure [%]."""
    of = capped("search_cost")
    return share_of(lambda row: row.solved and (of(row) or 0.0) <= cost)


def means_ratio(baseline: str, value: Value, both: bool = False) -> Measure:
    """Return the ratio of arithmetic means to a baseline as a measure, with its BCa interval.

    Args:
        baseline: name of a planner.
        value: of a row.
        both: whether both means are over the problems that both solved, as for lengths; otherwise
            each is over those that its planner solved. Seeds of a problem are averaged first.
    """

    def known(rows: Rows) -> dict[ProblemKey, float]:
        found = {problem_key(row): value(row) if row.solved else math.nan for row in rows}
        return {key: x for key, x in found.items() if x is not None}

    def mean(seeds: Iterable[float]) -> float:
        solved = [x for x in seeds if not math.isnan(x)]
        return fmean(solved) if solved else math.nan

    def measure(rows: Rows, runs: SuiteRuns) -> Interval:
        if rows[0].planner == baseline:
            return UNDEFINED
        own, other = known(rows), known(runs.baseline(baseline))
        pairs = [(key[1], (own[key], other[key])) for key in own if key in other]
        if both:
            pairs = [pair for pair in pairs if not math.isnan(sum(pair[1]))]
        if not pairs:
            return UNDEFINED
        # seeds of one problem are not independent: their mean counts once
        problems = [map(mean, zip(*seeds, strict=True)) for seeds in grouped(pairs).values()]
        ours, theirs = zip(*problems, strict=True)
        found = ratio_of_means(ours, theirs, 1.0 - CONFIDENCE, TABLE_DRAWS)
        return found if len(ours) >= FEWEST_PROBLEMS else found._replace(low=None, high=None)

    return measure


def joint_mean(value: str) -> Measure:
    """Return the mean over the joint problems; undefined for a planner that solved not all."""

    def measure(rows: Rows, runs: SuiteRuns) -> Interval:
        every = {problem_key(row) for row in rows if row.solved}.issuperset(runs.joint)
        return mean_of(value, "joint")(rows, runs) if every else UNDEFINED

    return measure


def _ratios(label: str, name: str, value: Value, both: bool = False) -> dict[str, Column]:
    """Return the columns of a value's ratios to CBiRRT and to uniform samples."""
    return {
        f"{name}_means_over_{baseline}": Column(
            Ratio(f"{label} / {baseline}"), "1", means_ratio(baseline, value, both)
        )
        for baseline in (CBIRRT, UNIFORM)
    }


COST_COLUMNS = {
    "accuracy": Column("solved [%]", "%", share_of(solved), "accuracy", best="most"),
    "search_cost_mean": Column("cost [s]", "s", mean_cost("search_cost"), "time"),
    **_ratios("cost", "search_cost", capped("search_cost")),
}
WITHIN_COLUMNS = {
    f"solved_within_{seconds}": Column(
        f"solved within {seconds} s [%]", "%", solved_at(seconds), best="most"
    )
    for seconds in (10, 50)
}
PYBULLET_COLUMNS = {
    "search_cost_pybullet_mean": Column("cost [s]", "s", mean_cost("search_cost_pybullet")),
    **_ratios("cost", "search_cost_pybullet", capped("search_cost_pybullet")),
}
LENGTH_COLUMNS = {
    "raw_length_mean": Column("raw [rad]", "rad", joint_mean("raw_length")),
    "ompl_length_mean": Column("simplified by OMPL [rad]", "rad", joint_mean("ompl_length")),
    "path_length_mean": Column("ours [rad]", "rad", joint_mean("path_length")),
    **_ratios("simplified by OMPL", "ompl_length", VALUES["ompl_length"], both=True),
}
COUNT_COLUMNS = {
    "stored_vertices_mean": Column(
        "vertices", "1", mean_of("stored_vertices", "solved"), "vertices"
    ),
    "goals_tried_mean": Column("goals tried", "1", mean_of("goals_tried", "stated"), best="none"),
    "state_checks_median": Column("state checks", "1", median_of("state_checks")),
    "projections_median": Column("projections", "1", median_of("projections")),
    "newton_iterations_median": Column("Newton steps", "1", median_of("newton_iterations")),
    "draw_newton_steps_median": Column(
        "Newton steps a draw", "1", median_of("draw_newton_steps", "stated")
    ),
    "network_time_median": Column("network [s]", "s", median_of("network_time", "stated")),
    "search_time_median": Column("search here [s]", "s", median_of("search_time")),
}
NOTES = (
    "The paper's experiment: every planner in OMPL's RRTConnect on a projected space, with the "
    "same compiled checks and projections. `ompl-cvq`, `ompl-opt-cvq` and `ompl-uniform` differ "
    "in samples alone: longest motion as published (none is cut), one goal after the other, 2.5 s "
    "of cost each. `ompl-projected`, the paper's CBiRRT, has OMPL's longest motion and all goals.",
    "Cost: state checks, projections and Newton steps at the prices of the published code, 100 s "
    "at most. Networks cost nothing there; their seconds on this machine have a column. As in the "
    "paper, means are over the problems that a planner solved, so read them beside the shares "
    "solved. Ratios of means have BCa intervals (bootstrap) from 30 problems on.",
    "Lengths: means over problems that all planners with lengths solved (`ompl-mpnet` has none); "
    "ratios over those that both solved, which are more. "
    "OMPL's simplification, as in the published code, removes states and makes no shortcuts.",
    "Vertices: as OMPL's PlannerData counts them, roots included, over all goals tried.",
    "Solved: certified paths; the published code checks no path after the search.",
)


def ompl_table(rows: Iterable[ResultRow], published: Sequence[PublishedValue] = ()) -> SuiteTable:
    """Return cost, lengths and counts of planners inside OMPL, beside the paper's Table I."""
    published = in_ompl(published)
    columns = {
        **COST_COLUMNS,
        **WITHIN_COLUMNS,
        **PYBULLET_COLUMNS,
        **LENGTH_COLUMNS,
        "solved_length_mean": Column(
            "length [rad]", "rad", mean_of("ompl_length", "solved"), "path_length"
        ),
        **COUNT_COLUMNS,
    }
    judging = {
        name: columns[name]
        for name in (
            *("accuracy", *WITHIN_COLUMNS, f"search_cost_means_over_{CBIRRT}"),
            f"ompl_length_means_over_{CBIRRT}",
        )
    }
    runs = _joint_lengths(table.suite_runs(rows, published))
    found = table.entries(runs, columns, published)
    suite, size = runs.rows[0].suite, f"{len({row.problem for row in runs.rows})} problems"
    metrics = {
        "accuracy": "accuracy",
        "time": "search_cost_mean",
        "vertices": "stored_vertices_mean",
        "path_length": "solved_length_mean",
    }
    joint = f"{len(runs.joint)} problems that all planners with lengths solved"
    heads = [f"{name}, {who}".replace("_", " ") for name in metrics for who in ("paper", "here")]
    paper = [["planner", *heads]]
    for item in found:
        cells = [[item.paper_cell(name), item.cell(column)] for name, column in metrics.items()]
        paper.append([item.title, *(cell for pair in cells for cell in pair)])
    return SuiteTable(
        suite,
        size,
        found,
        {
            f"{size}, at the prices of the published code": table.column_lines(found, COST_COLUMNS),
            "The paper's Table I, and here, each planner over the problems that it solved": paper,
            "Table I by the rule": table.column_lines(found, judging),
            "At the prices of PyBullet's kinematics": table.column_lines(found, PYBULLET_COLUMNS),
            f"Path lengths, means over {joint}": table.column_lines(found, LENGTH_COLUMNS),
            "Counts and times": table.column_lines(found, COUNT_COLUMNS),
            **table.counted(found),
            "Notes": [*NOTES, *table.run_notes(runs)],
            "Notes on the paper's numbers": table.published_notes(runs, published),
        },
        partial(
            table.latex_planners,
            found=found,
            metrics={k: {"here": v} for k, v in metrics.items()},
        ),
    )


def _joint_lengths(runs: SuiteRuns) -> SuiteRuns:
    """Return runs; their joint problems are the ones that all planners with lengths solved."""
    lengths = VALUES["ompl_length"]
    groups = {
        name: rows
        for name, rows in runs.groups.items()
        if any(lengths(row) is not None for row in rows)
    }
    return replace(runs, solving=sorted(groups), joint=frozenset(jointly_solved(groups)))


def kinds_table(rows: Iterable[ResultRow], published: Sequence[PublishedValue] = ()) -> SuiteTable:
    """Return cost, ratios and lengths of planners inside OMPL for each kind of constraint."""
    names = ("solved", "cost", "cost_ratio", "uniform_ratio", "length_ratio")
    columns = (
        COST_COLUMNS["accuracy"],
        COST_COLUMNS["search_cost_mean"],
        COST_COLUMNS[f"search_cost_means_over_{CBIRRT}"],
        COST_COLUMNS[f"search_cost_means_over_{UNIFORM}"],
        LENGTH_COLUMNS[f"ompl_length_means_over_{CBIRRT}"],
    )
    known = dict(zip(names, columns, strict=True))
    notes = (
        "Weights were trained without constraints and without these scenes. It is not known "
        "whether each problem has a solution.",
        *NOTES,
    )
    return group_table(rows, published, what="constraint", notes=notes, columns=names, known=known)
