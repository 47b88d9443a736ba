"""The page that says whether the paper holds, and its short form for the README, written from committed rows."""

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_text
from cvqmpt_lab.results.provenance import sessions
from paper_tables.claims import Evidence, JudgedClaim, banner, evidence_below, judged_claims
from paper_tables.committed import RESULTS
from paper_tables.judging import NOTHING, PRECISION, Verdict, less, statement_lines
from paper_tables.measures import VALUES, fraction, paired_ratio, solved
from paper_tables.paper_numbers import PUBLISHED, read_published
from paper_tables.table_engine import by_planner
from paper_tables.writers import Lines, change, estimate, markdown_table

PAGE = PUBLISHED.parent / "README.md"
README = PUBLISHED.parent.parent / "README.md"
BEGIN, END = "<!-- verdicts: written by cvqmpt claims -->", "<!-- end of verdicts -->"
SHOWN_PLANNER = "opt-cvq-mpt"
WORDS = {
    "time": "time",
    "paper_cost": "time at the paper's cost",
    "path_length": "length",
    "planning_time": "time",
    "execution_time": "time",
    "g": "G",
    "accuracy": "solved",
    "true_free": "free in truth",
}
COMPARED = (  # label, baseline, and which of `VALUES`
    ("time", "ompl-projected", "time"),
    ("time at the paper's cost", "ompl-projected", "paper_cost"),
    ("path length", "ompl-projected", "path_length"),
    ("time without goals", "birrt", "own_time"),
    ("work", "birrt", "work"),
    ("time at the paper's cost", "birrt", "paper_cost"),
    ("path length", "birrt", "path_length"),
)
TERMS = (
    "`ompl-projected` is the paper's CBiRRT as the paper ran it: OMPL's RRTConnect on a projected space. `birrt` is "
    "our own search (the paper's Algorithm 3) with uniform samples, the same search that `cvq-mpt` and `opt-cvq-mpt` "
    "use.",
    "A change is the geometric mean, over problems that both planners solved, of how much more or less, with a 95 % "
    "bootstrap interval; n counts problems. Shares have Wilson intervals.",
    "*Work*: projections and state checks. *The paper's cost of work*: the same counts at 3.5 ms a state check "
    "and 0.02 ms a projection, as in the paper's simulator, plus networks as measured here.",
    f"An interval wider than {100 * PRECISION:.0f} points that contains the stated number, or zero, says *too few runs "
    "to tell*.",
    "A claim *holds* where every statement below it is confirmed or compatible, *in part* where some are, or where "
    "rows for some are missing. *No rows yet*: the paper's planners have not been run there since they changed.",
)


def shown(judged: JudgedClaim) -> list[Verdict]:
    """What stands for all verdicts on a claim in the short table."""
    return [
        verdict
        for metric, baseline in judged.claim.shown
        for verdict in judged.verdicts
        if (verdict.statement.metric, verdict.baseline) == (metric, baseline)
        and verdict.statement.planner == SHOWN_PLANNER
    ]


def _in_words(verdict: Verdict) -> str:
    word = WORDS.get(verdict.statement.metric, verdict.statement.metric)
    if verdict.baseline == NOTHING:
        return f"{estimate(verdict.ours.scaled(100.0))} % {word}"
    against = f"`{verdict.baseline}`" if " " not in verdict.baseline else verdict.baseline
    return f"{word} {change(verdict.ours)} % against {against}"


def summary_lines(claims: Iterable[JudgedClaim]) -> Lines:
    """A line a claim."""
    lines = [["CVQ-MPT …", "paper", "here, Opt-CVQ-MPT [95 % interval]", "n", "verdict"]]
    for item in claims:
        verdicts = shown(item)
        sizes = "; ".join(dict.fromkeys(str(verdict.ours.n) for verdict in verdicts)) or NOTHING
        here = "; ".join(map(_in_words, verdicts)) or NOTHING
        lines.append([item.claim.title, item.claim.paper, here, sizes, f"**{item.verdict}**"])
    return lines


