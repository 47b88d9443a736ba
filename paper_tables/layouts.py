"""Layouts of rows: the paper's Table I (also of scanned scenes), by group, external planners."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from operator import attrgetter

from cvqmpt_lab.paper_tables import table_engine as table
from cvqmpt_lab.paper_tables.measures import (
    NEWTON_STEP_COST,
    RATIOS,
    REFERENCE,
    RESIDUAL_COST,
    STATE_CHECK_COST,
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
from cvqmpt_lab.paper_tables.writers import Lines, Sections, number, rounded
from cvqmpt_lab.results.row import FailReason, ResultRow, split_problem
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
    "accuracy": Column("Accuracy", "%", share_of(solved), "accuracy"),
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
    "newton_steps_median": Column("steps a projection", "1", median_of("newton_steps", "stated")),
    "newton_steps_ratio": Column(
        f"steps a projection / {REFERENCE}", "1", ratio_to(REFERENCE, VALUES["newton_steps"])
    ),
    "state_checks_median": Column("state checks", "1", median_of("state_checks")),
    "work_median": Column("work", "1", median_of("work")),
    "clearances_median": Column("clearances", "1", median_of("clearances")),
    "known_time_median": Column("time, scene known [s]", "s", median_of("known_time")),
    "new_time_median": Column("time, scene new [s]", "s", median_of("new_time")),
    "time_ratio": Column(f"time / {BASELINE}", "1", ratio_to(BASELINE, VALUES["time"])),
    "fallbacks": Column("by fallback [%]", "%", share_of(lambda row: row.fallback is not None)),
}
GROWN_COLUMNS = {  # only where rows say how trees grew
    "extensions_median": Column("extension ends", "1", median_of("extensions", "solved")),
    "extensions_mean": Column("extension ends, mean", "1", mean_of("extensions", "solved")),
    "draw_newton_steps_median": Column(
        "Newton steps a draw", "1", median_of("draw_newton_steps", "stated")
    ),
    "draw_newton_steps_ratio": Column(
        f"Newton steps a draw / {REFERENCE}", "1", ratio_to(REFERENCE, VALUES["draw_newton_steps"])
    ),
}
ROLLOUT_COLUMNS = {  # only where a planner joins states of rollouts
    "rollouts_alone": Column(
        "by rollouts alone [%]", "%", share_of(partial(_detail_begins, ROLLOUTS_ALONE))
    )
}
PAPER_COST_COLUMNS = {
    "paper_cost_median": Column("time at the paper's cost [s]", "s", median_of("paper_cost")),
    **{
        f"paper_cost_ratio_{name}": Column(
            f"the same / {name}", "1", ratio_to(name, VALUES["paper_cost"])
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
    f"solved_within_{time:g}_s": Column(f"{time:g} s", "%", solved_within(time))
    for time in CURVE_TIMES
}
PLACE_COLUMNS: Mapping[str, Column] = {
    **HEADLINE_COLUMNS,
    **EFFORT_COLUMNS,
    **PAPER_COST_COLUMNS,
    **SPLIT_COLUMNS,
    **CURVE_COLUMNS,
}
PLACE_HEADLINES: Mapping[str, Mapping[str, str]] = {  # the paper's metrics, and our columns
    "accuracy": {"ours": "accuracy"},
    **{
        metric: {"ours, median": f"{metric}_median", "ours, mean": f"{metric}_mean"}
        for metric in ("time", "vertices", "path_length")
    },
}
FIRST_COLUMNS = {  # titles of the first table, and columns
    "solved [%]": "accuracy",
    "time [s]": "time_median",
    "work": "work_median",
    "length [rad]": "path_length_median",
}
METHOD_NOTES = (
    "Ours: estimate [95 % interval]; round brackets mark the whole range: too few runs for 95 %.",
    "Accuracy: certified paths / runs, Wilson interval; a path that fails its certificate is a "
    "failure.",
    "Time: total wall time, goal inverse kinematics and networks included, making point clouds "
    "not. Median over all runs with failures counted as infinite, order-statistic interval; the "
    "mean, because the paper gives means, leaves failures out (bootstrap interval).",
    "Vertices: median and mean over solved runs. Path length: final path, Euclidean in joint "
    "space; raw length: before simplification; both over the jointly solved runs.",
    "Projections, Newton iterations, state checks: medians over all runs with failures counted "
    f"as infinite; work is {WORK}. Clearances: "
    "states whose clearance was read from a distance field; rows that did not count them have "
    "none. Time, scene known: without goal "
    "inverse kinematics and without encoding the scene's cloud; scene new: with encoding it, "
    "where rows are of runs that did. Making the checker's obstacles and distance grid, as all "
    "planners need, and a roadmap for a robot that had none is in nobody's time. atlas-rrt and "
    "tb-rrt project inside OMPL's charts, where Newton iterations are counted and projections "
    "are not: their work is too low, and steps a projection (of all runs) left out.",
    f"Time / {BASELINE}: geometric mean of the ratio over problems solved by both, bootstrap "
    "interval.",
    "By fallback: runs whose path did not come the way the planner's name promises; they count "
    "as its own.",
    f"At the paper's cost: {1e3 * STATE_CHECK_COST:g} ms a state check (PyBullet, see bench "
    f"paper-check), {1e3 * RESIDUAL_COST:g} ms a projection and {1e3 * NEWTON_STEP_COST:g} ms a "
    "Newton step (the published constraint in Python, see docs/judgement.md), networks as measured "
    "here, goals and simplification left out. Median with failures as infinite; ratios as above.",
    "Easy and hard: hard are runs of problems in the top third by the work of "
    f"{REFERENCE} with uniform samples, median over its other seeds. Ratios are "
    "geometric means over problems that both solved, bootstrap intervals; time includes goal "
    "inverse kinematics, which is the same for all.",
)
GROWN_NOTE = (
    "Extension ends: ends of extensions in all trees, which is what OMPL stores; roots left out. "
    "Vertices of our search are all states along extensions. Over solved runs in which a tree "
    "grew. Newton steps a draw: Algorithm 1 on draws, before trees extend towards them."
)
SENSED_COLUMNS: Mapping[str, Column] = {  # only of scanned scenes
    "certified_in_map": Column("certified in the map [%]", "%", share_of(solved)),
    "free_in_truth": Column(
        "of these free in truth [%]", "%", share_of(lambda row: row.true_free is True, solved)
    ),
    "true_clearance_median": Column(
        "clearance in truth [m]", "m", median_of("true_clearance", "stated")
    ),
    "sense_median": Column("images to map [s]", "s", median_of("sense_time", "stated")),
    "whole_median": Column("images to certificate [s]", "s", median_of("whole_time", "stated")),
}
SENSED_NOTES = (
    "Planners know the map alone. Certified in the map: as elsewhere; free in truth: a second "
    "certificate, in the scene that was scanned, Wilson interval over the paths certified in the "
    "map.",
    "Images to map: reading depth images, intrinsics and extrinsics, removing the robot, "
    "outliers, and the rest. Images to certificate: everything until the path is certified in "
    "the map, everything counted. Medians.",
    "The paper's scenes, starts and goals are not published: its numbers are of other problems, "
    "on a real robot.",
)


def place_table(
    rows: Iterable[ResultRow], published: Sequence[PublishedValue] = (), sensed: bool = False
) -> SuiteTable:
    """Return the paper's Table I, effort, comparisons, time curve, fallbacks, failures and notes.

    sensed: the scenes were scanned; columns of map and true scene come first.
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
    footnotes = [*METHOD_NOTES, *_footnotes(runs)]
    first = _first_lines(
        found, {**FIRST_COLUMNS, "true [%]": "free_in_truth"} if sensed else FIRST_COLUMNS
    )
    papers = {
        f"{PLACE_COLUMNS[next(iter(ours.values()))].label}, the paper's and ours": (
            _paper_lines(found, metric, ours)
        )
        for metric, ours in PLACE_HEADLINES.items()
    }
    sections: Sections = {
        f"{problems} problems": first,
        "In the map and in truth": table.column_lines(found, SENSED_COLUMNS) if sensed else [],
        **papers,
        "Effort (medians)": table.column_lines(found, EFFORT_COLUMNS),
        "Vertices as OMPL counts them, and projections of draws": (
            table.column_lines(found, GROWN_COLUMNS) if grown else []
        ),
        "Solved by rollouts alone, no tree grown between their states": (
            table.column_lines(rollouts, ("accuracy", *ROLLOUT_COLUMNS)) if rollouts else []
        ),
        "At the paper's cost of work": table.column_lines(found, PAPER_COST_COLUMNS),
        f"Against {REFERENCE}": _split_lines(found, runs) if runs.split["easy"] else [],
        "Solved within a time, % of runs": table.column_lines(found, times),
        **table.counted(found),
        "Notes": [*footnotes, *([GROWN_NOTE] if grown else [])],
        "Notes on the paper's numbers (all but accuracy are means)": table.published_notes(
            runs, published
        ),
        "Notes on scanned scenes": SENSED_NOTES if sensed else [],
    }
    caption = f"{suite}, {problems} problems: the paper's values and ours. "
    caption += " ".join((*METHOD_NOTES[:4], *footnotes[len(METHOD_NOTES) :]))
    return SuiteTable(
        suite,
        f"{problems} {'scenes' if sensed else 'problems'}",
        found,
        sections,
        table.latex_planners(caption, suite, found, PLACE_HEADLINES),
    )


