"""Judge every claim of the paper by the rows of results directories."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.paper_tables.judging import LEVEL, Verdict, Word, overall
from cvqmpt_lab.paper_tables.measures import VALUES, Pair, Rows, grouped, paired
from cvqmpt_lab.paper_tables.multi_sequence_table import task_rows
from cvqmpt_lab.paper_tables.rendering import published_of
from cvqmpt_lab.paper_tables.statements import CLAIMS, PREDICTED, Claim, PublishedValue
from cvqmpt_lab.paper_tables.writers import Lines
from cvqmpt_lab.results.provenance import PROVENANCE_FILE, ProvenanceFile, sessions
from cvqmpt_lab.results.row import PAPER_PHASES, RUNS_FILE, ResultRow, read_rows, split_problem
from cvqmpt_lab.results.statistics import problem_key


@dataclass(frozen=True, eq=False)
class Evidence:
    """A results directory."""

    folder: Path
    rows: Rows  # empty for a figure
    record: dict[str, Any]  # its provenance

    @cached_property
    def of_tasks(self) -> Rows:
        """Rows of whole tasks, with sums over the phases that the paper times."""
        return task_rows(self.rows, PAPER_PHASES)


class JudgedClaim(NamedTuple):
    """A claim and its verdicts."""

    claim: Claim
    verdicts: tuple[Verdict, ...]
    evidence: Evidence | None

    @property
    def word(self) -> Word:
        """Word for the claim, which combines the verdicts of all its comparisons."""
        return Word.UNTESTABLE if self.claim.untestable else overall(self.verdicts)

    @property
    def deciding(self) -> Verdict | None:
        """The first verdict with the word of the claim."""
        return next((verdict for verdict in self.verdicts if verdict.word is self.word), None)

    @property
    def needed(self) -> int | None:
        """Number of problems that would decide an inconclusive claim; None for another claim."""
        counts = [x.needed for x in self.verdicts if x.needed] if self.word is Word.OPEN else []
        return max(counts, default=None)


def judged_claims(found: Mapping[str, Evidence]) -> list[JudgedClaim]:
    """Judge every claim.

    Claims are inconclusive if the rows were made with a profile that is too small for verdicts.

    found: results directories by name.
    """
    large_enough, judged = not profiles(found), []
    for claim in CLAIMS:
        evidence = found.get(claim.suite)
        verdicts = () if evidence is None or claim.untestable else _verdicts(claim, evidence)
        if verdicts and claim.again in found:
            repeated = {x.comparison: x for x in _verdicts(claim, found[claim.again]) if x.pairs}
            verdicts = [repeated.get(x.comparison, x) for x in verdicts]
        own = tuple(verdict._replace(known=large_enough) for verdict in verdicts)
        judged.append(JudgedClaim(claim, own, evidence))
    return judged


def error_level() -> float:
    """Return the two-sided level of one interval: LEVEL, Bonferroni-corrected for all tests."""
    return LEVEL / sum(1 + bool(claim.again) for claim in CLAIMS if not claim.untestable)


def _verdicts(claim: Claim, evidence: Evidence) -> list[Verdict]:
    if claim.baselines == (PREDICTED,):
        return [updated_codes(claim, evidence.folder)]
    if not evidence.rows:
        return []
    suite, rows = evidence.rows[0].suite, evidence.rows
    cutoff: float | None = evidence.record["configuration"].get("cutoff_s")
    if suite in SUITES and SUITES[suite].of_tasks:
        rows = evidence.of_tasks
        cutoff = None if cutoff is None else len(PAPER_PHASES) * cutoff
    return verdicts_of(claim, rows, published_of(suite), cutoff)


def price_lines(evidence: Evidence) -> Lines:
    """Return a table of the claims at the paper's cost, with two prices of projections."""
    lines = [["planner", "against", "as published", "PyBullet's kinematics"]]
    for claim in (claim for claim in CLAIMS if claim.metric == "paper_cost"):
        priced = (replace(claim, metric=metric) for metric in ("paper_cost", "pybullet_cost"))
        for both in zip(*(_verdicts(item, evidence) for item in priced), strict=True):
            verdicts = [f"{item.interval_text(item.gain)}: {item.word}" for item in both]
            lines.append([both[0].planner, both[0].against, *verdicts])
    return lines


