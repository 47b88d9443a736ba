"""The suites that are reported, each declared once: planners, amounts and table.

Its problems stand under the same name in `cvqmpt_lab.benchmarks.suite`. Tables of a results
directory are written in the paper's layout: Markdown, LaTeX and csv.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from cvqmpt_lab.base.files import write_text
from cvqmpt_lab.paper_tables.factorial_table import PLANNERS as PRODUCTS
from cvqmpt_lab.paper_tables.factorial_table import factorial_table
from cvqmpt_lab.paper_tables.layouts import (
    ARM_NOTES,
    CONSTRAINT_NOTES,
    GROUP_COLUMNS,
    PEER_NOTES,
    group_table,
    peer_table,
    place_table,
)
from cvqmpt_lab.paper_tables.measures import WORK, median_of, solved_within
from cvqmpt_lab.paper_tables.motion_bench_table import motion_bench_table
from cvqmpt_lab.paper_tables.multi_sequence_table import task_table
from cvqmpt_lab.paper_tables.statements import PublishedValue, read_published
from cvqmpt_lab.paper_tables.table_engine import Column, SuiteTable, rows_of_one_suite
from cvqmpt_lab.results.provenance import ProvenanceFile, digests_in, sessions
from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.store import directory_rows

LEARNED = ("mpnet", "mpnet-bridged", "cvq-mpt", "opt-cvq-mpt", "cvq-wide", "cvq-tuned")
QUICK = ("birrt", "birrt-printed", "cells", "ompl-projected", *LEARNED, "roadmap", "roadmap-cvq")
SLOW_SPEED = ("atlas-rrt", "tb-rrt")  # most of their time goes into runs that time out
KPIECE = ("ompl-bkpiece",)
ALL = (*QUICK[:4], *SLOW_SPEED, *KPIECE, *QUICK[4:])
JUDGED = ("ompl-projected", "cvq-mpt", "opt-cvq-mpt")
SOME = ("birrt", "ompl-projected", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq")
TUNED = (*SOME, "birrt-printed", "cvq-tuned")
BENCHED = ("birrt", "roadmap", "ompl-projected")  # the last is RRTConnect where nothing is bound
UNIFORM_ROADMAPS = ("roadmap-uniform-0", "roadmap-uniform-1", "roadmap-uniform-2")
# what nothing learned gives `cvq-tuned`, and its bound
LINES = "cvq:nearest-lines+along+free-draws+reach=1"
EVERY_WAYPOINT = "cvq:transformer+decoded+every-waypoint"  # `cvq-mpt` with all goals at once
SOLVED = "cvq:solved+along+free-draws+reach=1+std=0.4"
CONTROLLED = (
    *("birrt", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq"),
    *("guided-birrt", LINES, SOLVED, *UNIFORM_ROADMAPS),
    *("roadmap-wrong-scene", "roadmap-no-scene", "roadmap-true-edges"),
)
# with the controls that say what helps in scenes of other families
FAMILY = (
    *("birrt", "birrt-printed", "cvq-mpt", "opt-cvq-mpt", "cvq-wide", "cvq-tuned"),
    *("roadmap", "roadmap-cvq", LINES, *UNIFORM_ROADMAPS),
)
FREE_NOTES = (
    "Problems 0 to 59 of the place task (kitchen), and of the seven held-out families in turn, "
    "without their constraint. opt-cvq-mpt is left out: Algorithm 2 has nothing to move codes to. "
    "cvq-mpt tries one goal after the other; birrt and birrt-printed search towards all at once.",
    CONSTRAINT_NOTES[1],
)
TWO_ARM_NOTES = (
    "A group is a robot with two arms of 7 joints and a kind of problem. The grasp is fixed: the "
    "second hand keeps its pose in the first one's frame, a closed chain. What is carried leans by "
    "at most 0.1 rad, and may touch both hands and nothing else. Starts and goals are by inverse "
    "kinematics of both hands.",
    CONSTRAINT_NOTES[1],
    "Time: total wall time, with goal inverse kinematics; median with failures as infinite.",
    "`roadmap` makes no roadmap of closed chains: trees and cells in turns. ompl-projected ran on "
    "the trays over a table of baxter alone, where its runs that fail take most of the time. "
    "Learned samplers are left out: weights are for one arm. Whether a problem has a solution "
    "is not known: both ends lie on the chain, perhaps in parts of it that are not connected.",
)
PASSAGE_NOTES = (
    "A Panda. Maze: a pen on a plane goes through three corridors of that width. Cage: an upright "
    "hand goes into a cage of bars with one gap of that width. Slot: an upright hand reaches "
    "through a slot of that width in a wall. No tuning has seen these problems.",
    "Solved: certified, Wilson intervals. Time and work: medians with failures as infinite. Time "
    "is by the clock, with goal inverse kinematics; a run has one thread, so that it is processor "
    f"time with --jobs 1 on an idle machine. Work is {WORK}.",
    "Whether a problem has a solution is not known where no planner finds one.",
)


@dataclass(frozen=True, kw_only=True)
class Amount:
    """How much of a suite a profile of `cvqmpt reproduce all` runs; several amounts add up."""

    profile: str = "full"
    problems: int | None = None  # the first ones; all when None
    seeds: int = 1
    cutoff: float = 10.0  # [s]
    planners: tuple[str, ...] | None = None  # those of the suite when None
    folder: str | None = None  # of its results; named after the suite when None
    late: bool = False  # after all amounts that are not


@dataclass(frozen=True, kw_only=True)
class Suite:
    """What is reported of a suite."""

    title: str
    planners: tuple[str, ...] = ALL  # run unless others are named
    amounts: tuple[Amount, ...] = ()
    # of its rows and the paper's numbers
    table: Callable[..., SuiteTable] = place_table
    # file in ``published`` and environment there of the paper's numbers
    paper: tuple[str, str] | None = None

    @property
    def published(self) -> tuple[PublishedValue, ...]:
        """The paper's numbers."""
        return read_published(*self.paper) if self.paper else ()