def _first_lines(found: Sequence[Entry], columns: Mapping[str, str]) -> Lines:
    """Return lines of estimates, and of the work over that of uniform samples."""
    ratio = split_metric("work_ratio", "all")
    lines = [["planner", *columns, f"work / {REFERENCE}"]]
    for item in found:
        estimates = [number(item.measured[name].estimate) for name in columns.values()]
        against = "–" if item.planner == REFERENCE else item.cell(ratio)
        lines.append([item.planner, *estimates, against])
    return lines


def _paper_lines(found: Sequence[Entry], metric: str, ours: Mapping[str, str]) -> Lines:
    """Return lines of the paper's number of a metric, and of our medians and means."""
    lines = [["planner", "paper", *ours]]
    for item in found:
        lines.append([item.title, item.paper_cell(metric), *map(item.cell, ours.values())])
    return lines


def _split_lines(found: Sequence[Entry], runs: SuiteRuns) -> Lines:
    """Return ratios on all, easy and hard problems for every planner except the reference."""
    lines = [["planner", "runs", *(label for label, _ in RATIOS.values())]]
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
        yield f"Solved nothing, so left out of the jointly solved set: {', '.join(silent)}."
    if len({frozenset(row.problem for row in rows) for rows in runs.groups.values()}) > 1:
        yield "The planners did not all run the same problems: their columns do not compare."
    yield from table.seed_notes(runs)
    if len({row.seed for row in runs.rows if row.planner == REFERENCE}) == 1:
        yield (
            f"One seed of {REFERENCE}: a problem on which it was unlucky counts as hard, so every "
            "other planner's ratios look better on hard problems, and worse on easy ones, than "
            "several seeds would show."
        )


