"""Layouts of rows: the paper's Table I (also of scanned scenes), by group, external planners."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from operator import attrgetter

from cvqmpt_lab.benchmarks.results.row import FailReason, ResultRow, split_problem
from cvqmpt_lab.benchmarks.results.statistics import Interval
from cvqmpt_lab.paper_tables import table_engine as table
from cvqmpt_lab.paper_tables.measures import (
    PUBLISHED_PRICES,
    RATIOS,
    REFERENCE,
    VALUES,
    WORK,
    SuiteRuns,
    mean_of,
    median_of,
    most_of,
    number_of,
    ratio_to,
    share_of,
    solved,
    solved_within,
)
from cvqmpt_lab.paper_tables.statements import PublishedValue
from cvqmpt_lab.paper_tables.table_engine import Column, Entry, SuiteTable
from cvqmpt_lab.paper_tables.writers import Lines, Ratio, Sections, number, rounded
from cvqmpt_lab.vqmpt.config import BY_ROLLOUTS, ROLLOUTS_ALONE

# ---------------------------------------------------------------- like the paper's Table I

BASELINE = "ompl-projected"
CURVE_TIMES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)  # [s]
SPLIT_PARTS = ("all", "easy", "hard")


def _detail_begins(text: str, row: ResultRow) -> bool:
    """Return whether the detail of a solved run begins with a text."""
    return row.solved and (row.detail or "").startswith(text)


def split_metric(ratio: str, part: str) -> str:
    """Return the name of a ratio's column on a part of the problems."""
    return f"{ratio}_{part}_of_{REFERENCE}"