def _family(what: str, *more: Amount) -> Suite:
    full = Amount(cutoff=3.0, planners=FAMILY)
    return Suite(title=f"Held-out {what}, hand upright", amounts=(full, *more))


_PLACE = ("place_task.csv", "Place Task")
_TASKS = ("multi_sequence.csv", "Multi-sequence task")
SUITES: Mapping[str, Suite] = {
    "place-task": Suite(
        title="Place task: carry a can upright to the shelf",
        amounts=(
            Amount(seeds=5, planners=QUICK),
            Amount(problems=60, cutoff=5.0, planners=CONTROLLED, folder="controls"),
            Amount(planners=SLOW_SPEED, late=True),
            Amount(problems=30, planners=KPIECE, late=True),
            Amount(profile="small", problems=10, cutoff=2.0),
            Amount(profile="small", problems=3, cutoff=2.0, planners=CONTROLLED, folder="controls"),
        ),
        paper=_PLACE,
    ),
    "place-task-more": Suite(
        title="Place task, 2000 more problems for claims that the first ones left open",
        planners=(*JUDGED, "mpnet"),
        amounts=(Amount(late=True),),
        paper=_PLACE,
    ),
    "place-task-with-can": Suite(
        title="Place task, the carried can in the way",
        amounts=(
            Amount(planners=QUICK),
            Amount(profile="small", problems=5, cutoff=2.0, planners=SOME),
        ),
        paper=_PLACE,
    ),
    "place-task-single-goal": Suite(
        title="Place task, a single goal instead of twenty",
        amounts=(Amount(cutoff=5.0, planners=QUICK),),
    ),
    "place-task-mirrored": Suite(
        title="Place task in a kitchen that no tuning has seen",
        planners=(*TUNED, "cvq-wide", "roadmap"),
        amounts=(Amount(),),
    ),
    "family-cubes-spheres": _family("scenes of cubes and balls"),
    "family-table": _family("scenes with a table"),
    "family-shelves": _family(
        "scenes with shelves", Amount(profile="small", problems=3, cutoff=2.0, planners=SOME)
    ),
    "family-kitchen-like": _family("scenes like kitchens"),
    "family-cluttered-table": _family("tables crowded with slim things"),
    "family-narrow-shelves": _family("shelves that a hand just fits into"),
    "family-cage": _family("cages of bars"),
    "constraints": Suite(
        title="Eight kinds of constraints, zero-shot, in held-out scenes",
        planners=TUNED,
        amounts=(Amount(cutoff=5.0), Amount(profile="small", problems=8, cutoff=2.0)),
        table=group_table,
    ),
    "factorial": Suite(
        title="Factorial: every choice of a learned sampler, place task",
        planners=PRODUCTS,
        amounts=(Amount(problems=30, cutoff=3.0),),
        table=factorial_table,
    ),
    "factorial-constraints": Suite(
        title="Factorial: every choice of a learned sampler, eight kinds of constraints",
        planners=PRODUCTS,
        amounts=(Amount(problems=24, cutoff=2.0),),
        table=factorial_table,
    ),
    # no shipped weights fit the arm with the door as its eighth joint
    "open-door": Suite(
        title="Open the shelf's door, the hand on its handle",
        planners=("birrt", "ompl-projected", *SLOW_SPEED, *KPIECE, "roadmap"),
        amounts=(Amount(),),
    ),
    "passages": Suite(
        title="Narrow passages: mazes, a cage and slots",
        planners=("birrt", "cells", "roadmap"),
        amounts=(Amount(cutoff=5.0),),
        table=partial(
            group_table,
            what="passage",
            notes=PASSAGE_NOTES,
            columns={
                "solved": GROUP_COLUMNS["solved"],
                "solved_within_1_s": Column("in 1 s [%]", "%", solved_within(1.0)),
                "solved_within_2_s": Column("in 2 s [%]", "%", solved_within(2.0)),
                "time_median": Column("time [s]", "s", median_of("time")),
                "work_median": Column("work", "1", median_of("work")),
            },
        ),
    ),
    "robots": Suite(
        title="Nine arms of seven makers in held-out scenes, hand upright",
        planners=("birrt", "ompl-projected", "roadmap"),
        amounts=(Amount(cutoff=5.0), Amount(profile="small", problems=20, cutoff=2.0)),
        table=partial(group_table, what="arm", notes=ARM_NOTES),
    ),
    # the last five planners are entry points of `cvqmpt_lab.experiments.peers`, with an extra
    "peers": Suite(
        title="Planners of others, place task with a single goal",
        planners=(
            *("birrt", "roadmap", "roadmap-cvq"),
            *("roboplan", "roboplan-star", "sscbirrt", "hpp", "drake"),
        ),
        table=peer_table,
    ),
    "peers-two-arms": Suite(
        title="Planners of others, a tray in both hands with a single goal",
        planners=("birrt", "ompl-projected", "hpp"),
        table=partial(
            peer_table,
            said=(
                *PEER_NOTES[:5],
                "What favours ours: HPP keeps the tray level exactly, where the problem allows "
                "0.1 rad; its time holds its random shortcuts, which take what is left of the "
                "cut-off where they go on finding shorter ways.",
                "Ten trays over a table and ten through a window, both arms of a baxter, 14 "
                "joints. HPP was set up on problems that are not in this table.",
            ),
        ),
    ),
    # its problems are fetched: `cvqmpt problems fetch motion-bench`
    "motion-bench": Suite(
        title="MotionBenchMaker: problems of others, without a constraint",
        planners=BENCHED,
        table=motion_bench_table,
        paper=("motion_bench.csv", "MotionBenchMaker"),
    ),
    "motion-bench-upright": Suite(
        title="MotionBenchMaker: the same with a level hand",
        planners=BENCHED,
        table=motion_bench_table,
    ),
    "sensor": Suite(
        title="Scanned scenes, hand upright: planned in the map, judged in truth",
        amounts=(
            Amount(seeds=3, planners=QUICK),
            Amount(planners=SLOW_SPEED, late=True),
            Amount(profile="small", problems=2, cutoff=2.0),
        ),
        table=partial(place_table, sensed=True),
        paper=("place_task.csv", "Physical robot"),
    ),
    # not `roadmap`, which is birrt on closed chains, nor learned samplers, which are for one arm
    "two-arms": Suite(
        title="Two arms carry a tray or a box, closed chain, level",
        planners=("birrt", "cells", "roadmap", "ompl-projected"),
        amounts=(
            Amount(planners=("birrt", "cells", "roadmap")),
            # most of its runs take the whole cut-off
            Amount(problems=30, planners=("ompl-projected",)),
            Amount(profile="small", problems=4, cutoff=2.0),
        ),
        table=partial(
            group_table,
            what="group",
            notes=TWO_ARM_NOTES,
            columns={"time_median": Column("time [s]", "s", median_of("time")), **GROUP_COLUMNS},
        ),
    ),
    "unconstrained": Suite(
        title="Kitchen and held-out families without a constraint",
        planners=("birrt", "birrt-printed", "cvq-mpt", EVERY_WAYPOINT, "cvq-tuned"),
        amounts=(
            Amount(seeds=2, cutoff=3.0),
            Amount(profile="small", problems=8, cutoff=2.0),
        ),
        table=partial(group_table, what="group", notes=FREE_NOTES),
    ),
    "multi-sequence-more": Suite(
        title="Multi-sequence task, 750 more tasks for claims that the first ones left open",
        planners=JUDGED,
        amounts=(Amount(late=True),),
        table=task_table,
        paper=_TASKS,
    ),
    "multi-sequence": Suite(
        title="Multi-sequence task: open the shelf, take the can, stand it on the counter",
        amounts=(
            Amount(planners=QUICK),
            Amount(problems=16, planners=SLOW_SPEED, late=True),
            Amount(profile="small", problems=2, cutoff=2.0, planners=SOME),
        ),
        table=task_table,
        paper=_TASKS,
    ),
}


