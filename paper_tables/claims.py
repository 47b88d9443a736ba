"""Every claim of the paper, judged by results directories: does it hold?"""

import csv
from collections.abc import Mapping
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, NamedTuple

from cvqmpt_lab.results.provenance import PROVENANCE_FILE, ProvenanceFile, sessions
from cvqmpt_lab.results.row import PAPER_PHASES, RUNS_FILE, read_rows
from paper_tables.judging import Ruling, Verdict, overall, reduction, ruled, verdicts_of
from paper_tables.measures import Pair, Rows, grouped
from paper_tables.multi_sequence_table import task_rows
from paper_tables.statements import CLAIMS, PREDICTED, Claim
from paper_tables.suites import suite_of


class Evidence(NamedTuple):
    """A results directory."""

    folder: Path
    rows: Rows  # empty for a figure
    record: dict[str, Any]  # its provenance


class JudgedClaim(NamedTuple):
    """A claim and its verdicts."""

    claim: Claim
    verdicts: tuple[Verdict, ...]
    ruling: Ruling  # over all verdicts of the claim
    evidence: Evidence | None

    @property
    def deciding(self) -> Verdict | None:
        """The first verdict with the ruling of the claim."""
        return next((verdict for verdict in self.verdicts if verdict.ruling is self.ruling), None)


def judged_claims(found: Mapping[str, Evidence]) -> list[JudgedClaim]:
    """Every claim by results directories, by name; one correction for the tests of all claims.

    Rows of a profile too small for verdicts rule nothing: too few runs.
    """
    measured = [_verdicts(claim, found.get(claim.suite)) for claim in CLAIMS]
    every = [verdict for verdicts in measured for verdict in verdicts]
    if profiles(found):
        every = [verdict._replace(p=None) for verdict in every]
    rest = iter(ruled(every))
    judged = []
    for claim, verdicts in zip(CLAIMS, measured, strict=True):
        own = tuple(islice(rest, len(verdicts)))
        judged.append(JudgedClaim(claim, own, overall(own), found.get(claim.suite)))
    return judged


def _verdicts(claim: Claim, evidence: Evidence | None) -> list[Verdict]:
    if evidence is not None and claim.baselines == (PREDICTED,):
        return [updated_codes(claim, evidence.folder)]
    if evidence is None or not evidence.rows:
        return []
    suite, rows = evidence.rows[0].suite, evidence.rows
    if suite == "multi-sequence":
        rows = task_rows(rows, PAPER_PHASES)
    return verdicts_of(claim, rows, suite_of(suite).published)


def updated_codes(claim: Claim, folder: Path) -> Verdict:
    """G of the predicted codes after the update over that before; a problem counts once."""
    codes = []
    with (folder / "values.csv").open(encoding="utf-8", newline="") as handle:
        for line in csv.DictReader(handle):
            after, before = float(line["g_after"]), float(line["g_before"])
            if line["code"] != "goal" and after > 0.0 < before:
                codes.append((line["problem"], (after, before)))
    return reduction(claim, PREDICTED, [Pair(*of_it) for of_it in grouped(codes).items()])


def profiles(found: Mapping[str, Evidence]) -> list[str]:
    """Profiles of `cvqmpt reproduce all` that are too small for verdicts: all but the full one."""
    records = [session for item in found.values() for session in sessions(item.record)]
    words = [pair for session in records for pair in pairwise(session.get("command") or [])]
    named = dict.fromkeys(after for word, after in words if word == "--profile")
    return [name for name in named if name != "full"]


def banner(found: Mapping[str, Evidence]) -> str:
    """A sentence where rows are of a profile that is too small for verdicts; "" elsewhere."""
    small = profiles(found)
    if not small:
        return ""
    return (
        f"These rows are of --profile {', '.join(small)}, made to try things out: few problems, "
        "short budgets, wide intervals. Verdicts of the paper need --profile full."
    )


def evidence_below(results: Path) -> dict[str, Evidence]:
    """The results directories below a folder, by name."""
    folders = sorted(path.parent for path in Path(results).glob(f"*/{PROVENANCE_FILE}"))
    return {folder.name: read_evidence(folder) for folder in folders}


def read_evidence(folder: Path) -> Evidence:
    """Rows and provenance of a results directory."""
    rows = read_rows(folder / RUNS_FILE) if (folder / RUNS_FILE).is_file() else []
    return Evidence(folder, rows, ProvenanceFile(folder).read())