HEADLINE_COLUMNS = {
    "accuracy": Column("Accuracy", "%", share_of(solved), "accuracy", best="most"),
    "time_median": Column("Time", "s", median_of("time")),
    "time_mean": Column("Time", "s", mean_of("time"), "time"),
    "vertices_median": Column("Vertices", "1", median_of("vertices", "solved")),
    "vertices_mean": Column("Vertices", "1", mean_of("vertices", "solved"), "vertices"),
    "path_length_median": Column("Path length", "rad", median_of("path_length", "joint")),
    "path_length_mean": Column(
        "Path length", "rad", mean_of("path_length", "joint"), "path_length"
    ),
}
EFFORT_COLUMNS = {
    "path_length_raw_median": Column("raw length [rad]", "rad", median_of("raw_length", "joint")),
    "projections_median": Column("projections", "1", median_of("projections")),
    "newton_iterations_median": Column("Newton iterations", "1", median_of("newton_iterations")),
    "newton_steps_median": Column("steps per projection", "1", median_of("newton_steps", "stated")),
    "newton_steps_ratio": Column(
        Ratio(f"steps per projection / {REFERENCE}"),
        "1",
        ratio_to(REFERENCE, VALUES["newton_steps"]),
    ),
    "state_checks_median": Column("state checks", "1", median_of("state_checks")),
    "work_median": Column("work", "1", median_of("work")),
    "clearances_median": Column("clearances", "1", median_of("clearances")),
    "known_time_median": Column("time, scene known [s]", "s", median_of("known_time")),
    "new_time_median": Column("time, scene new [s]", "s", median_of("new_time")),
    "time_ratio": Column(Ratio(f"time / {BASELINE}"), "1", ratio_to(BASELINE, VALUES["time"])),
    "fallbacks": Column(
        "by fallback [%]", "%", share_of(lambda row: row.fallback is not None), best="none"
    ),
}
GROWN_COLUMNS = {  # only for rows with numbers of extensions
    "extensions_median": Column("extension ends", "1", median_of("extensions", "solved")),
    "extensions_mean": Column("extension ends, mean", "1", mean_of("extensions", "solved")),
    "draw_newton_steps_median": Column(
        "Newton steps per sample", "1", median_of("draw_newton_steps", "stated")
    ),
    "draw_newton_steps_ratio": Column(
        Ratio(f"Newton steps per sample / {REFERENCE}"),
        "1",
        ratio_to(REFERENCE, VALUES["draw_newton_steps"]),
    ),
}
ROLLOUT_COLUMNS = {  # only for planners that connect states of rollouts
    "rollouts_alone": Column(
        "by rollouts alone [%]", "%", share_of(partial(_detail_begins, ROLLOUTS_ALONE)), best="none"
    )
}
PAPER_COST_COLUMNS = {
    "paper_cost_median": Column("time at the paper's cost [s]", "s", median_of("paper_cost")),
    **{
        f"paper_cost_ratio_{name}": Column(
            Ratio(f"the same / {name}"), "1", ratio_to(name, VALUES["paper_cost"])
        )
        for name in (REFERENCE, BASELINE)
    },
}
SPLIT_COLUMNS = {
    split_metric(name, part): Column(label, "1", ratio_to(REFERENCE, value, part))
    for name, (label, value) in RATIOS.items()
    for part in SPLIT_PARTS
}
CURVE_COLUMNS = {
    f"solved_within_{time:g}_s": Column(f"{time:g} s", "%", solved_within(time), best="most")
    for time in CURVE_TIMES
}
PLACE_COLUMNS: Mapping[str, Column] = {
    **HEADLINE_COLUMNS,
    **EFFORT_COLUMNS,
    **PAPER_COST_COLUMNS,
    **SPLIT_COLUMNS,
    **CURVE_COLUMNS,
}
# our columns by title, for each metric of the paper
PLACE_HEADLINES: Mapping[str, Mapping[str, str]] = {
    "accuracy": {"ours": "accuracy"},
    **{
        metric: {"ours, median": f"{metric}_median", "ours, mean": f"{metric}_mean"}
        for metric in ("time", "vertices", "path_length")
    },
}
FIRST_COLUMNS = {  # columns of the first table by title
    "solved [%]": "accuracy",
    "time [s]": "time_median",
    "work": "work_median",
    "length [rad]": "path_length_median",
}
PAPER_COST_NOTE = (
    f"At the paper's cost: {1e3 * PUBLISHED_PRICES.state_check:g} ms per state check (PyBullet, "
    f"see bench paper-check), {1e3 * PUBLISHED_PRICES.projection:g} ms per projection and "
    f"{1e3 * PUBLISHED_PRICES.newton_step:g} ms per Newton step (the published constraint in "
    "Python, see docs/judgement.md); networks as measured here; goals and simplification are left "
    "out. Medians count failures as infinite; ratios are as above."
)
METHOD_NOTES = (
    "Ours: estimate [95 % interval]; in round brackets the range of all runs, if these are too few "
    "for an interval.",
    "Accuracy: number of certified paths / number of runs, Wilson interval; a path that fails its "
    "certificate is a failure.",
    "Time: total wall-clock time with goal inverse kinematics and networks, without the generation "
    "of point clouds. The median is over all runs, with failures counted as infinite "
    "(order-statistic interval). The mean, which is shown because the paper gives means, leaves "
    "failures out (bootstrap interval).",
    "Vertices: median and mean over solved runs. Path length: final path, Euclidean in joint "
    "space; raw length: path before simplification; both over the jointly solved runs.",
    "Projections, Newton iterations, state checks: medians over all runs with failures counted "
    f"as infinite; work is {WORK}. Clearances: number of states whose clearance was read from a "
    "distance field; older rows do not have it. Time, scene known: without goal inverse kinematics "
    "and without encoding the scene's cloud; scene new: with this encoding, over the runs that "
    "encoded a cloud. Times of no planner contain the construction of the checker's obstacles and "
    "distance grid, which all planners need, and of a robot's first roadmap. atlas-rrt and tb-rrt "
    "project inside OMPL's charts, where Newton iterations are counted but projections are not: "
    "their work is too low, and their steps per projection are left out.",
    f"Time / {BASELINE}: geometric mean of the ratio over problems solved by both, bootstrap "
    "interval.",
    "By fallback: runs whose path was found by another method than the named planner; they count "
    "as runs of the named planner.",
    PAPER_COST_NOTE,
    "Easy and hard: a run is hard if its problem is in the top third by the work of "
    f"{REFERENCE} with uniform samples (median over its other seeds). Ratios are geometric means "
    "over problems that both planners solved, with bootstrap intervals; time includes goal inverse "
    "kinematics, which is the same for all.",
)
GROWN_NOTE = (
    "Extension ends: number of extensions in all trees, whose ends are the states that OMPL "
    "stores, without roots, over solved runs in which a tree grew. Vertices of our search are all "
    "states along extensions. Newton steps per sample: steps of Algorithm 1 on samples, before "
    "trees extend towards them."
)
SENSED_COLUMNS: Mapping[str, Column] = {  # only for scanned scenes
    "certified_in_map": Column("certified in the map [%]", "%", share_of(solved), best="most"),
    "free_in_truth": Column(
        "of these free in truth [%]",
        "%",
        share_of(lambda row: row.true_free is True, solved),
        best="most",
    ),
    "true_clearance_median": Column(
        "clearance in truth [m]", "m", median_of("true_clearance", "stated"), best="most"
    ),
    "sense_median": Column("images to map [s]", "s", median_of("sense_time", "stated")),
    "whole_median": Column("images to certificate [s]", "s", median_of("whole_time", "stated")),
}
SENSED_NOTES = (
    "Planners get only the map. Certified in the map: certificate as in other tables. Free in "
    "truth: certificate in the true scene, with Wilson interval over the paths that are certified "
    "in the map.",
    "Images to map: time for reading depth images, intrinsics and extrinsics, and for making a "
    "map without robot and outliers. Images to certificate: time from images to the certificate in "
    "the map. Both are medians.",
    "The paper's scenes, starts and goals are not published: its numbers are for other problems, "
    "on a real robot.",
)


