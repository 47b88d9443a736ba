"""Pages about results: the page of claims, the README's blocks and the html report.

Texts are in `templates/`; texts about claims are in `published/claims.toml`.
"""

import base64
import json
import re
import shlex
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.results.provenance import PROVENANCE_FILE, digests_in, sessions
from cvqmpt_lab.benchmarks.results.row import ResultRow
from cvqmpt_lab.paper_tables.answer import answer_parts, whole_word
from cvqmpt_lab.paper_tables.beside import Judged, beside_lines, explained, repeated
from cvqmpt_lab.paper_tables.bootstrap import DRAWS
from cvqmpt_lab.paper_tables.claims import (
    Comparison,
    JudgedClaim,
    judged_claims,
    mechanism_lines,
    points,
    sentence_level,
    task_lines,
    transfer_lines,
)
from cvqmpt_lab.paper_tables.evidence import Evidence, banner, evidence_below, read_evidence
from cvqmpt_lab.paper_tables.failures import failure_lines
from cvqmpt_lab.paper_tables.measures import (
    PUBLISHED_PRICES,
    REFERENCE,
    VALUES,
    WORK,
    Rows,
    grouped,
    work,
)
from cvqmpt_lab.paper_tables.quoted import Quoted, clear
from cvqmpt_lab.paper_tables.rendering import published_of, table_of, title_of
from cvqmpt_lab.paper_tables.rule import Word
from cvqmpt_lab.paper_tables.statements import CLAIMS, PUBLISHED, READING
from cvqmpt_lab.paper_tables.table_engine import by_planner, goalless_text
from cvqmpt_lab.paper_tables.writers import BOLD, Lines, Ratio, estimate, markdown_tables

PAGE = PUBLISHED.parent / "README.md"
OWN_PAGE, OWN_PICTURE = "claims.md", "claims.png"  # of own rows, in their folder
TABLE_I = "place-task-ompl"
PAPER_TABLES = {  # titles of the paper's tables on the page of claims, by results directory
    TABLE_I: "Table I, place task",
    "place-task-ompl-more": "The same, second sample",
    "place-task-published": "The same in the direction of the published code",
    "sensor-ompl": "Table I, sensed scenes",
    "sensor-ompl-more": "Sensed scenes, second sample",
    "multi-sequence-published": "Table II, multi-sequence task",
}
CHEAP = "if projections are cheap"  # title of the column
LINK = re.compile(r"\[([^]]+)\]\([^)]*\)")  # of markdown
REPORT_COLUMNS = (
    "problem",
    "seed",
    "solved",
    "time [s]",
    "work",
    "vertices",
    "length [rad]",
    "what",
)

SHOWN_FACTS = (  # facts of a session that the report shows
    "command", "git_commit", "git_dirty", "date_utc", "cpu_model", "cpu_count", "platform",
    "python", "weights", "versions",
)  # fmt: skip


def rendered(template: str, **data: Any) -> str:
    """Render a template of `templates/` with data; in html, text from rows is escaped."""
    html = template.endswith(".html.j2")
    environment = Environment(
        loader=PackageLoader("cvqmpt_lab.paper_tables", "templates"),
        autoescape=html,
        undefined=StrictUndefined,
        trim_blocks=not html,
        keep_trailing_newline=not html,
    )
    environment.filters |= {
        "table": markdown_tables,
        "comparisons": comparison_lines,
        "td": html_cell,
        "clear": clear,
    }
    return environment.get_template(template).render(**data)


def html_cell(text: str, head: str) -> str:
    """Return the html of a cell of a table: the best value bold, ratios coloured by their interval.

    head: title of the column.
    """
    shown = BOLD.sub(r"<b>\1</b>", escape(text))
    found = re.fullmatch(r"(\S+) ([\[(]([\d.∞]+), ([\d.∞]+)[\])])", shown)
    if found is None:
        return f"<td>{shown}</td>"
    value, interval, low, high = found.groups()
    kind = ""
    if isinstance(head, Ratio) and interval[0] == "[" and "∞" not in interval:
        kind = "less" if float(high) < 1.0 else "more" if float(low) > 1.0 else ""
    return f"<td{f' class={kind}' if kind else ''}>{value}<small>{interval}</small></td>"


