"""What the report says of one results directory, as plain data."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

from cvqmpt_lab.results.provenance import sessions
from cvqmpt_lab.results.row import ResultRow
from paper_tables.claims import Evidence
from paper_tables.claims_page import wall_clock
from paper_tables.comparison import REFERENCE, work
from paper_tables.paper_numbers import read_published
from paper_tables.render import SuiteTable, table_of
from paper_tables.report import plots
from paper_tables.report.repricing import COSTS, duration, repriced
from paper_tables.summary import by_planner

PICTURES = {".png": "image/png", ".gif": "image/gif", ".svg": "image/svg+xml"}
ROW_COLUMNS = ("problem", "seed", "solved", "time [s]", "work", "vertices", "length [rad]", "what")
MOST_BYTES = 2_000_000
"""Of a picture that is taken into the page."""


@dataclass(frozen=True)
class Block:
    """A part of a table's markdown: a title, notes and a table."""

    title: str
    texts: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]
    """The header first; empty when there is no table."""


@dataclass(frozen=True)
class Section:
    """A results directory."""

    name: str
    title: str
    blocks: tuple[Block, ...]
    planners: tuple[str, ...]
    plots: Mapping[str, str]
    """Svg by title."""
    repricing: Mapping[str, Any] | None
    rows: Mapping[str, Sequence[Sequence[object]]]
    """By planner, in ROW_COLUMNS."""
    again: str
    """The command that plans a problem again, with PROBLEM, PLANNER and SEED in it."""
    provenance: Mapping[str, str]
    pictures: Mapping[str, str]
    """Data addresses by file name."""


def section_of(evidence: Evidence) -> Section:
    """Everything about a results directory."""
    rows = evidence.rows
    suite = rows[0].suite if rows else evidence.folder.name
    table = table_of(suite) if rows else SuiteTable(f"Figure {evidence.folder.name}")
    published = read_published(*table.paper) if table.paper else ()
    groups = by_planner(rows, published)
    return Section(
        name=evidence.folder.name,
        title=table.title if evidence.folder.name == suite else f"{evidence.folder.name}: {table.title}",
        blocks=tuple(blocks(table.render(rows, published).markdown)) if rows else (),
        planners=tuple(groups),
        plots=_plots(groups) if rows else {},
        repricing=_repricing(groups),
        rows={name: [_row(row) for row in group] for name, group in groups.items()},
        again=f"cvqmpt plan {suite} --problem PROBLEM --planner PLANNER --seed SEED --picture plan.png",
        provenance=_provenance(evidence),
        pictures=_pictures(evidence.folder),
    )


def blocks(markdown: str) -> list[Block]:
    """The sections of our tables' markdown: titles, bullets and tables are all it has."""
    found = []
    for part in f"\n{markdown}".split("\n## "):
        title, _, body = part.partition("\n")
        lines = [line for line in body.splitlines() if line.strip()]
        cells = [_cells(line) for line in lines if line.startswith("|")]
        texts = tuple(line.removeprefix("- ") for line in lines if not line.startswith("|"))
        table = tuple(tuple(line) for line in cells if set("".join(line)) - {"-"})
        if title or texts or table:
            found.append(Block(title, texts, table))
    return found


def _cells(line: str) -> list[str]:
    hidden = line.replace("\\|", "\0").strip("|").split("|")
    return [cell.replace("\0", "|").strip() for cell in hidden]


def _plots(groups: plots.Groups) -> dict[str, str]:
    length = attrgetter("path_length_rad")
    drawn = {
        "Solved against time": plots.solved_curve(groups),
        "Path length, solved runs": plots.distribution(groups, length, "length [rad]", log=False),
        "Work, solved runs": plots.distribution(groups, work, "projections and state checks"),
        "Cost ledger: where time goes": plots.ledger(groups),
    }
    if REFERENCE in groups and len(groups) > 1:
        drawn |= {
            f"Work, problem by problem, against {REFERENCE}": plots.scatter(groups, REFERENCE, work, "work"),
            f"Length, problem by problem, against {REFERENCE}": plots.scatter(
                groups, REFERENCE, length, "length [rad]"
            ),
        }
    return drawn


def _repricing(groups: plots.Groups) -> dict[str, Any] | None:
    """What the slider shows."""
    planners = repriced(groups)
    if not planners:
        return None
    left, _, width, _ = plots.REPRICING_FRAME
    return {
        "plot": plots.repricing(planners, list(groups)),
        "frame": (left, width),
        "costs": [duration(cost) for cost in COSTS],
        "planners": [
            {
                "name": item.planner,
                "pays": item.pays,
                "ratios": [(ratio.estimate, ratio.low, ratio.high) for ratio in item.ratios],
            }
            for item in planners
        ],
    }


def _row(row: ResultRow) -> list[object]:
    what = row.fallback or row.detail or "" if row.solved else f"{row.fail_reason}: {row.detail or ''}"
    numbers = [
        None if number is None else round(number, 4)
        for number in (row.t_total_s, work(row), row.path_length_rad)
    ]
    return [row.problem, row.seed, row.solved, numbers[0], numbers[1], row.vertices, numbers[2], what]


def _provenance(evidence: Evidence) -> dict[str, str]:
    told: dict[str, list[str]] = {}
    for session in sessions(evidence.record):
        dirty = " with uncommitted changes" if session.get("git_dirty") else ""
        facts = {
            "command": " ".join(session.get("command") or ["unknown"]),
            "commit": f"{session.get('git_commit') or 'unknown'}{dirty}",
            "date": session.get("date_utc"),
            "machine": f"{session.get('cpu_model') or 'unknown'}, {session.get('cpu_count') or '?'} cores, "
            f"{session.get('platform')}, python {session.get('python')}",
            "weights": ", ".join(f"{k} {v}" for k, v in sorted(session.get("weights", {}).items())),
            "versions": ", ".join(
                f"{k} {v}" for k, v in sorted((session.get("versions") or {}).items()) if v
            ),
        }
        for name, fact in facts.items():
            if fact:
                told.setdefault(name, []).append(str(fact))
    return {name: " and ".join(dict.fromkeys(facts)) for name, facts in told.items()} | {
        "time": wall_clock(evidence)
    }


def _pictures(folder: Path) -> dict[str, str]:
    """Pictures beside the rows; of one that is there in two forms, the first."""
    found: dict[str, str] = {}
    for kind, mime in PICTURES.items():
        for path in sorted(folder.glob(f"*{kind}")):
            if (
                path.stem not in {name.rpartition(".")[0] for name in found}
                and path.stat().st_size < MOST_BYTES
            ):
                data = base64.b64encode(path.read_bytes()).decode("ascii")
                found[path.name] = f"data:{mime};base64,{data}"
    return found
