"""The page that says whether the paper holds, and its short form for the README, written from
committed rows.
"""

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_text
from cvqmpt_lab.results.provenance import sessions
from paper_tables.claims import Evidence, JudgedClaim, banner, evidence_below, judged_claims
from paper_tables.committed import RESULTS
from paper_tables.judging import (
    LEVEL,
    NOTHING,
    STATED_SHARE,
    Effect,
    Ruling,
    less,
    percent,
    precision,
    verdict_lines,
)
from paper_tables.measures import REFERENCE, VALUES, Rows, paired_ratio
from paper_tables.paper_numbers import PUBLISHED
from paper_tables.statements import CBIRRT, CVQ, OPT, STEPS
from paper_tables.table_engine import by_planner
from paper_tables.writers import Lines, change, markdown_table

PAGE = PUBLISHED.parent / "README.md"
README = PUBLISHED.parent.parent / "README.md"
VERDICTS = "<!-- verdicts: written by cvqmpt claims -->", "<!-- end of verdicts -->"
DECOMPOSITION = "<!-- decomposition: written by cvqmpt claims -->", "<!-- end of decomposition -->"
COMPARED = (  # label, and which of `VALUES`
    ("time [%]", "known_time"),
    ("work [%]", "work"),
    ("length [%]", "path_length"),
)
KITCHENS = ("place-task", "place-task-mirrored")
KITCHEN_PLANNERS = (CVQ, OPT, "cvq-wide", "roadmap", "roadmap-cvq", CBIRRT)
TERMS = (
    "`ompl-projected` is the paper's CBiRRT as the paper ran it: OMPL's RRTConnect on a projected "
    "space. Unless "
    "another planner is named, `opt-cvq-mpt` is judged. Whether it is better than `birrt`, the "
    "same search with "
    "uniform samples, is no claim of the paper: see *What each step brings*.",
    "*Paired*: change of the geometric mean of the ratio of two planners' values, over runs (a "
    "problem and a seed) "
    "that both solved. *Means*: change of the mean, the paper's statistic, over the same runs. "
    "Both with 95 % "
    "bootstrap intervals; a problem counts once, with all such seeds; n counts problems. A share "
    "of runs has Wilson's"
    " interval.",
    "A run that one of both failed is left out, which flatters the planner that fails more; notes "
    "under the tables "
    "count such runs.",
    f"Rules. A stated change counts as reached if {100 * STATED_SHARE:.0f} % of it is: 50 % is "
    f"tested at 45 %, "
    "two-sided, by Student's test of the logarithms and Fieller's of the means, a share by the "
    "score test. The larger"
    " of the two p counts; p is 1 where one statistic lies above the tested number and the other "
    "below. All tests of "
    f"this page are one family; Holm's procedure keeps the probability of any false verdict below "
    f"{100 * LEVEL:.0f} %. "
    "*Holds* and *does not hold* are significant; all else is *too few runs to tell*. A claim "
    "holds where it holds "
    "against every planner named, and does not where it fails against one.",
    "The tests are two-sided about one number: more runs can decide a *too few*, but not where "
    "the two statistics "
    "truly lie on different sides of it. Statements and rules were written down when the rows of "
    "the place task were "
    "known: `paper_tables/statements.py`. One rule was made stricter later: *solves 98 % in time* "
    "was tested at 90 % "
    "of 98.4 %, which CBiRRT itself passes.",
    "OMPL calls our compiled checks and projections through Python. At the prices in "
    "docs/performance.md the "
    "counted work explains about half of the search time of `ompl-projected` and a thirtieth of "
    "that of `atlas-rrt` "
    "and `tb-rrt`, but all of that of `birrt`: compare their work, too.",
    "Settings of all planners of ours were chosen in the kitchen of the place task, with the can "
    "elsewhere (problems "
    "1000 to 1059, never reported): see *A kitchen that no tuning has seen*.",
    "Where tables say *the paper's cost*, a state check in the paper's simulator is assumed to "
    "cost 3.5 ms "
    "(`cvqmpt bench paper-check` measured 3.9 ms at best and 6.3 in the median, on a busy "
    "machine); no verdict rests "
    "on it.",
)


STEPS_TEXT = (
    "Place task, paired changes with 95 % intervals: time without goal inverse kinematics and in "
    "a known scene, work "
    "(projections and state checks), path length. Negative is less. Printed by `cvqmpt claims`.\n"
)
KITCHEN_TEXT = (
    "`place-task-mirrored`: the modules of the known kitchen, measured differently and mirrored "
    "left to right; 60 "
    f"problems. Changes against `{REFERENCE}` on the same problems. Time as above: no kitchen is "
    "charged for encoding it.\n"
)


def summary_lines(claims: Iterable[JudgedClaim]) -> Lines:
    """A line a claim, with the numbers of the comparison that decides."""
    lines = [["claim", "against", "paired [%]", "means [%]", "verdict"]]
    for item in claims:
        cells = [NOTHING] * 3
        if item.deciding is not None:
            effect = item.deciding.effect
            cells = [effect.baseline, percent(effect, effect.paired), percent(effect, effect.means)]
        lines.append([item.claim.title, *cells, str(item.ruling)])
    return lines


def decomposition_lines(evidence: Evidence) -> Lines:
    """What each step from the paper's CBiRRT to our own ideas brings, paired."""
    groups = by_planner(evidence.rows, ())
    lines = [["step", "planner", "against", *(label for label, _ in COMPARED)]]
    for step, planner, against in STEPS:
        if planner in groups and against in groups:
            lines.append([step, planner, against, *_changes(groups[planner], groups[against])])
    return lines