def place_table(
    rows: Iterable[ResultRow],
    published: Sequence[PublishedValue] = (),
    sensed: bool = False,
    own: bool = False,
) -> SuiteTable:
    """Return the paper's Table I, effort, comparisons, time curve, fallbacks, failures and notes.

    Args:
        rows: rows of one suite.
        published: the paper's numbers; without any, tables have no column for them.
        sensed: the scenes were scanned; columns of map and true scene come first.
        own: the problems are a user's: nothing is said about the paper.
    """
    runs = table.suite_runs(rows, published)
    by_rollouts = partial(_detail_begins, BY_ROLLOUTS)
    rolled = {name for name, own in runs.groups.items() if any(map(by_rollouts, own))}
    grown = any(row.n_extensions is not None for row in runs.rows)
    more = {
        **(SENSED_COLUMNS if sensed else {}),
        **(ROLLOUT_COLUMNS if rolled else {}),
        **(GROWN_COLUMNS if grown else {}),
    }
    columns = {**PLACE_COLUMNS, **more}
    found = table.entries(runs, columns, published)
    rollouts = [item for item in found if item.planner in rolled]
    slowest = max(row.t_total_s or 0.0 for row in runs.rows)
    times = list(CURVE_COLUMNS)[: sum(time < slowest for time in CURVE_TIMES) + 1]
    suite, problems = runs.rows[0].suite, len({row.problem for row in runs.rows})
    method = [note for note in METHOD_NOTES if not (own and note is PAPER_COST_NOTE)]
    footnotes = [*method, *_footnotes(runs)]
    first = _first_lines(
        found, {**FIRST_COLUMNS, "true [%]": "free_in_truth"} if sensed else FIRST_COLUMNS
    )
    headlines = {}
    for metric, ours in PLACE_HEADLINES.items():
        label = PLACE_COLUMNS[next(iter(ours.values()))].label
        if any(item.published for item in found):
            headlines[f"{label}, the paper's and ours"] = _paper_lines(found, metric, ours)
        else:
            headlines[label] = _own_lines(found, ours)
    sections: Sections = {
        f"{problems} problems": first,
        "In the map and in truth": table.column_lines(found, SENSED_COLUMNS) if sensed else [],
        **headlines,
        "Effort (medians)": table.column_lines(found, EFFORT_COLUMNS),
        "Vertices as OMPL counts them, and projections of samples": (
            table.column_lines(found, GROWN_COLUMNS) if grown else []
        ),
        "Solved by rollouts alone, without trees between their states": (
            table.column_lines(rollouts, ("accuracy", *ROLLOUT_COLUMNS)) if rollouts else []
        ),
        "At the paper's cost of work": (
            [] if own else table.column_lines(found, PAPER_COST_COLUMNS)
        ),
        f"Against {REFERENCE}": _split_lines(found, runs) if runs.split["easy"] else [],
        "Solved within a time, % of runs": table.column_lines(found, times),
        **table.counted(found),
        "Notes": [*footnotes, *([GROWN_NOTE] if grown else [])],
        "Notes on the paper's numbers (all but accuracy are means)": table.published_notes(
            runs, published
        ),
        "Notes on scanned scenes": SENSED_NOTES if sensed else [],
    }
    return SuiteTable(
        suite,
        f"{problems} {'scenes' if sensed else 'problems'}",
        found,
        sections,
        partial(table.latex_planners, found=found, metrics=PLACE_HEADLINES),
    )