def suite_of(name: str) -> Suite:
    """What is reported of a suite; of others, such as folders, the place task's table."""
    return SUITES.get(name) or Suite(title=f"Suite {name}")


def table_of(rows: Iterable[ResultRow]) -> SuiteTable:
    """The table of rows; InvalidInputError unless they are of exactly one suite."""
    rows = rows_of_one_suite(rows)
    suite = suite_of(rows[0].suite)
    return suite.table(rows, suite.published)


class Rendered(NamedTuple):
    """Tables of a results directory by the file's name, and lines for the terminal."""

    texts: dict[str, str]
    brief: list[str]


def rendered_tables(directory: Path) -> Rendered:
    """``table.md``, ``.tex`` and ``.csv`` of rows of one suite.

    InvalidInputError: no readable runs with provenance.
    """
    rows = directory_rows(directory)
    record = ProvenanceFile(directory).read()
    made, head = table_of(rows), _head(record, len(rows))
    title = suite_of(made.suite).title
    texts = {
        "table.md": f"# {title}\n\n{head}\n\n{made.markdown}",
        "table.tex": f"% {head}\n{made.latex}",
        "table.csv": made.csv,
    }
    return Rendered(texts, [f"{title}: {made.size}, {_cutoffs(record)}", *made.brief])


def render_directory(directory: Path) -> Rendered:
    """Write `rendered_tables` beside ``runs.csv``."""
    made = rendered_tables(directory)
    for name, text in made.texts.items():
        write_text(directory / name, text)
    return made


