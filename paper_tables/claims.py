"""Every claim of the paper, judged by committed rows: does it hold?"""

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.results.phase_name import PAPER_PHASES
from cvqmpt_lab.results.provenance import PROVENANCE_FILE, ProvenanceFile
from cvqmpt_lab.results.row import RUNS_FILE, ResultRow, read_rows
from cvqmpt_lab.results.statistics import geometric_mean_interval
from paper_tables import multi_sequence_summary as tasks
from paper_tables import place_task_statements as place
from paper_tables import sensor_render as sensor
from paper_tables.paper_numbers import PublishedValue, read_published
from paper_tables.statements import NOTHING, Statement, Verdict, judged, judged_share, less, ruling

HISTOGRAM_VALUES = "values.csv"


@dataclass(frozen=True)
class Evidence:
    """A results directory."""

    folder: Path
    rows: Sequence[ResultRow]
    """Empty for a figure."""
    record: dict[str, Any]
    """Its provenance."""


Judge = Callable[[Evidence], tuple[Verdict, ...]]


@dataclass(frozen=True)
class Claim:
    """Something that the paper says."""

    title: str
    """In our words."""
    paper: str
    """The paper's number."""
    judges: dict[str, Judge] = field(default_factory=dict)
    """By results directory; none for what runs cannot decide."""
    shown: Sequence[tuple[str, str]] = ()
    """Metric and baseline of what stands for all in the short table, of Opt-CVQ-MPT."""
    remark: str = ""
    """What a reader must know to take the numbers rightly."""


@dataclass(frozen=True)
class JudgedClaim:
    """A claim with what rows say of it."""

    claim: Claim
    verdicts: tuple[Verdict, ...]
    evidence: tuple[Evidence, ...]

    @property
    def verdict(self) -> str:
        """In words."""
        if not self.claim.judges:
            return "cannot be tested here"
        if not self.verdicts:
            return "not run"
        standing = [verdict.ruling.holds for verdict in self.verdicts]
        return "holds" if all(standing) else "holds in part" if any(standing) else "does not hold here"


def _table_one(statements: Sequence[Statement]) -> Judge:
    def judge(evidence: Evidence) -> tuple[Verdict, ...]:
        return judged(statements, evidence.rows, read_published(*PLACE), place.VALUES)

    return judge


def _table_two(metric: str) -> Judge:
    statements = [item for item in tasks.STATEMENTS if item.metric == metric]

    def judge(evidence: Evidence) -> tuple[Verdict, ...]:
        values = {time: value for time, (_, value) in tasks.TIMES.items()}
        published: Sequence[PublishedValue] = read_published(*TASKS)
        return judged(statements, tasks.task_rows(evidence.rows, PAPER_PHASES), published, values)

    return judge


def _sensed(evidence: Evidence) -> tuple[Verdict, ...]:
    """Success in the map, truth of the paths, and the paper's comparison."""
    solved = [row for row in evidence.rows if row.solved]
    shares = [
        verdict
        for planner in place.PAPERS_PLANNERS
        for what, metric, rows, counted in (
            ("solves all scenes", "accuracy", evidence.rows, attrgetter("solved")),
            ("plans paths free in truth", "true_free", solved, lambda row: row.true_free is True),
        )
        for verdict in judged_share(Statement(what, metric, 1.0, planner), rows, counted)
    ]
    published = read_published(*ROBOT)
    return (*shares, *judged(sensor.STATEMENTS, evidence.rows, published, sensor.VALUES))


def _updated(evidence: Evidence) -> tuple[Verdict, ...]:
    """G of the predicted codes before and after the update, a pair a code."""
    path = evidence.folder / HISTOGRAM_VALUES
    with path.open(encoding="utf-8", newline="") as handle:
        pairs = [(float(line["g_after"]), float(line["g_before"])) for line in csv.DictReader(handle)]
    ratios = [after / before for after, before in pairs if after > 0.0 < before]
    ours = less(geometric_mean_interval(ratios, np.random.default_rng(0)))
    statement = Statement("draws from codes with less G(q)", "g", 0.0)
    return (Verdict(statement, "the codes as predicted", None, ours, ruling(ours, 0.0)),)