def _first_lines(found: Sequence[Entry], columns: Mapping[str, str]) -> Lines:
    """Return lines of estimates, and of the work relative to uniform samples."""
    ratio = split_metric("work_ratio", "all")
    cells = [table.cells_of(found, name, _estimate) for name in columns.values()]
    planners = [item.planner for item in found]
    ratios = zip(planners, table.cells_of(found, ratio), strict=True)
    against = ["–" if planner == REFERENCE else cell for planner, cell in ratios]
    head = ["planner", *columns, Ratio(f"work / {REFERENCE}")]
    return [head, *map(list, zip(planners, *cells, against, strict=True))]


def _estimate(interval: Interval) -> str:
    """Return the number alone."""
    return number(interval.estimate)


def _paper_lines(found: Sequence[Entry], metric: str, ours: Mapping[str, str]) -> Lines:
    """Return lines of the paper's number of a metric, and of our medians and means."""
    own = [table.cells_of(found, name) for name in ours.values()]
    paper = [[item.title, item.paper_cell(metric)] for item in found]
    lines = [[*named, *cells] for named, *cells in zip(paper, *own, strict=True)]
    return [["planner", "paper", *ours], *lines]


def _own_lines(found: Sequence[Entry], ours: Mapping[str, str]) -> Lines:
    """Return lines of our medians and means, without the paper's number."""
    unit = found[0].columns[next(iter(ours.values()))].unit
    shown = "" if unit == "1" else f" [{unit}]"
    heads = [f"{title.removeprefix('ours, ').replace('ours', 'solved')}{shown}" for title in ours]
    cells = [table.cells_of(found, name) for name in ours.values()]
    planners = [item.planner for item in found]
    return [["planner", *heads], *map(list, zip(planners, *cells, strict=True))]


def _split_lines(found: Sequence[Entry], runs: SuiteRuns) -> Lines:
    """Return ratios on all, easy and hard problems for every planner except the reference."""
    lines = [["planner", "runs", *(Ratio(label) for label, _ in RATIOS.values())]]
    for item in found:
        for part in SPLIT_PARTS if item.planner != REFERENCE else ():
            cells = (item.cell(split_metric(name, part)) for name in RATIOS)
            lines.append([item.planner, f"{part} ({len(runs.split[part])})", *cells])
    return lines


def _footnotes(runs: SuiteRuns) -> Iterator[str]:
    """Yield footnotes on the rows."""
    names = ", ".join(runs.solving) or "no planner"
    yield (
        f"Jointly solved: {len(runs.joint)} runs (problem and seed), each solved by all of {names}."
    )
    silent = sorted(name for name in runs.groups if name not in runs.solving)
    if silent:
        yield f"Left out of the jointly solved set, since nothing was solved: {', '.join(silent)}."
    if len({frozenset(row.problem for row in rows) for rows in runs.groups.values()}) > 1:
        yield "The planners did not all run the same problems, so their columns cannot be compared."
    yield from table.run_notes(runs)
    if len({row.seed for row in runs.rows if row.planner == REFERENCE}) == 1:
        yield (
            f"There is one seed of {REFERENCE}: a problem on which this run was unlucky counts as "
            "hard. So the ratios of every other planner are better on hard problems, and worse on "
            "easy ones, than with several seeds."
        )


# ---------------------------------------------------------------- by group