def kitchen_lines(found: Mapping[str, Evidence]) -> Lines:
    """Every planner against the same search with uniform samples, in the known kitchen and in one
    never seen.
    """
    lines = [["planner", "kitchen", *(label for label, _ in COMPARED)]]
    for planner in KITCHEN_PLANNERS:
        for suite, word in zip(KITCHENS, ("known", "new"), strict=True):
            groups = by_planner(found[suite].rows, ())
            if planner in groups and REFERENCE in groups:
                lines.append([planner, word, *_changes(groups[planner], groups[REFERENCE])])
    return lines


def _changes(rows: Rows, baseline: Rows) -> list[str]:
    """In the columns of COMPARED."""
    return [change(less(paired_ratio(rows, baseline, VALUES[value]))) for _, value in COMPARED]


def page_text(found: Mapping[str, Evidence], claims: Sequence[JudgedClaim], root: Path) -> str:
    """The page; links go from the folder `root`."""
    parts = [
        "# Does the paper hold?\n",
        *([f"**{warned}**\n"] if (warned := banner(found)) else []),
        "Written by `cvqmpt claims` from committed rows; a test compares. *Zero-Shot Constrained "
        "Motion Planning "
        "Transformers Using Learned Sampling Dictionaries* (Johnson, Qureshi, Yip) says of "
        "CVQ-MPT and Opt-CVQ-MPT:\n",
        markdown_table(summary_lines(claims)),
        "## How to read it\n",
        "".join(f"- {line}\n" for line in TERMS),
        *(section(item) for item in claims),
    ]
    if "place-task" in found:
        parts += [
            "## What each step brings\n",
            STEPS_TEXT,
            markdown_table(decomposition_lines(found["place-task"])),
        ]
    if set(KITCHENS) <= found.keys():
        parts += [
            "## A kitchen that no tuning has seen\n",
            KITCHEN_TEXT,
            markdown_table(kitchen_lines(found)),
        ]
    used = {item.claim.suite for item in claims} | set(KITCHENS)
    parts += ["## Rows\n", "".join(made_by(found[name], root) for name in found if name in used)]
    return "\n".join(parts)


def section(item: JudgedClaim) -> str:
    """One claim: its verdict, and every statement against every baseline."""
    parts = [f"## {item.claim.title}: {item.ruling}\n"]
    parts += [" ".join(filter(None, (f"The paper: {item.claim.paper}.", item.claim.remark))) + "\n"]
    parts += [markdown_table(verdict_lines(item.verdicts))] if item.verdicts else []
    notes = "".join(_note(effect, ruled) for effect, ruled in item.verdicts)
    parts += [notes] if notes else []
    parts += [f"Rows: [{item.evidence.folder.name}](#rows).\n"] if item.evidence else []
    return "\n".join(parts)


def _note(effect: Effect, ruled: Ruling) -> str:
    """A line of what a verdict rests on, or ""."""
    known = precision(effect) if ruled is Ruling.TOO_FEW else ""
    text = "; ".join(filter(None, (known, effect.note)))
    return (
        f"- {effect.statement.planner if effect.baseline == NOTHING else effect.baseline}: {text}\n"
        if text
        else ""
    )


def made_by(evidence: Evidence, root: Path) -> str:
    """A results directory: where its rows are, its commit and wall-clock, and its commands."""
    made = sessions(evidence.record)
    commands = dict.fromkeys(shlex.join(session.get("command") or ["?"]) for session in made)
    commit = ", ".join(
        dict.fromkeys((session.get("git_commit") or "unknown")[:12] for session in made)
    )
    folder = evidence.folder.relative_to(root).as_posix()
    where = (
        f"[table]({folder}/table.md), [rows]({folder}/runs.csv)"
        if evidence.rows
        else f"[numbers]({folder}/values.csv)"
    )
    told = "".join(f"  - `{command}`\n" for command in commands)
    return f"- {evidence.folder.name}: {where}, commit {commit}, {wall_clock(evidence)}\n{told}"


def wall_clock(evidence: Evidence) -> str:
    """How long the command took; where that is not recorded, what its rows add up to."""
    seconds = [session.get("wall_s") for session in sessions(evidence.record)]
    known = [value for value in seconds if value is not None]
    if len(known) == len(seconds):
        return f"wall-clock {_minutes(sum(known))}"
    planned = sum(row.t_total_s or 0.0 for row in evidence.rows)
    return f"planning alone {_minutes(planned)}" if planned else "wall-clock not recorded"


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"


def with_part(text: str, marks: tuple[str, str], part: str) -> str:
    """A README with what stands between two marks replaced;
    InvalidInputError where it has no such marks.
    """
    begin, end = marks
    found = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
    if not found.search(text):
        raise InvalidInputError(
            f"the README has no lines {begin!r} and {end!r}; put them where the table goes"
        )
    return found.sub(lambda _: f"{begin}\n{part}{end}", text)


def committed_pages() -> dict[Path, str]:
    """The committed page and, in a checkout, the README, as their rows say that they should be."""
    found = evidence_below(RESULTS)
    claims = judged_claims(found)
    pages = {PAGE: page_text(found, claims, PAGE.parent)}
    if README.is_file():
        text = with_part(read_text(README), VERDICTS, markdown_table(summary_lines(claims)))
        steps = markdown_table(decomposition_lines(found["place-task"]))
        pages[README] = with_part(text, DECOMPOSITION, steps)
    return pages


def stale_pages(pages: dict[Path, str]) -> list[str]:
    """A line for every page that is not as it should be."""
    return [
        f"{path}: not what the rows say; write it with: cvqmpt claims --write"
        for path, text in pages.items()
        if not path.is_file() or read_text(path) != text
    ]