PLACE, ROBOT = ("place_task.csv", "Place Task"), ("place_task.csv", "Physical robot")
TASKS = ("multi_sequence.csv", "Multi-sequence task")
OMPL, OURS = "ompl-projected", "birrt"
CLAIMS = (
    Claim(
        "plans twice as fast as earlier planners",
        "11.0 s, not 23.0 s",
        {"place-task": _table_one(place.FASTER)},
        (("time", OMPL), ("time", OURS), ("paper_cost", OMPL)),
        "A state check costs a microsecond here and milliseconds in the paper's simulator, so that networks, which "
        "cost milliseconds in both, weigh more here. The paper's cost of work prices every projection and state check "
        "as there.",
    ),
    Claim(
        "plans paths 35 to 40 % shorter",
        "35 to 40 % less",
        {"place-task": _table_one(place.SHORTER)},
        (("path_length", OMPL), ("path_length", OURS)),
        "The paper's own table says 42 and 37 % against CBiRRT, 13 and 6 % against Atlas-RRT.",
    ),
    Claim(
        "solves 97 to 98 % of the problems",
        "97.6 and 98.4 %",
        {"place-task": lambda evidence: place.solved_verdicts(evidence.rows)},
        (("accuracy", NOTHING),),
        "The paper's planners had 50 to 100 s; how long ours had stands in the table's head.",
    ),
    Claim(
        "reduces planning time of the multi-sequence task by 45 %",
        "45 % less",
        {"multi-sequence": _table_two("planning_time")},
        (("planning_time", OMPL),),
        "Only the last of the three phases that the paper times is constrained.",
    ),
    Claim(
        "reduces execution time of the multi-sequence task by 18 %",
        "18 % less",
        {"multi-sequence": _table_two("execution_time")},
        (("execution_time", OMPL),),
        "Here motions are timed under joint limits; the paper's is the wall-clock of a simulated controller.",
    ),
    Claim(
        "needs fewer vertices",
        "24 and 26, not 32 to 40",
        {"place-task": _table_one(place.FEWER)},
        (("vertices", OMPL), ("vertices", OURS)),
        "Our search keeps the states along an extension as vertices, OMPL's its end alone: only the comparison with "
        "birrt, the same search, is of like with like.",
    ),
    Claim(
        "updates codes so that fewer projections are needed",
        "no number",
        {"controls": _table_one(place.PAPERS_UPDATE), "histogram": _updated},
        (("projections", "cvq-mpt"), ("g", "the codes as predicted")),
        "G(q) is the squared violation of the constraint. The paper's update is our control `opt-algorithm-2`; what we "
        "call `opt-cvq-mpt` projects codes before it judges sequences of them. The histogram is of the Gaussians as "
        "the decoder gives them; planners sample wider ones (1.1 rad), which hardly notice the update.",
    ),
    Claim(
        "generalises to sensor data without training",
        "10 of 10, and outperforms",
        {"sensor": _sensed},
        (("accuracy", NOTHING), ("true_free", NOTHING), ("time", OMPL), ("time", OURS)),
        "The paper's scenes are not published: ours are rendered with the errors of a depth camera. In the paper's own "
        "table CVQ-MPT is slower than CBiRRT, and Opt-CVQ-MPT as fast.",
    ),
    Claim(
        "is probabilistically complete",
        "proved",
        remark="A statement about unlimited time, which no number of runs decides. The paper's argument needs samples "
        "near every vertex with a probability that is not zero; far from all Gaussians that probability is zero in "
        "floating point, so half of our samples are uniform.",
    ),
)


def judged_claims(found: Mapping[str, Evidence]) -> list[JudgedClaim]:
    """Every claim by results directories, by name; those that are missing say nothing."""
    return [
        JudgedClaim(
            claim,
            tuple(v for name, judge in claim.judges.items() if name in found for v in judge(found[name])),
            tuple(found[name] for name in claim.judges if name in found),
        )
        for claim in CLAIMS
    ]


def evidence_below(results: Path) -> dict[str, Evidence]:
    """The results directories below a folder, by name."""
    folders = sorted(path.parent for path in Path(results).glob(f"*/{PROVENANCE_FILE}"))
    return {folder.name: found for folder in folders if (found := read_evidence(folder)) is not None}


def read_evidence(folder: Path) -> Evidence | None:
    """What a results directory holds; None where there is none."""
    if not (folder / PROVENANCE_FILE).is_file():
        return None
    rows = read_rows(folder / RUNS_FILE) if (folder / RUNS_FILE).is_file() else []
    return Evidence(folder, rows, ProvenanceFile(folder).read())
