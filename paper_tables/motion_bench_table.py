"""Table of MotionBenchMaker's problems by robot, with omitted problems and published numbers."""

import math
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from cvqmpt_lab.benchmarks.results.row import FailReason, ResultRow, split_problem
from cvqmpt_lab.paper_tables.layouts import GROUP_COLUMNS, RATIO_COLUMNS, group_table
from cvqmpt_lab.paper_tables.measures import (
    REFERENCE,
    VALUES,
    Rows,
    grouped,
    mean_ratio,
    paired,
    work,
)
from cvqmpt_lab.paper_tables.statements import PublishedValue
from cvqmpt_lab.paper_tables.table_engine import SuiteTable, rows_of_one_suite
from cvqmpt_lab.paper_tables.writers import Lines, Ratio, Sections, estimate

# there is no problem to solve; a planner had no part in it
LEFT_OUT: Mapping[str, str] = {
    FailReason.INVALID_START: "start collides",
    FailReason.INVALID_GOAL: "goal collides",
    FailReason.NO_START: "no level hand at the start",
    FailReason.NO_GOAL: "no level hand at the goal",
}
BENCH_NOTES = (
    "Problems of others: MotionBenchMaker, 700 each for a Panda, a UR5 with a gripper and a Fetch, "
    "from the source archive of vamp-planner 0.6.4 (Apache-2.0), with the robots of that archive. "
    "Start and goal are single configurations.",
    "{ratios}",
    "Left out: problems whose start or goal collides in our model; in the upright suite also "
    "problems for which no level hand was found at the given position. `cvqmpt problems list` "
    "names them. All other numbers are for the remaining problems.",
    "By difficulty: ratio of `roadmap` to `birrt` on problems that both solved, in classes by the "
    "work of `birrt` in the same run. This selection favours `birrt` in the first lines, where it "
    "was lucky, and disfavours it in the last lines.",
    "Published numbers are not comparable. VAMP encloses robots in spheres, checks separate "
    "states of a motion on vector units, and reports the time of the search only; our planners "
    "check convex hulls of meshes, and every path is shortened and proven free between its "
    "states. cuRobo is an optimiser on a graphics card. Neither has constraints here, and "
    "processors differ.",
)

WORK_CLASSES = (0.0, 500.0, 2_000.0, 8_000.0, 30_000.0, math.inf)  # bounds of the work of `birrt`
BENCH_RATIOS = {"time": "own_time", "work": "work", "path length": "path_length"}


def class_lines(rows: Rows) -> Lines:
    """`roadmap` over `birrt` by the work of `birrt`, and by whether the roadmap held a path."""
    base = [row for row in rows if row.planner == REFERENCE]
    own = [row for row in rows if row.planner == "roadmap"]
    spent = {row.problem: work(row) or 0.0 for row in base}
    classes = grouped((bisect_right(WORK_CLASSES, spent.get(row.problem, 0.0)), row) for row in own)
    groups = {
        f"{WORK_CLASSES[k - 1]:g} to {WORK_CLASSES[k]:g}": classes[k] for k in sorted(classes)
    }
    groups["any, and no path through the roadmap"] = [row for row in own if row.fallback]
    lines = [["work of birrt", "problems", *(Ratio(f"{word} / birrt") for word in BENCH_RATIOS)]]
    for title, some in groups.items():
        pairs = [paired(some, base, VALUES[value]) for value in BENCH_RATIOS.values()]
        lines.append([title, str(len(pairs[0])), *(estimate(mean_ratio(item)) for item in pairs)])
    return lines


def motion_bench_table(
    rows: Iterable[ResultRow], published: Sequence[PublishedValue]
) -> SuiteTable:
    """Return a line for each robot and planner, problems left out, and published numbers."""
    ordered = rows_of_one_suite(rows)
    problems: dict[str, dict[str, str]] = defaultdict(dict)  # robot -> problem -> why left out
    for row in ordered:
        robot, why = split_problem(row.problem).phase, LEFT_OUT.get(row.fail_reason or "", "")
        problems[robot][row.problem] = why
    left_out = {name for found in problems.values() for name, why in found.items() if why}
    kept = [row for row in ordered if row.problem not in left_out]
    within = replace(GROUP_COLUMNS["solved_within_1_s"], label="within 1 s [%]")
    made = group_table(
        kept or ordered,
        published,
        what="robot",
        notes=BENCH_NOTES,
        columns=(*RATIO_COLUMNS, "time_median", "solved_within_1_s"),
        known={**GROUP_COLUMNS, "solved_within_1_s": within},
    )
    reasons = list(dict.fromkeys(LEFT_OUT.values()))
    counts: list[list[str]] = [["robot", "problems", "planned", *reasons]]
    for robot, found in problems.items():
        whys = list(found.values())
        counts.append([robot, *map(str, (len(whys), *map(whys.count, ("", *reasons))))])
    first, *rest = made.sections
    sections: Sections = {
        first: made.sections[first],
        "By how hard a problem is": class_lines(kept),
        "Problems": counts,
        **{name: made.sections[name] for name in rest},
    }
    size = f"{len(kept)} runs of {sum(map(len, problems.values())) - len(left_out)} problems"
    return replace(made, size=f"{size}, {len(left_out)} left out", sections=sections)