TWO_DIGITS, THREE_DIGITS = (partial(rounded, digits=digits) for digits in (2, 3))


def _undecided(row: ResultRow) -> bool:
    return row.fail_reason is FailReason.UNDECIDED


GROUP_COLUMNS: Mapping[str, Column] = {
    "solved": Column("solved [%]", "%", share_of(solved), best="most"),
    "solved_within_1_s": Column("in 1 s [%]", "%", solved_within(1.0), best="most"),
    "solved_within_2_s": Column("in 2 s [%]", "%", solved_within(2.0), best="most"),
    "time_median": Column("time [s]", "s", median_of("time")),
    "search_median": Column("search [s]", "s", median_of("search_time")),
    "shortening_median": Column("shortening [s]", "s", median_of("simplify_time", "solved")),
    "certificate_median": Column("certificate [s]", "s", median_of("certificate_time", "solved")),
    "work_median": Column("work", "1", median_of("work")),
    **{
        name: Column(
            Ratio(f"{RATIOS[name][0]} / {REFERENCE}"), "1", ratio_to(REFERENCE, RATIOS[name][1])
        )
        for name in ("work_ratio", "own_time_ratio", "length_ratio")
    },
    # columns for executions in simulation
    "runs": Column("runs", "1", number_of(lambda _: True), cell=THREE_DIGITS, best="none"),
    "executed": Column("executed", "1", number_of(solved), cell=THREE_DIGITS, best="none"),
    "undecided": Column("undecided", "1", number_of(_undecided), cell=THREE_DIGITS, best="none"),
    "off_path_median": Column(
        "off path [mm]", "mm", median_of("off_path_mm", "stated"), cell=TWO_DIGITS, best="none"
    ),
    "off_path_most": Column(
        "most [mm]", "mm", most_of("off_path_mm"), cell=TWO_DIGITS, best="none"
    ),
    "tilt_most": Column("tilt [rad]", "rad", most_of("tilt_rad"), cell=THREE_DIGITS, best="none"),
    "with_contacts": Column(
        "contacts", "1", number_of(VALUES["contacts"]), cell=THREE_DIGITS, best="none"
    ),
    "saturated_most": Column(
        "at limits [ms]", "ms", most_of("saturated_ms"), cell=THREE_DIGITS, best="none"
    ),
    "drift_most": Column("drift [mm]", "mm", most_of("drift_mm"), cell=TWO_DIGITS, best="none"),
    "placed": Column("placed", "1", number_of(VALUES["placed"]), cell=THREE_DIGITS, best="none"),
}
RATIO_COLUMNS = ("solved", "work_ratio", "own_time_ratio", "length_ratio")
COLUMN_NOTES = {  # texts that replace {NAME} in notes
    "ratios": (
        "Solved: certified paths, Wilson interval. Ratios to uniform samples: geometric mean over "
        f"problems that both solved, bootstrap interval; work is {WORK}; time is without goal "
        "inverse kinematics."
    ),
    "medians": (
        "Solved: certified paths, Wilson intervals. Time and work: medians, failures count as "
        "infinite. Time is wall-clock time with goal inverse kinematics; a run has one thread, so "
        "that this is equal to processor time with --jobs 1 on an idle machine. "
        f"Work is {WORK}."
    ),
}