# ---------------------------------------------------------------- by group

TWO_DIGITS, THREE_DIGITS = (partial(rounded, digits=digits) for digits in (2, 3))


def _undecided(row: ResultRow) -> bool:
    return row.fail_reason is FailReason.UNDECIDED


GROUP_COLUMNS: Mapping[str, Column] = {
    "solved": Column("solved [%]", "%", share_of(solved)),
    "solved_within_1_s": Column("in 1 s [%]", "%", solved_within(1.0)),
    "solved_within_2_s": Column("in 2 s [%]", "%", solved_within(2.0)),
    "time_median": Column("time [s]", "s", median_of("time")),
    "work_median": Column("work", "1", median_of("work")),
    **{
        name: Column(f"{RATIOS[name][0]} / {REFERENCE}", "1", ratio_to(REFERENCE, RATIOS[name][1]))
        for name in ("work_ratio", "own_time_ratio", "length_ratio")
    },
    # of executions in simulation
    "executed": Column("executed", "1", number_of(solved), cell=THREE_DIGITS),
    "undecided": Column("undecided", "1", number_of(_undecided), cell=THREE_DIGITS),
    "off_path_median": Column(
        "off path [mm]", "mm", median_of("off_path_mm", "stated"), cell=TWO_DIGITS
    ),
    "off_path_most": Column("most [mm]", "mm", most_of("off_path_mm"), cell=TWO_DIGITS),
    "tilt_most": Column("tilt [rad]", "rad", most_of("tilt_rad"), cell=THREE_DIGITS),
    "with_contacts": Column("contacts", "1", number_of(VALUES["contacts"]), cell=THREE_DIGITS),
    "saturated_most": Column("at limits [ms]", "ms", most_of("saturated_ms"), cell=THREE_DIGITS),
    "drift_most": Column("drift [mm]", "mm", most_of("drift_mm"), cell=TWO_DIGITS),
    "placed": Column("placed", "1", number_of(VALUES["placed"]), cell=THREE_DIGITS),
}
RATIO_COLUMNS = ("solved", "work_ratio", "own_time_ratio", "length_ratio")
COLUMN_NOTES = {  # what is put in place of {NAME} in notes
    "ratios": (
        "Solved: certified, Wilson interval. Ratios to uniform samples: geometric mean over "
        f"problems that both solved, bootstrap interval; work is {WORK}, time is without "
        "goal inverse kinematics."
    ),
    "medians": (
        "Solved: certified, Wilson intervals. Time and work: medians with failures as infinite. "
        "Time is by the clock, with goal inverse kinematics; a run has one thread, so that it is "
        f"processor time with --jobs 1 on an idle machine. Work is {WORK}."
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
        published: the paper's numbers; the paper has none of groups.
        what: a group, in the singular.
        notes: on the problems, then on the columns (in the caption, too), and others; names of
            `COLUMN_NOTES` in braces are replaced.
        columns: names of columns; ratios are within the group.
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
    notes = [note.format(**COLUMN_NOTES) for note in notes]
    return SuiteTable(
        suite,
        size,
        found,
        {f"By {what}": lines, **together, "Notes": notes},
        table.latex_groups(f"{size}. {notes[1]}", suite, lines),
    )


PEER_COLUMNS: Mapping[str, Column] = {
    "found": Column("path found [%]", "%", share_of(lambda row: row.certified is not None)),
    "certified": Column("certified [%]", "%", share_of(solved)),
    "wall_median": Column("time [s]", "s", median_of("wall_time")),
    "wall_ratio": Column(f"time / {REFERENCE}", "1", ratio_to(REFERENCE, VALUES["wall_time"])),
    "path_length_median": Column("length [rad]", "rad", median_of("path_length", "solved")),
    "length_ratio": Column(
        f"length / {REFERENCE}", "1", ratio_to(REFERENCE, VALUES["path_length"])
    ),
}
PEER_NOTES = (
    "Estimate [95 % interval]. Every planner has one thread, the same convex pieces of the "
    "robot, the same obstacles and pairs of pieces, its own collision checker; what it loads for "
    "a robot and a scene is loaded before.",
    "Path found: returned in time. Certified: as it was returned, it also keeps constraint, limits "
    "and obstacles between its states; Wilson intervals.",
    "Time: wall clock around the whole call, with shortening, ours or theirs, without certificate. "
    "Median with runs that are not certified as infinite, order-statistic interval.",
    f"Ratios to {REFERENCE}: geometric mean over problems that both solved, paired by problem and "
    "seed, bootstrap interval. Length: of certified paths, Euclidean in joint space.",
    "What favours ours: roboplan and sscbirrt bound roll, pitch and yaw, and get a box of nine "
    "tenths of what fits into the problem's bounds at any roll; HPP keeps the hand upright "
    "exactly; its time holds its random shortcuts, as sscbirrt's holds its smoothing; roboplan "
    "has no shortening that knows constraints. roboplan and sscbirrt check states 0.05 rad "
    "apart, as they are set up by their makers; their refused paths collide.",
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
    said = (*PEER_NOTES, *notes)
    sections: Sections = {
        size: table.column_lines(found, PEER_COLUMNS),
        "Failures": table.count_lines(found, table.failure),
        "Notes": [*said, *made, *table.seed_notes(runs)],
    }
    latex = table.latex_planners(" ".join(said), suite, found, {k: {"": k} for k in PEER_COLUMNS})
    return SuiteTable(suite, size, found, sections, latex)
