"""The main comparisons of cost again, with transformers that were trained from other seeds.

A results directory ``NAME-training-K`` has rows of a transformer that was trained with seed K. The
baselines use no transformer, so their rows are in the directory NAME.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product

from cvqmpt_lab.benchmarks.results.statistics import CONFIDENCE, Interval
from cvqmpt_lab.paper_tables.bootstrap import ratio_of_means
from cvqmpt_lab.paper_tables.claims import both_ran, cost_sides
from cvqmpt_lab.paper_tables.evidence import Evidence
from cvqmpt_lab.paper_tables.ompl_table import TABLE_DRAWS
from cvqmpt_lab.paper_tables.statements import CBIRRT, CVQ, OPT, UNIFORM
from cvqmpt_lab.paper_tables.writers import Lines, estimate

SEEDS = (0, 1, 2)  # of the trainings; the shipped transformer has the first
SUITES = {  # results directories of the main comparisons, and their problems in words
    "place-task-ompl": "place task",
    "place-task-published": "place task in the published direction",
    "multi-sequence-published": "tasks",
}


def directory_of(suite: str, seed: int) -> str:
    """Return the name of the results directory of a suite with one training."""
    return f"{suite}-training-{seed}" if seed else suite


def all_directories() -> set[str]:
    """Return the names of the results directories of all trainings."""
    return {directory_of(suite, seed) for suite, seed in product(SUITES, SEEDS)}


def trained_ratios(found: Mapping[str, Evidence]) -> dict[tuple[str, str, str], list[Interval]]:
    """Return ratios of means of cost with 95 % intervals, one for each of `SEEDS`.

    The keys are results directory, planner and baseline. Empty if a directory is missing.

    found: results directories by name.
    """
    ratios: dict[tuple[str, str, str], list[Interval]] = {}
    if not all_directories() <= found.keys():
        return ratios
    for suite, seed in product(SUITES, SEEDS):
        own = found[directory_of(suite, seed)]
        rows = [row for row in own.rows if row.planner in (CVQ, OPT)]
        rows += [row for row in found[suite].rows if row.planner in (CBIRRT, UNIFORM)]
        evidence = replace(own, rows=rows)
        for planner, baseline in product((CVQ, OPT), (CBIRRT, UNIFORM)):
            runs = both_ran(evidence, planner, baseline)
            if runs:
                ours, theirs = cost_sides(runs)
                ratio = ratio_of_means(ours, theirs, 1.0 - CONFIDENCE, TABLE_DRAWS)
                ratios.setdefault((suite, planner, baseline), []).append(ratio)
    return ratios


def training_lines(found: Mapping[str, Evidence]) -> Lines:
    """Return a line for each main comparison, with a column for each training."""
    ratios = trained_ratios(found)
    lines = [["problems", "planner", "against", *(f"training {seed}" for seed in SEEDS)]]
    for (suite, planner, baseline), intervals in ratios.items():
        cells = [f"`{planner}`", f"`{baseline}`", *map(estimate, intervals)]
        lines.append([SUITES[suite], *cells])
    return lines if ratios else []