def reading(links: bool = True) -> list[str]:
    """Return explanations of verdicts, one for each item of a list.

    links: whether to keep links, which are relative to the page of claims, or their text alone.
    """
    numbers = {
        "sentences": sum(not claim.untestable for claim in CLAIMS),
        "draws": f"{DRAWS:,}".replace(",", " "),
        "check": 1e3 * PUBLISHED_PRICES.state_check,
        "residual": 1e3 * PUBLISHED_PRICES.projection,
        "step": 1e3 * PUBLISHED_PRICES.newton_step,
    }
    lines = [line.format(**numbers) for line in READING]
    return lines if links else [LINK.sub(r"\1", line) for line in lines]


# ---------------------------------------------------------------- the page of claims


def summary_lines(claims: Iterable[JudgedClaim]) -> Lines:
    """Return a line for each claim: its first comparison, its word, and what would decide it."""
    lines = [["claim", "first comparison", "paper", "here", "verdict", CHEAP, "to decide"]]
    for item in claims:
        cells, cheap = ["–"] * 3, "–"
        if item.comparisons:
            first = item.comparisons[0]
            cells = [f"{first.planner} / {first.baseline}", *first.cells[:2]]
            cheap = cheap_text(first)
        lines.append([item.claim.title, *cells, item.word, cheap, item.to_decide])
    return lines


def cheap_text(item: Comparison) -> str:
    """Return the ratio and the word at the prices of PyBullet's kinematics; "–": not a time."""
    return f"{estimate(item.pybullet[0].means)}, {item.pybullet[1]}" if item.pybullet else "–"


def comparison_lines(comparisons: Iterable[Comparison]) -> Lines:
    """Return a line for each comparison of a claim, with the words for other prices."""
    lines = [
        ["planner", "against", "paper", "here", "geometric mean", "problems", "failed", "word"]
        + ["within the same time, at worst", "word with slower networks"]
        + [CHEAP, "to decide"]
    ]
    for item in comparisons:
        first = next(iter(item.words.values()), item.word)  # with networks that cost nothing
        others = [f"{name}: {word}" for name, word in item.words.items() if word is not first]
        others = [str(first), *others] if others else []
        *numbers, word = item.cells
        lines.append(
            [item.planner, item.baseline, *numbers, str(item.count), "{} / {}".format(*item.failed)]
            + [word, within_text(item), "; ".join(others) or "–", cheap_text(item)]
            + [item.to_decide]
        )
    return lines


def within_text(item: Comparison) -> str:
    """Return the difference of solved shares at the time that is least favourable."""
    return f"{points(item.within.gain)} at {item.within.time:.0f} s" if item.within else "–"


def answer_text(
    found: Mapping[str, Evidence],
    claims: Sequence[JudgedClaim],
    docs: str,
    page: str,
) -> str:
    """Return the answer in one line, the picture and three paragraphs.

    Args:
        found: committed results directories by name.
        claims: claims judged by them.
        docs: where the page that gets the text finds the folder of docs, such as "docs/".
        page: the same for the page of claims.
    """
    parts = answer_parts(claims)
    return rendered(
        "answer.md.j2",
        quoted=Quoted(found),
        answer=parts,
        whole=whole_word(parts),
        claims=claims,
        count=counted(claims),
        docs=docs,
        page=page,
    )


def counted(claims: Sequence[JudgedClaim]) -> str:
    """Return the number of claims for each word, such as "3 replicated, 1 opposite"."""
    count = Counter(item.word for item in claims)
    order = sorted(count, key=lambda text: [*Word].index(Word(text.partition(" or ")[0])))
    return ", ".join(f"{count[word]} {word}" for word in order)