def group_table(
    rows: Iterable[ResultRow],
    published: Sequence[PublishedValue],
    *,
    what: str,
    notes: Sequence[str],
    columns: Sequence[str] = RATIO_COLUMNS,
    known: Mapping[str, Column] = GROUP_COLUMNS,
) -> SuiteTable:
    """Return a line for each group and planner, in the suite's order, then all groups together.

    Args:
        rows: rows of one suite; a problem's name holds its group, see `split_problem`.
        published: numbers of others, for a section of their own.
        what: word for a group, in the singular.
        notes: the first is about the problems, the second about the columns (it is also in the
            caption); names of `COLUMN_NOTES` in braces are replaced.
        columns: names of columns; ratios compare runs of the same group.
        known: columns by name.
    """
    runs = table.suite_runs(rows)
    ordered = sorted(
        map(split_problem, {row.problem for row in runs.rows}), key=attrgetter("number")
    )
    groups = list(dict.fromkeys(name.phase for name in ordered))
    chosen = {name: known[name] for name in columns}
    found = []
    for group in (*groups, "all"):
        for planner, own in runs.groups.items():
            part = [row for row in own if group in ("all", split_problem(row.problem).phase)]
            suffix = f"_under_{group}"
            found.append(table.entry(planner, part, runs, chosen, group=(group,), suffix=suffix))
    lines = table.group_lines(found, [what])
    size, suite = f"{len(ordered)} problems, {len(groups)} {what}s", runs.rows[0].suite
    together = table.counted([item for item in found if item.group == ("all",)])
    notes = [*(note.format(**COLUMN_NOTES) for note in notes), *table.run_notes(runs)]
    papers = [[what, "planner", "what", "value", "note"]]
    for value in published:
        number = f"{value.value} {value.unit}"
        papers.append([value.table, value.paper_name, value.metric, number, value.note])
    others = {"Published numbers, not comparable": papers} if published else {}
    return SuiteTable(
        suite,
        size,
        found,
        {f"By {what}": lines, **others, **together, "Notes": notes},
        partial(table.latex_groups, lines=lines),
    )


PEER_COLUMNS: Mapping[str, Column] = {
    "found": Column(
        "path found [%]", "%", share_of(lambda row: row.certified is not None), best="most"
    ),
    "certified": Column("certified [%]", "%", share_of(solved), best="most"),
    "wall_median": Column("time [s]", "s", median_of("wall_time")),
    "wall_ratio": Column(
        Ratio(f"time / {REFERENCE}"), "1", ratio_to(REFERENCE, VALUES["wall_time"])
    ),
    "path_length_median": Column("length [rad]", "rad", median_of("path_length", "solved")),
    "length_ratio": Column(
        Ratio(f"length / {REFERENCE}"), "1", ratio_to(REFERENCE, VALUES["path_length"])
    ),
}
PEER_NOTES = (
    "Estimate [95 % interval]. Every planner has one thread, the same convex pieces of the "
    "robot, the same obstacles and the same pairs of pieces, but its own collision checker. Models "
    "of robot and scene are loaded before the measurement.",
    "Path found: a path was returned in time. Certified: the returned path also satisfies "
    "constraint, limits and clearance between its states. Wilson intervals.",
    "Time: wall-clock time of the whole call, with shortening by the planner or by this package, "
    "without certificate. Median with order-statistic interval; runs without a certified path "
    "count as infinite.",
    f"Ratios to {REFERENCE}: geometric mean over problems that both solved, paired by problem and "
    "seed, bootstrap interval. Length: Euclidean length of certified paths in joint space.",
    "Advantages of our planners: roboplan and sscbirrt bound roll, pitch and yaw, and get a box of "
    "nine tenths of the largest one that fits into the problem's bounds at any roll; HPP keeps the "
    "hand exactly upright; the time of HPP contains its random shortcuts, the time of sscbirrt its "
    "smoothing; roboplan has no shortening that respects constraints. roboplan and sscbirrt check "
    "states 0.05 rad apart, their default; their refused paths collide.",
)


def peer_table(
    rows: Iterable[ResultRow], published: Sequence[PublishedValue], notes: Sequence[str] = ()
) -> SuiteTable:
    """Return paths, time and length of every planner, failures and notes."""
    runs = table.suite_runs(rows, published)
    suite, size = runs.rows[0].suite, f"{len({row.problem for row in runs.rows})} problems"
    found = table.entries(runs, PEER_COLUMNS)
    external = (row for row in runs.rows if row.vertices is None and row.sampler_used)
    made = sorted({f"{row.planner}: {row.sampler_used}" for row in external})
    all_notes = (*PEER_NOTES, *notes)
    sections: Sections = {
        size: table.column_lines(found, PEER_COLUMNS),
        "Failures": table.count_lines(found, table.failure),
        "Notes": [*all_notes, *made, *table.run_notes(runs)],
    }
    latex = partial(table.latex_planners, found=found, metrics={k: {"": k} for k in PEER_COLUMNS})
    return SuiteTable(suite, size, found, sections, latex)