def page_text(found: Mapping[str, Evidence], claims: Sequence[JudgedClaim], root: Path) -> str:
    """The page; links go from the folder `root`."""
    parts = [
        "# Does the paper hold?\n",
        *([f"**{warned}**\n"] if (warned := banner(found)) else []),
        "Written by `cvqmpt claims` from committed rows; a test compares. *Zero-Shot Constrained Motion Planning "
        "Transformers Using Learned Sampling Dictionaries* (Johnson, Qureshi, Yip) says that CVQ-MPT …\n",
        markdown_table(summary_lines(claims)),
        "## How to read it\n",
        "".join(f"- {line}\n" for line in TERMS),
        *(section(item, root) for item in claims),
    ]
    if "place-task" in found:
        lines = comparison_lines(found["place-task"])
        parts += ["## Every planner by the same measures, place task\n", markdown_table(lines)]
    return "\n".join(parts)


def section(item: JudgedClaim, root: Path) -> str:
    """One claim: its verdict, every statement against every baseline, and what makes the numbers."""
    parts = [f"## CVQ-MPT {item.claim.title}: {item.verdict}\n"]
    parts += [f"The paper: {item.claim.paper}. {item.claim.remark}\n"]
    parts += [markdown_table(statement_lines(item.verdicts))] if item.verdicts else []
    parts += [made_by(evidence, root) for evidence in item.evidence]
    return "\n".join(parts)


def made_by(evidence: Evidence, root: Path) -> str:
    """The command of a results directory, its wall-clock, and where its rows are."""
    made = sessions(evidence.record)
    commands = dict.fromkeys(shlex.join(session.get("command") or ["?"]) for session in made)
    commit = ", ".join(dict.fromkeys((session.get("git_commit") or "unknown")[:12] for session in made))
    folder = evidence.folder.relative_to(root).as_posix()
    where = (
        f"[table]({folder}/table.md), [rows]({folder}/runs.csv)"
        if evidence.rows
        else f"[numbers]({folder}/values.csv)"
    )
    return f"`{'` and `'.join(commands)}`: {wall_clock(evidence)}, commit {commit}; {where}\n"


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


def comparison_lines(evidence: Evidence) -> Lines:
    """Every planner that was run, as changes against the paper's baseline and the same search."""
    groups = by_planner(evidence.rows, read_published("place_task.csv", "Place Task"))
    lines = [["planner", "runs", "solved [%]", *(f"{what} [%] against {whom}" for what, whom, _ in COMPARED)]]
    for name, rows in groups.items():
        line = [name, str(len(rows)), estimate(fraction(rows, solved).scaled(100))]
        for _, whom, value in COMPARED:
            ratio = paired_ratio(rows, groups.get(whom, ()), VALUES[value])
            line.append(NOTHING if whom == name else change(less(ratio)))
        lines.append(line)
    return lines


def with_summary(text: str, summary: str) -> str:
    """A README with its short table replaced; InvalidInputError where it has none."""
    found = re.compile(f"{re.escape(BEGIN)}.*?{re.escape(END)}", re.DOTALL)
    if not found.search(text):
        raise InvalidInputError(
            f"the README has no lines {BEGIN!r} and {END!r}; put them where the verdicts go"
        )
    return found.sub(lambda _: summary, text)


def committed_pages() -> dict[Path, str]:
    """The committed page and, in a checkout, the README, as their rows say that they should be."""
    found = evidence_below(RESULTS)
    claims = judged_claims(found)
    pages = {PAGE: page_text(found, claims, PAGE.parent)}
    if README.is_file():
        summary = markdown_table(summary_lines(claims))
        pages[README] = with_summary(read_text(README), f"{BEGIN}\n{summary}{END}")
    return pages


def stale_pages(pages: dict[Path, str]) -> list[str]:
    """A line for every page that is not as it should be."""
    return [
        f"{path}: not what the rows say; write it with: cvqmpt claims --write"
        for path, text in pages.items()
        if not path.is_file() or read_text(path) != text
    ]
