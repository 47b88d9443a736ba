"""Descriptions of the committed results for machines: Croissant, RO-Crate, and CITATION.cff.

They are written from the files and from their provenance, so that they name every table's rows,
command, commit, machine and date.
"""

import hashlib
import re
import shlex
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import json_text, read_bytes, read_text
from cvqmpt_lab.benchmarks.results.provenance import sessions
from cvqmpt_lab.paper_tables.claims import Evidence
from cvqmpt_lab.paper_tables.pages import rendered
from cvqmpt_lab.paper_tables.rendering import session_text, title_of

Entity = dict[str, Any]  # of JSON-LD


def metadata_files(found: Mapping[str, Evidence], root: Path) -> dict[Path, str]:
    """Return croissant.json, ro-crate-metadata.json and CITATION.cff, by path.

    Args:
        found: results directories by name.
        root: folder of the checkout, which gets the files.
    """
    project = tomllib.loads(read_text(root / "pyproject.toml"))["project"]
    facts = {
        "description": project["description"],
        "version": project["version"],
        "date": release_date(read_text(root / "CHANGELOG.md"), project["version"]),
    }
    files = {name: _files_of(evidence.folder, root) for name, evidence in found.items()}
    texts = {
        "CITATION.cff": rendered("citation.cff.j2", **facts),
        "croissant.json": json_text(croissant(found, files, facts)) + "\n",
        "ro-crate-metadata.json": json_text(ro_crate(found, files, facts)) + "\n",
    }
    return {root / name: text for name, text in texts.items()}


def release_date(changelog: str, version: str) -> str:
    """Return the date of a version in the changelog; refuse a version without one."""
    found = re.search(rf"^## \[{re.escape(version)}\] - (\S+)$", changelog, re.MULTILINE)
    if found is None:
        raise InvalidInputError(
            f"CHANGELOG.md has no line '## [{version}] - YYYY-MM-DD' for the version of "
            "pyproject.toml: add it"
        )
    return found[1]


def _files_of(folder: Path, root: Path) -> list[Entity]:
    """Return path, kind, size and digest of each file of a results directory."""
    kinds = {".csv": "text/csv", ".json": "application/json", ".md": "text/markdown"}
    kinds |= {".tex": "application/x-tex"}
    found = []
    for path in sorted(folder.iterdir()):
        if path.suffix in kinds:
            data = read_bytes(path)
            found.append(
                {
                    "@id": path.relative_to(root).as_posix(),
                    "name": f"{folder.name}/{path.name}",
                    "encodingFormat": kinds[path.suffix],
                    "contentSize": f"{len(data)} B",
                    "sha256": hashlib.sha256(data).hexdigest(),
                }
            )
    return found


def _title(evidence: Evidence) -> str:
    name = evidence.folder.name
    return title_of(evidence.rows[0].suite) if evidence.rows else f"Numbers of {name}"


def _made_by(evidence: Evidence) -> str:
    """Return how all sessions of a results directory were made, in words."""
    return "; ".join(map(session_text, sessions(evidence.record)))


def croissant(
    found: Mapping[str, Evidence],
    files: Mapping[str, Sequence[Entity]],
    facts: Mapping[str, str],
) -> Entity:
    """Return the results as a data set of Croissant 1.0, with the main columns of their rows.

    Args:
        found: results directories by name.
        files: files of each directory.
        facts: description, version and date of the project.
    """
    return {
        "@context": _croissant_context(),
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": "cvqmpt_lab_results",
        "description": f"Rows and tables of planning runs. {facts['description']}.",
        "license": "https://spdx.org/licenses/MIT.html",
        "version": facts["version"],
        "datePublished": facts["date"],
        "creator": {"@type": "sc:Organization", "name": "The authors of cvqmpt_lab"},
        "citeAs": f"The authors of cvqmpt_lab: cvqmpt_lab {facts['version']}, {facts['date']}",
        "distribution": [
            {
                "@type": "cr:FileObject",
                **file,
                "description": f"{_title(found[name])}. Made by {_made_by(found[name])}.",
                "contentUrl": file["@id"],
            }
            for name, listed in files.items()
            for file in listed
        ],
        "recordSet": [
            _records(name, file["@id"])
            for name, listed in files.items()
            for file in listed
            if file["name"].endswith("/runs.csv")
        ],
    }