def verdicts_of(
    claim: Claim,
    rows: Rows,
    published: Sequence[PublishedValue] = (),
    cutoff: float | None = None,
    level: float | None = None,
) -> list[Verdict]:
    """Return a verdict for each planner of a claim that has rows, against each baseline.

    Args:
        claim: claim that is judged.
        rows: rows of one suite.
        published: the paper's numbers.
        cutoff: time limit of the runs [s]; None if they have none.
        level: two-sided error level of an interval; None: `error_level`.
    """
    own = grouped((row.planner, row) for row in rows)
    metric = claim.published or claim.metric
    numbers = {item.planner: float(item.value) for item in published if item.metric == metric}
    found = []
    for planner, baseline in product(claim.planners, claim.baselines):
        paper = None
        if planner in numbers and baseline in numbers:
            ours, other = numbers[planner], numbers[baseline]
            paper = (ours - other) / 100.0 if claim.is_share else math.log(other / ours)
        kinds = grouped((_kind(claim, row), row) for row in own.get(planner, ())) or {"": []}
        for kind, ran in kinds.items():
            against = [row for row in own.get(baseline, ()) if _kind(claim, row) == kind]
            pairs = compared(claim, ran, against, cutoff)
            probability = error_level() if level is None else level
            verdict = Verdict(claim, planner, baseline, kind, pairs, probability, paper)
            found.append(verdict._replace(failed=_failed(ran, against)))
    return found


def compared(claim: Claim, own: Rows, other: Rows, cutoff: float | None = None) -> list[Pair]:
    """Return the values of both planners on each problem; the claim says how failures count.

    Args:
        claim: its fields `metric` and `cutoff` are used.
        own: rows of the planner.
        other: rows of the baseline.
        cutoff: time limit of the runs [s]; None if they have none.
    """
    if claim.is_share:
        theirs = {problem_key(row): row.solved for row in other}
        runs = [(row, theirs.get(problem_key(row))) for row in own]
        both = [(row.problem, (float(row.solved), float(x))) for row, x in runs if x is not None]
        return [Pair(*of_it) for of_it in grouped(both).items()]
    value, limit = VALUES[claim.metric], None
    if claim.cutoff == "rows" and cutoff is not None:
        limit = cutoff
    elif isinstance(claim.cutoff, str):
        known = [value(row) for row in (*own, *other) if row.solved]
        # if no run was solved, no value can be compared: a limit of 0 leaves all runs out
        limit = max((x for x in known if x is not None), default=0.0)
    elif claim.cutoff is not None:
        limit = claim.cutoff
    return paired(own, other, value, cutoff=limit)


def _kind(claim: Claim, row: ResultRow) -> str:
    return split_problem(row.problem).phase if claim.by_kind else ""


def _failed(own: Rows, other: Rows) -> tuple[int, int, int]:
    """Count runs that both planners have: failed by the own, failed by the other, all."""
    ours = {problem_key(row): row.solved for row in own}
    theirs = {problem_key(row): row.solved for row in other}
    both = ours.keys() & theirs.keys()
    failed = [sum(not solved[key] for key in both) for solved in (ours, theirs)]
    return failed[0], failed[1], len(both)


def updated_codes(claim: Claim, folder: Path) -> Verdict:
    """Compare G of predicted codes after and before the update; each problem counts once."""
    codes = []
    with (folder / "values.csv").open(encoding="utf-8", newline="") as handle:
        for line in csv.DictReader(handle):
            after, before = float(line["g_after"]), float(line["g_before"])
            if line["code"] != "goal" and after > 0.0 < before:
                codes.append((line["problem"], (after, before)))
    pairs = [Pair(*of_it) for of_it in grouped(codes).items()]
    return Verdict(claim, claim.planners[0], PREDICTED, "", pairs, error_level(), None)


def profiles(found: Mapping[str, Evidence]) -> list[str]:
    """Return the profiles of rows that are too small for verdicts: all except "full"."""
    records = [session for item in found.values() for session in sessions(item.record)]
    words = [pair for session in records for pair in pairwise(session.get("command") or [])]
    named = dict.fromkeys(after for word, after in words if word == "--profile")
    return [name for name in named if name != "full"]


def banner(found: Mapping[str, Evidence]) -> str:
    """Return a warning if a profile of the rows is too small for verdicts, else ""."""
    small = profiles(found)
    if not small:
        return ""
    return (
        f"These rows were made with --profile {', '.join(small)}, which is a quick trial: few "
        "problems, short budgets, wide intervals. Verdicts on the paper need --profile full."
    )


def evidence_below(results: Path) -> dict[str, Evidence]:
    """Return the results directories below a folder, by name."""
    folders = sorted(path.parent for path in Path(results).glob(f"*/{PROVENANCE_FILE}"))
    return {folder.name: read_evidence(folder) for folder in folders}


def read_evidence(folder: Path) -> Evidence:
    """Return rows and provenance of a results directory."""
    rows = read_rows(folder / RUNS_FILE) if (folder / RUNS_FILE).is_file() else []
    return Evidence(folder, rows, ProvenanceFile(folder).read())
