"""Every claim of the paper, judged by committed rows: does it hold?"""

import csv
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from cvqmpt_lab.results.provenance import PROVENANCE_FILE, ProvenanceFile, sessions
from cvqmpt_lab.results.row import PAPER_PHASES, RUNS_FILE, read_rows
from cvqmpt_lab.results.statistics import geometric_mean_interval
from paper_tables import statements
from paper_tables.judging import NOTHING, Ruling, Verdict, judged, less, ruling
from paper_tables.measures import REFERENCE, Rows
from paper_tables.multi_sequence_table import task_rows
from paper_tables.paper_numbers import read_published
from paper_tables.statements import Statement
from paper_tables.suite_tables import table_of

HISTOGRAM_VALUES = "values.csv"
OMPL = "ompl-projected"
JUDGING = ("hour", "full")  # profiles of `cvqmpt reproduce all` with runs enough for verdicts


class Evidence(NamedTuple):
    """A results directory."""

    folder: Path
    rows: Rows  # empty for a figure
    record: dict[str, Any]  # its provenance


class Claim(NamedTuple):
    """Something that the paper says."""

    title: str  # in our words
    paper: str  # the paper's number
    statements: Mapping[str, Sequence[Statement]]  # by the results directory that judges them
    shown: Sequence[tuple[str, str]]  # metric and baseline of what stands for all in the short table
    remark: str  # what a reader must know to take the numbers rightly


class JudgedClaim(NamedTuple):
    """A claim with what rows say of it."""

    claim: Claim
    verdicts: tuple[Verdict, ...]
    evidence: tuple[Evidence, ...]
    silent: bool  # whether a directory that should judge it holds no rows of the paper's planners

    @property
    def verdict(self) -> str:
        """In words."""
        if not self.claim.statements:
            return "cannot be tested here"
        if not self.verdicts:
            return "no rows yet"
        standing = [verdict.ruling.holds for verdict in self.verdicts]
        if all(standing) and not self.silent:
            return "holds"
        if all(verdict.ruling is Ruling.TOO_FEW for verdict in self.verdicts):
            return str(Ruling.TOO_FEW)
        return "holds in part" if any(standing) else "does not hold here"


CLAIMS = (
    Claim(
        "plans twice as fast as earlier planners",
        "11.0 s, not 23.0 s",
        {"place-task": statements.FASTER},
        (("time", OMPL), ("time", REFERENCE), ("paper_cost", OMPL)),
        "A state check costs a microsecond here and milliseconds in the paper's simulator, so that networks, which "
        "cost milliseconds in both, weigh more here. The paper's cost of work charges every projection and state check "
        "what it cost there.",
    ),
    Claim(
        "plans paths 35 to 40 % shorter",
        "35 to 40 % less",
        {"place-task": statements.SHORTER},
        (("path_length", OMPL), ("path_length", REFERENCE)),
        "The paper's own table says 42 and 37 % against CBiRRT, 13 and 6 % against Atlas-RRT.",
    ),
    Claim(
        "solves 97 to 98 % of the problems",
        "97.6 and 98.4 %",
        {"place-task": statements.SOLVED},
        (("accuracy", NOTHING),),
        "The paper's planners had 50 to 100 s; how long ours had stands in the table's head.",
    ),
    Claim(
        "reduces planning time of the multi-sequence task by 45 %",
        "45 % less",
        {"multi-sequence": (statements.PLANNING_TIME,)},
        (("planning_time", OMPL),),
        "Only the last of the three phases that the paper times is constrained.",
    ),
    Claim(
        "reduces execution time of the multi-sequence task by 18 %",
        "18 % less",
        {"multi-sequence": (statements.EXECUTION_TIME,)},
        (("execution_time", OMPL),),
        "Here motions are timed under joint limits; the paper's is the wall-clock of a simulated controller.",
    ),
    Claim(
        "needs fewer vertices",
        "24 and 26, not 32 to 40",
        {"place-task": statements.FEWER},
        (("vertices", OMPL), ("vertices", REFERENCE)),
        "Our search keeps the states along an extension as vertices, OMPL's its end alone: only the comparison with "
        "birrt, the same search, is of like with like.",
    ),
    Claim(
        "updates codes so that fewer projections are needed",
        "no number",
        {"place-task": statements.UPDATE, "histogram": (statements.UPDATED,)},
        (("projections", "cvq-mpt"), ("g", statements.PREDICTED)),
        "G(q) is the squared violation of the constraint. `opt-cvq-mpt` is `cvq-mpt` with the paper's Algorithm 2, and "
        "the histogram is of the Gaussians of codes that the two sample from.",
    ),
    Claim(
        "generalises to sensor data without training",
        "10 of 10, and outperforms",
        {"sensor": (*statements.SENSED, *statements.ABOUT_SENSOR)},
        (("accuracy", NOTHING), ("true_free", NOTHING), ("time", OMPL), ("time", REFERENCE)),
        "The paper's scenes are not published: ours are rendered with the errors of a depth camera. In the paper's own "
        "table CVQ-MPT is slower than CBiRRT, and Opt-CVQ-MPT as fast.",
    ),
    Claim(
        "is probabilistically complete",
        "proved",
        {},
        (),
        "A statement about unlimited time, which no number of runs decides. The paper's argument needs samples "
        "near every vertex with a probability that is not zero; far from all Gaussians that probability is zero in "
        "floating point, so half of our samples are uniform.",
    ),
)