def _croissant_context() -> Entity:
    """Return the words of Croissant 1.0, which every such file has to repeat."""
    terms = "citeAs column equivalentProperty extract field fileObject fileProperty fileSet format"
    terms += " includes isLiveDataset jsonPath key md5 parentField path recordSet references regex"
    terms += " repeated replace samplingRate separator source subField transform"
    data = {name: {"@id": f"cr:{name}", "@type": "@json"} for name in ("data", "examples")}
    return {
        "@language": "en",
        "@vocab": "https://schema.org/",
        "sc": "https://schema.org/",
        "cr": "http://mlcommons.org/croissant/",
        "rai": "http://mlcommons.org/croissant/RAI/",
        "dct": "http://purl.org/dc/terms/",
        "conformsTo": "dct:conformsTo",
        "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
        **data,
        **{term: f"cr:{term}" for term in terms.split()},
    }


def _records(name: str, file: str) -> Entity:
    """Return the columns of rows that tables are made of; file: id of the csv file."""
    columns = {
        "problem": "sc:Text",
        "planner": "sc:Text",
        "seed": "sc:Integer",
        "solved": "sc:Boolean",
        "n_state_checks": "sc:Integer",
        "n_projections": "sc:Integer",
        "n_newton_iterations": "sc:Integer",
        "t_total_s": "sc:Float",
        "path_length_rad": "sc:Float",
    }
    return {
        "@type": "cr:RecordSet",
        "@id": f"runs-{name}",
        "name": f"runs-{name}",
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"runs-{name}/{column}",
                "name": column,
                "dataType": kind,
                "source": {"fileObject": {"@id": file}, "extract": {"column": column}},
            }
            for column, kind in columns.items()
        ],
    }


def ro_crate(
    found: Mapping[str, Evidence],
    files: Mapping[str, Sequence[Entity]],
    facts: Mapping[str, str],
) -> Entity:
    """Return the results as a research object of RO-Crate 1.1: an action for each session of runs.

    Args:
        found: results directories by name.
        files: files of each directory.
        facts: description, version and date of the project.
    """
    licence = "https://spdx.org/licenses/MIT"
    parts, actions, commits = [], [], {}
    for name, evidence in found.items():
        folder = f"{Path(files[name][0]['@id']).parent.as_posix()}/"
        parts.append(
            {
                "@id": folder,
                "@type": "Dataset",
                "name": _title(evidence),
                "hasPart": [{"@id": file["@id"]} for file in files[name]],
            }
        )
        for number, session in enumerate(sessions(evidence.record)):
            commit = session.get("git_commit") or "unknown"
            commits[commit] = {
                "@id": f"#cvqmpt_lab-{commit}",
                "@type": "SoftwareApplication",
                "name": "cvqmpt_lab",
                "version": commit,
            }
            actions.append(
                {
                    "@id": f"#{name}-{number}",
                    "@type": "CreateAction",
                    "name": shlex.join(session.get("command") or ["unknown"]),
                    "description": session_text(session),
                    **({"startTime": date} if (date := session.get("date_utc")) else {}),
                    "instrument": {"@id": commits[commit]["@id"]},
                    "result": {"@id": folder},
                }
            )
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": "Results of cvqmpt_lab",
        "description": f"Rows and tables of planning runs. {facts['description']}.",
        "datePublished": facts["date"],
        "version": facts["version"],
        "license": {"@id": licence},
        "hasPart": [{"@id": part["@id"]} for part in parts],
        "mentions": [{"@id": action["@id"]} for action in actions],
    }
    descriptor = {
        "@id": "ro-crate-metadata.json",
        "@type": "CreativeWork",
        "about": {"@id": "./"},
        "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
    }
    listed = [{"@type": "File", **file} for name in found for file in files[name]]
    mit = {"@id": licence, "@type": "CreativeWork", "name": "MIT licence"}
    graph = [descriptor, root, mit, *parts, *listed, *actions, *commits.values()]
    return {"@context": "https://w3id.org/ro/crate/1.1/context", "@graph": graph}