def page_text(
    found: Mapping[str, Evidence],
    claims: Sequence[JudgedClaim],
    root: Path,
    committed: Judged | None = None,
) -> str:
    """Return the page of claims.

    Args:
        found: results directories by name.
        claims: claims judged by them.
        root: folder of the page, to which its links are relative.
        committed: for own rows: the committed ones, with which the page begins.
    """
    used = {name for item in claims for name in item.claim.suites}
    used |= {*PAPER_TABLES, "place-task-seconds", "histogram"}
    return rendered(
        "claims.md.j2",
        banner=banner(found),
        answer=answer_text(found, claims, "../docs/", "#the-papers-sentences")
        if root == PAGE.parent
        else "",
        own=own_part(found, claims, committed) if committed else {},
        count=counted(claims),
        summary=summary_lines(claims),
        level=100.0 * (1.0 - sentence_level()),
        reading=reading(links=root == PAGE.parent),
        claims=claims,
        tables={
            title: paper_tables(found[name])
            for name, title in PAPER_TABLES.items()
            if name in found
        },
        failures={
            item.claim.title: failure_lines(item.claim, item.evidence[0], sentence_level())
            for item in claims
            if item.comparisons and item.claim.answers == "Time"
        },
        transfer=transfer_lines(found["place-task-seconds"])
        if "place-task-seconds" in found
        else [],
        mechanisms=mechanism_lines(found),
        results=[_made_by(item, root) for name, item in found.items() if name in used],
    )


def own_part(
    found: Mapping[str, Evidence], claims: Sequence[JudgedClaim], committed: Judged
) -> dict[str, Any]:
    """Return what a page of own rows begins with: lines of a table, words, and the picture."""
    return {
        "lines": beside_lines(claims, committed.claims),
        "words": list(filter(None, (explained(claims), repeated(found, committed.found)))),
        "picture": forest_of(claims, committed),
    }


def forest_of(claims: Sequence[JudgedClaim], committed: Judged | None) -> bytes:
    """Return the picture of claims, beside the committed ones if given, as png; b"" if empty."""
    if not any(item.effect and item.shown for claim in claims for item in claim.comparisons[:1]):
        return b""
    from cvqmpt_lab.paper_tables import plots  # matplotlib takes a second to import

    return plots.forest(claims, committed.claims if committed else ())


def paper_tables(evidence: Evidence) -> tuple[Lines, Lines]:
    """Return the paper's table beside these rows, and their numbers by the rule (not of tasks)."""
    if SUITES[evidence.rows[0].suite].of_tasks:
        return task_lines(evidence), []
    sections = table_of(evidence.rows).sections
    paper, by_rule = (
        next(lines for title, lines in sections.items() if title.startswith(start))
        for start in ("The paper's", "Table I by the rule")
    )
    return paper, by_rule


def _made_by(evidence: Evidence, root: Path) -> dict[str, Any]:
    """Return links to the rows of a results directory, its commit, time and commands."""
    made = sessions(evidence.record)
    facts = [(x.get("git_commit") or "unknown", x.get("date_utc") or "no date") for x in made]
    commits = dict.fromkeys(f"{commit[:12]} ({date[:10]})" for commit, date in facts)
    folder = evidence.folder.relative_to(root).as_posix()
    files = f"[numbers]({folder}/values.csv)"
    if evidence.rows:
        files = f"[table]({folder}/table.md), [rows]({folder}/runs.csv)"
    return {
        "name": evidence.folder.name,
        "files": files,
        "commit": ", ".join(commits),
        "time": wall_clock(evidence),
        "commands": dict.fromkeys(shlex.join(session.get("command") or ["?"]) for session in made),
    }


def wall_clock(evidence: Evidence) -> str:
    """Return the wall-clock time of a results directory; if unknown, the sum over its rows."""
    known = [session.get("wall_s") for session in sessions(evidence.record)]
    what, seconds = "wall-clock", sum(value or 0.0 for value in known)
    if None in known:
        what, seconds = "planning alone", sum(row.t_total_s or 0.0 for row in evidence.rows)
        if not seconds:
            return "wall-clock not recorded"
    return f"{what} {seconds:.0f} s" if seconds < 90.0 else f"{what} {seconds / 60.0:.0f} min"