def judged_claims(found: Mapping[str, Evidence]) -> list[JudgedClaim]:
    """Every claim by results directories, by name; those that are missing say nothing."""
    judged_now = []
    for claim in CLAIMS:
        own = {name: found[name] for name in claim.statements if name in found}
        by_folder = [
            _judged(said, own[name]) if name in own else () for name, said in claim.statements.items()
        ]
        verdicts = tuple(verdict for verdicts in by_folder for verdict in verdicts)
        judged_now.append(JudgedClaim(claim, verdicts, tuple(own.values()), not all(by_folder)))
    return judged_now


def _judged(said: Sequence[Statement], evidence: Evidence) -> tuple[Verdict, ...]:
    if statements.UPDATED in said:
        return (_updated(evidence),)
    if not evidence.rows:
        return ()
    suite, rows = evidence.rows[0].suite, evidence.rows
    paper = table_of(suite).paper
    if suite == "multi-sequence":
        rows = task_rows(rows, PAPER_PHASES)
    return judged(said, rows, read_published(*paper) if paper else ())


def _updated(evidence: Evidence) -> Verdict:
    """G of the predicted codes after the update over that before; a problem counts once, with its geometric mean."""
    logs: dict[str, list[float]] = {}
    with (evidence.folder / HISTOGRAM_VALUES).open(encoding="utf-8", newline="") as handle:
        for line in csv.DictReader(handle):
            after, before = float(line["g_after"]), float(line["g_before"])
            if line["code"] != "goal" and after > 0.0 < before:
                logs.setdefault(line["problem"], []).append(math.log(after / before))
    ours = less(geometric_mean_interval([math.exp(fmean(codes)) for codes in logs.values()]))
    said = statements.UPDATED
    return Verdict(said, said.baselines[0], None, ours, ruling(ours, said.stated))


def profiles(found: Mapping[str, Evidence]) -> list[str]:
    """Profiles of `cvqmpt reproduce all` that made results directories, but the full ones."""
    commands = [session.get("command") or [] for item in found.values() for session in sessions(item.record)]
    named = (after for words in commands for word, after in pairwise(words) if word == "--profile")
    return [name for name in dict.fromkeys(named) if name not in JUDGING]


def banner(found: Mapping[str, Evidence]) -> str:
    """A sentence where rows are of a profile that is too small for verdicts; "" elsewhere."""
    small = profiles(found)
    if not small:
        return ""
    return (
        f"These rows are of --profile {', '.join(small)}, made to try things out: few problems, short budgets, "
        "wide intervals. Verdicts of the paper need the profile hour or full."
    )


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
