"""Html page of an audit: the table, worst episodes first, distributions, and a player of episodes.

It is one file that needs no network. The viewer is that of `pictures.web_page`; it is in the file
once, and so are the shapes of the robot.
"""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import write_text
from cvqmpt_lab.base.polyline import states_at
from cvqmpt_lab.features.audit.episodes import Episode, Source, episodes_of, find_sources
from cvqmpt_lab.features.audit.judging import Auditor, Settings
from cvqmpt_lab.features.audit.rows import NOT_READ, SHARES, Row, worst_first
from cvqmpt_lab.features.pictures.bodies import drawing_of_problem
from cvqmpt_lab.features.pictures.web_page import PAGE_DATA_ELEMENT, PAGE_TEMPLATE, page_data
from cvqmpt_lab.search.result import JointPath

TEMPLATE = Path(__file__).with_name("audit_page.html")
MOST_PLAYED = 20  # episodes that the page plays, the worst ones
FRAMES = 120  # of each of them
MOST_ROWS = 2000  # in the table of the page
BINS = 20


def write_page(path: Path, folder: Path, rows: Sequence[Row], settings: Settings) -> None:
    """Write the page of an audit.

    Args:
        path: the html file.
        folder: the folder that was audited; its worst episodes are read again.
        rows: the audit.
        settings: by which it was made.
    """
    worst = worst_first(rows)
    played, meshes = _played(folder, worst, settings)
    data = {
        "title": f"Audit of {folder.name or folder}",
        "robot": Auditor(settings).robot.name,
        "verdicts": Counter(row.verdict for row in rows),
        "kinds": Counter(kind for row in rows for kind in row.kinds.split()).most_common(),
        "rows": [
            {**asdict(row), "name": row.name, "middle": None, "key": None}
            for row in worst[:MOST_ROWS]
        ],
        "left": max(len(worst) - MOST_ROWS, 0),
        "shares": [*SHARES],
        "distributions": list(_distributions(rows)),
        "meshes": meshes,
        "played": played,
        "element": PAGE_DATA_ELEMENT,
        "viewer": PAGE_TEMPLATE.read_text(encoding="utf-8"),
    }
    # "<" is escaped, because "</script>" in a name would end the script element
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    page = TEMPLATE.read_text(encoding="utf-8")
    write_text(path, page.replace(PAGE_DATA_ELEMENT, PAGE_DATA_ELEMENT.replace("{}", text)))


def _distributions(rows: Sequence[Row]) -> Iterator[dict[str, Any]]:
    """Yield histograms of what the episodes use and keep."""
    for name in (*SHARES, "self_mm", "duration_s"):
        values = [getattr(row, name) for row in rows]
        known = np.array([value for value in values if value is not None], dtype=float)
        if not len(known):
            continue
        top = max(float(np.quantile(known, 0.99)), 1.0 if name in SHARES else 1e-3)
        counts, _ = np.histogram(known.clip(0.0, top), BINS, (0.0, top))
        yield {
            "name": name.replace("_", " "),
            "counts": counts.tolist(),
            "top": round(top, 3),
            "limit": 1.0 if name in SHARES else None,
        }


def _played(
    folder: Path, worst: Sequence[Row], settings: Settings
) -> tuple[dict[str, Any], list[Any]]:
    """Return the viewer's data of the worst episodes by name, and the shapes that they share."""
    played, shared = dict[str, Any](), list[Any]()
    # hulls are what is compared, and much smaller than visual meshes
    auditor = Auditor(replace(settings, robot={**settings.robot, "bodies": "hulls"}))
    wanted = [row for row in worst if row.verdict != NOT_READ][:MOST_PLAYED]
    sources = {source.name: source for source in find_sources(folder)}
    for file in dict.fromkeys(row.file for row in wanted):
        own = {row.episode: row for row in wanted if row.file == file}
        for episode in _read(sources[file], settings):
            row = own.get(episode.name)
            if row is None:
                continue
            data = _data(auditor, episode, row)
            if data is None:
                continue
            places = []
            for mesh in data.pop("meshes"):
                if mesh not in shared:
                    shared.append(mesh)
                places.append(shared.index(mesh))
            data["mesh_places"] = places
            played[row.name] = data
    return played, shared


def _read(source: Source, settings: Settings) -> Iterator[Episode]:
    """Yield the episodes of a source again; none if its file has changed to one without."""
    try:
        yield from episodes_of(source, settings.column, settings.rate)
    except InvalidInputError:
        return


def _data(auditor: Auditor, episode: Episode, row: Row) -> dict[str, Any] | None:
    """Return the viewer's data of an episode; None if it has states that cannot be drawn."""
    made = auditor.prepared(episode)
    states, times = made.motion.positions, made.motion.times
    if times is None or not np.isfinite(states).all() or np.abs(states).max() > 1e3:
        return None
    moments = np.linspace(times[0], times[-1], min(FRAMES, len(times)))
    drawing = drawing_of_problem(
        auditor.problem_of(made.motion, made.robot),
        JointPath(states_at(states, times, moments)),
        most_states=FRAMES,
        plots=True,
        verdict=row.verdict,
        lines=[row.name, row.fault or "no fault"],
    )
    return page_data(replace(drawing, times=moments, title=f"{row.name}: {row.verdict}"), layers=())