# ---------------------------------------------------------------- the html report


def report_html(
    found: Mapping[str, Evidence],
    report: Callable[[int, int], None] = lambda done, total: None,
    paths: Mapping[str, Mapping[str, str]] | None = None,
    title: str = "CVQ-MPT, reproduced",
    verdicts: bool = True,
    committed: Judged | None = None,
) -> str:
    """Return one self-contained html file about results directories.

    Args:
        found: results directories by name, see `evidence_of`.
        report: called with the number of finished directories and the number of all.
        paths: title and html of a path in 3-D, by the name of its directory.
        title: title of the page.
        verdicts: whether to judge the paper's claims by these rows.
        committed: for own rows: the committed ones, which stand beside them.
    """
    claims = judged_claims(found) if verdicts else []
    if not any(item.comparisons for item in claims):
        claims = []
    own = own_part(found, claims, committed) if claims and committed else {}
    picture = own["picture"] if own else forest_of(claims, None)
    sections: list[dict[str, Any]] = []
    for evidence in found.values():
        report(len(sections), len(found))
        sections.append({**section_of(evidence), "path": (paths or {}).get(evidence.folder.name)})
    report(len(found), len(found))
    kept = ("name", "rows", "again", "path", "scatter")
    data = [{key: section[key] for key in kept} for section in sections]
    text = json.dumps({"columns": REPORT_COLUMNS, "sections": data}, separators=(",", ":"))
    return rendered(
        "report.html.j2",
        title=title,
        # rows of a user's own problems say nothing about the paper
        alone=not verdicts and any(row.suite in SUITES for x in found.values() for row in x.rows),
        banner=banner(found),
        claims=own.get("lines") or (summary_lines(claims) if claims else []),
        own=own,
        picture=data_address(picture, "image/png") if picture else "",
        styles={str(Word.REPLICATED): "holds", str(Word.SAME): "not", str(Word.OPPOSITE): "not"},
        untested=[str(Word.NO_ROWS), str(Word.UNTESTABLE)],
        reading=reading(links=False),
        sections=sections,
        # input of the page's script, which inflates it
        data=base64.b64encode(zlib.compress(text.encode(), 9)).decode("ascii"),
    )


def evidence_of(directory: Path) -> dict[str, Evidence]:
    """Return one results directory by suite, or all below a folder by name, place task first."""
    if (directory / PROVENANCE_FILE).is_file():
        single = read_evidence(directory)
        return {single.rows[0].suite if single.rows else directory.name: single}
    found = evidence_below(directory)
    if not found:
        raise InvalidInputError(
            f"{directory} is not a results directory and contains none; make one with: cvqmpt "
            f"reproduce place-task --out {directory}"
        )
    return dict(sorted(found.items(), key=lambda item: (item[0] != "place-task", item[0])))


def section_of(evidence: Evidence) -> dict[str, Any]:
    """Return the data of the report's section on a results directory."""
    from cvqmpt_lab.paper_tables import plots  # matplotlib takes a second to import

    rows, name = evidence.rows, evidence.folder.name
    suite = rows[0].suite if rows else name
    title = title_of(suite) if rows else f"Figure {name}"
    groups = by_planner(rows, published_of(suite))
    filed = digests_in(evidence.record, "problem_files")
    problem = "FILE" if filed else f"{suite} --problem PROBLEM"
    return {
        "name": name,
        "title": title if name == suite else f"{name}: {title}",
        "blocks": [block for block in table_of(rows).sections.items() if block[1]] if rows else [],
        "planners": list(groups),
        "plots": _plots(groups) if rows else {},
        # html colours of planners in the plots
        "colours": {name: plots.line_style(name)["color"] for name in groups},
        "rows": {planner: [_row(row) for row in own] for planner, own in groups.items()},
        "note": goalless_text(rows),
        "published": bool(published_of(suite)),
        "scatter": scatter_choice(list(groups)),
        # the command that repeats a row
        "again": f"cvqmpt plan {problem} --planner PLANNER --seed SEED --picture plan.png",
        "provenance": _provenance(evidence),
        "pictures": _pictures(evidence.folder),
    }