def _head(record: Mapping[str, Any], n_runs: int) -> str:
    """One line: cut-off, commits, models, machines, dates and the number of rows."""
    made = sessions(record)
    models = [
        f"{name} {digest[:12]}" for name, digest in sorted(digests_in(record, "weights").items())
    ]
    commits = [
        (session.get("git_commit") or "unknown")[:12]
        + (" WITH UNCOMMITTED CHANGES" if session.get("git_dirty") else "")
        for session in made
    ]
    machines = [
        f"{s.get('cpu_model') or 'unknown'}, {s.get('cpu_count') or '?'} cores" for s in made
    ]
    return " · ".join(
        [
            _cutoffs(record),
            f"commit {_distinct(commits)}",
            *([f"weights {_distinct(models)}"] if models else []),
            f"machine {_distinct(machines)}",
            f"date {_distinct(str(s.get('date_utc') or 'unknown') for s in made)}",
            f"{n_runs} rows",
        ]
    )


def _cutoffs(record: Mapping[str, Any]) -> str:
    """The budget of a run."""
    configuration = record["configuration"]
    seconds, iterations = configuration.get("cutoff_s"), configuration.get("iterations")
    limits = [f"cutoff {seconds:g} s"] if seconds else []
    limits += [f"{iterations} iterations"] if iterations else []
    return ", ".join(limits) or "cutoff not recorded"


def _distinct(texts: Iterable[str]) -> str:
    return " and ".join(dict.fromkeys(texts))
