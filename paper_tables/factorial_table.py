"""Ablation of learned samplers: choices of `vqmpt.sampler_choice`, and uniform samples."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from operator import attrgetter
from typing import NamedTuple

from cvqmpt_lab.benchmarks.results.row import ResultRow
from cvqmpt_lab.benchmarks.results.statistics import Interval
from cvqmpt_lab.paper_tables import table_engine as table
from cvqmpt_lab.paper_tables.measures import (
    REFERENCE,
    VALUES,
    WORK,
    Rows,
    SuiteRuns,
    Value,
    mean_ratio,
    median_of,
    paired,
    ratio_to,
    share_of,
    solved,
)
from cvqmpt_lab.paper_tables.statements import PublishedValue
from cvqmpt_lab.paper_tables.table_engine import Column, SuiteTable
from cvqmpt_lab.paper_tables.writers import Ratio
from cvqmpt_lab.vqmpt.sampler_choice import CHOICES, NAMED_SAMPLERS

PREDICTORS = (  # in their order in the table
    *("uniform", "nearest-lines", "transformer-lines"),
    *("transformer", "published", "random", "oracle", "solved"),
)
# columns of rows; reach is None where extensions have no limit
FACTORS = (
    *("predictor", "gaussians", "update", "cloud", "uniform_share", "sequences"),
    *("reading", "draws", "reach"),
)
CONTRASTED: Mapping[str, Value] = {
    "work": VALUES["work"],
    "projections": VALUES["projections"],
    "length": VALUES["path_length"],
    "G": VALUES["g_sampled"],
}
FACTORIAL_COLUMNS: Mapping[str, Column] = {
    "solved": Column("solved %", "%", share_of(solved), best="most"),
    **{
        f"{name}_ratio": Column(Ratio(name), "1", ratio_to(REFERENCE, value))
        for name, value in CONTRASTED.items()
    },
    "own_time_median": Column("time [s]", "s", median_of("own_time")),
}
DECODED: Mapping[str, object] = {"gaussians": "decoded", "uniform_share": 0.0}
WIDE: Mapping[str, object] = {"gaussians": "wide"}
SEEING: Mapping[str, object] = {"predictor": "transformer"}
SEEING_DECODED, SEEING_WIDE = {**SEEING, **DECODED}, {**SEEING, **WIDE}
SAME: Mapping[str, object] = {"uniform_share": 0.15}
FACTORIAL_NOTES = (
    f"Work ({WORK}), projections, length and G are ratios to {REFERENCE}: "
    "geometric mean of the ratio over problems that both solved, bootstrap interval [95 %]. "
    "Solved: certified paths, Wilson interval.",
    "G = F(q)^T F(q): mean over 256 fixed samples of the distribution, inside the joint limits, "
    "before projection.",
    "Time: median, failures count as infinite; with encoding of the cloud, without goal inverse "
    "kinematics.",
    "Work counts the projections of means. It does not count the gradient of Algorithm 2 (F and "
    "its Jacobian at 16 samples per code and step, in five steps, and F at 64 more samples), "
    "which is part of the time.",
    "Contrasts: ratio of the first choice to the second, with all other choices equal. All "
    "products that both sides have are paired by problem and seed, and each problem counts once. "
    "Intervals are not corrected for their number. Wide and decoded are compared with 15 % "
    "uniform samples. Runs that one side failed are left out, which is an advantage of the side "
    "that fails more.",
    "The transformer also chooses the three goals that get a Gaussian; with random codes these are "
    "the nearest goals. The oracle's work includes the search of the unconstrained path from which "
    "its codes are read.",
    "Planners with a name: "
    + "; ".join(
        f"{name} is {', '.join(f'{value}' for value in asdict(choice).values())}"
        for name, choice in NAMED_SAMPLERS.items()
    )
    + ".",
)


class Contrast(NamedTuple):
    """Two values of a factor, compared on rows whose other factors are equal."""

    title: str
    factor: str  # one of FACTORS
    one: object
    other: object
    within: Mapping[str, object]  # choices that both sides have

    def entry(self, runs: SuiteRuns) -> table.Entry:
        """Return ratios of the first side's rows to the second side's, all other factors equal."""
        sides = []
        for value in (self.one, self.other):
            wanted = {**self.within, self.factor: value}.items()
            sides.append([row for row in runs.rows if all(getattr(row, n) == x for n, x in wanted)])
        shared = attrgetter("suite", "problem", "seed", *(n for n in FACTORS if n != self.factor))

        def ratio(value: Value, rows: Rows, runs: SuiteRuns) -> Interval:
            return mean_ratio(paired(rows, sides[1], value, shared))

        columns = {
            name: Column(Ratio(name), "1", partial(ratio, x)) for name, x in CONTRASTED.items()
        }
        return table.entry(self.title, sides[0], runs, columns, suffix="_contrast")


EVERY: Mapping[str, object] = {"reading": "every-waypoint"}
CONTRASTS = (
    *(
        Contrast(
            f"{one} / {other}, {name}, every waypoint", "predictor", one, other, {**kind, **EVERY}
        )
        for one, other in (
            ("transformer", "transformer-lines"),
            ("transformer-lines", "nearest-lines"),
            ("transformer", "solved"),
        )
        for name, kind in (("decoded", DECODED), ("wide", WIDE))
    ),
    *(
        Contrast(
            f"{title}, {predictor} {name}", factor, one, other, {"predictor": predictor, **kind}
        )
        for title, factor, one, other in (
            ("every waypoint / merged", "reading", "every-waypoint", "merged"),
            ("projected / raw draws", "draws", "projected-draws", "raw-draws"),
            ("no limit / extensions of 1 rad", "reach", None, 1.0),
        )
        for predictor in ("transformer", "random", "uniform")
        for name, kind in (("decoded", DECODED), ("wide", WIDE))
    ),
    Contrast("transformer / random codes, decoded", "predictor", "transformer", "random", DECODED),
    Contrast("transformer / random codes, wide", "predictor", "transformer", "random", WIDE),
    Contrast("own / other cloud, decoded", "cloud", "own-cloud", "other-cloud", SEEING_DECODED),
    Contrast("own / other cloud, wide", "cloud", "own-cloud", "other-cloud", SEEING_WIDE),
    Contrast("own / no cloud, decoded", "cloud", "own-cloud", "no-cloud", SEEING_DECODED),
    Contrast("own / no cloud, wide", "cloud", "own-cloud", "no-cloud", SEEING_WIDE),
    Contrast(
        "Algorithm 2 / none, transformer decoded", "update", "algorithm-2", "none", SEEING_DECODED
    ),
    Contrast("Algorithm 2 / none, all decoded", "update", "algorithm-2", "none", DECODED),
    Contrast("Algorithm 2 / none, all wide", "update", "algorithm-2", "none", WIDE),
    Contrast(
        "projected / none, transformer decoded", "update", "projected", "none", SEEING_DECODED
    ),
    Contrast("projected / none, all decoded", "update", "projected", "none", DECODED),
    Contrast("projected / none, all wide", "update", "projected", "none", WIDE),
    Contrast("wide / decoded, transformer", "gaussians", "wide", "decoded", {**SEEING, **SAME}),
    Contrast(
        "wide / decoded, random codes",
        "gaussians",
        "wide",
        "decoded",
        {"predictor": "random", **SAME},
    ),
    Contrast("15 % uniform / none, decoded", "uniform_share", 0.15, 0.0, {"gaussians": "decoded"}),
    Contrast(
        "all beams / likeliest, transformer wide", "sequences", "all-beams", "likeliest", WIDE
    ),
)


def factorial_table(rows: Iterable[ResultRow], published: Sequence[PublishedValue]) -> SuiteTable:
    """Return the table of every product by predictor, and of the contrasts."""
    runs = table.suite_runs(rows)
    groups = sorted(runs.groups.items(), key=lambda item: _place(item[1][0]))
    found = [
        table.entry(
            name, own, runs, FACTORIAL_COLUMNS, group=(own[0].predictor or "uniform samples",)
        )
        for name, own in groups
    ]
    compared = [contrast.entry(runs) for contrast in CONTRASTS]
    contrasts = [item for item in compared if item.measured["work"].n]
    lines = table.group_lines(found, ["predictor"])
    compared_lines = [["the first / the second", "problems", *map(Ratio, CONTRASTED)]]
    for item in contrasts:
        pairs = str(item.measured["work"].n)
        compared_lines.append([item.planner, pairs, *map(item.cell, CONTRASTED)])
    notes = [*FACTORIAL_NOTES, *table.run_notes(runs)]
    suite, size = runs.rows[0].suite, f"{len({row.problem for row in runs.rows})} problems"
    return SuiteTable(
        suite,
        size,
        [*found, *contrasts],
        {"Products": lines, "Contrasts": compared_lines, **table.counted(found), "Notes": notes},
        partial(table.latex_groups, lines=lines),
    )


def _place(row: ResultRow) -> tuple[int, ...]:
    """Sort key: REFERENCE first, controls of one choice after their predictor's others."""
    if row.predictor is None:
        return (-1,)
    assert row.gaussians is not None and row.update is not None and row.cloud is not None
    special = (row.cloud != CHOICES["cloud"][0]) + 2 * (
        row.gaussians == "decoded" and bool(row.uniform_share)
    )
    return (
        PREDICTORS.index(row.predictor),
        special + 4 * (row.sequences == "all-beams"),
        CHOICES["gaussians"].index(row.gaussians),
        CHOICES["update"].index(row.update),
        CHOICES["cloud"].index(row.cloud),
        row.reading == "every-waypoint",
        row.draws == "raw-draws",
        row.reach is not None,
    )