def scatter_choice(planners: Sequence[str]) -> list[str]:
    """Return the two planners, A and B, that a scatter plot compares first; [] if there is one.

    A is a user's planner if there is one, B the reference of ratios.
    """
    from cvqmpt_lab.paper_tables.plots import is_own

    first = [name for name in planners if is_own(name)] + [x for x in planners if x != REFERENCE]
    others = [name for name in (REFERENCE, *planners) if name in planners]
    pairs = [(a, b) for a in first for b in others if a != b]
    return list(pairs[0]) if pairs else []


def _plots(groups: Mapping[str, Rows]) -> dict[str, dict[str, str]]:
    """Return plots of rows by title, as svg with a caption, without plots that have no values."""
    from cvqmpt_lab.paper_tables import charts

    length = VALUES["path_length"]
    timed = any(row.t_total_s is not None for rows in groups.values() for row in rows)
    boxes = "Boxes contain the middle half of the runs, their line is the median; whiskers: 90 %."
    drawn = {
        "Solved against time": {
            "svg": charts.solved_within(groups) if timed else "",
            "words": "One line per planner; higher and further left is better.",
        },
        "Work, solved runs": {
            "svg": charts.distribution(groups, work, f"work: {WORK}"),
            "words": f"{boxes} Further left is less work.",
        },
        "Path length, solved runs": {
            "svg": charts.distribution(groups, length, "length [rad]", log=False),
            "words": f"{boxes} Further left is shorter.",
        },
        "Time by stage": {
            "svg": charts.stage_times(groups) if timed else "",
            "words": "One bar per planner, one colour per stage of planning.",
        },
    }
    return {title: plot for title, plot in drawn.items() if plot["svg"]}


def _row(row: ResultRow) -> list[object]:
    """Return the cells of `REPORT_COLUMNS` for a row."""
    what = row.fallback or row.detail or ""
    if row.fail_reason is not None:
        what = f"{row.fail_reason.shown}: {row.detail or ''}"
    numbers = (row.t_total_s, work(row), row.path_length_rad)
    time, effort, length = (None if number is None else round(number, 4) for number in numbers)
    return [row.problem, row.seed, row.solved, time, effort, row.vertices, length, what]


def _provenance(evidence: Evidence) -> dict[str, str]:
    """Return the `SHOWN_FACTS` of all sessions, joined by name."""
    facts = []
    for session in sessions(evidence.record):
        for name, fact in session.items():
            if name not in SHOWN_FACTS or not fact:
                continue
            text = shlex.join(fact) if isinstance(fact, list) else str(fact)
            if isinstance(fact, Mapping):
                text = ", ".join(f"{key} {value}" for key, value in sorted(fact.items()) if value)
            facts.append((name.replace("_", " "), text))
    joined = {name: " and ".join(dict.fromkeys(texts)) for name, texts in grouped(facts).items()}
    return {**joined, "time": wall_clock(evidence)}


def _pictures(folder: Path) -> dict[str, str]:
    """Return pictures of a folder, up to 2 MB, as data addresses; one format per picture."""
    kinds = {".png": "image/png", ".gif": "image/gif", ".svg": "image/svg+xml"}
    pictures: dict[str, str] = {}
    for kind, written in kinds.items():
        for path in sorted(folder.glob(f"*{kind}")):
            shown = {Path(name).stem for name in pictures}
            if path.stem not in shown and path.stat().st_size < 2_000_000:
                pictures[path.name] = data_address(path.read_bytes(), written)
    return pictures


def data_address(content: bytes, kind: str) -> str:
    """Return a file of a kind, such as image/png, as an address that contains it."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
