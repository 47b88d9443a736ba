"""Suites by name, and folders of problem files as suites: each ``*.json`` is one problem."""

import hashlib
import os
from pathlib import Path
from typing import Any

from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.base.files import read_json_object
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.results.row import cell_text, natural_key
from cvqmpt_lab.benchmarks.suite_parts import Suite
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.source import content_digest
from cvqmpt_lab.scene.scene_files import named_files

_FOLDERS: dict[str, Suite] = {}  # by full path of the folder; forked workers inherit them


def folder_suite(folder: Path) -> Suite:
    """Return the problems of a folder as a suite with the folder's name.

    `suite_named` finds it by full path. The digest of a problem is the sha256 of its file and of
    all files that it names: scene, clouds, meshes, URDF, SRDF; and the source of its functions.

    Hidden files, json schemas for editors, expectations of `cvqmpt check-tables` and scenes that a
    problem of the folder names are left out.

    Raises:
        InvalidInputError: a file is not a problem, two problems have one name, the folder is empty
            or has the name of a suite.
    """
    contents, path = _contents(folder), folder.resolve()
    named = [data["scene"] for data in contents.values() if isinstance(data.get("scene"), str)]
    scenes = {(folder / scene).resolve() for scene in named}
    problems: dict[str, PlanningProblem] = {}
    digests, paths = dict[str, str](), dict[str, Path]()
    for file, data in contents.items():
        if file.resolve() in scenes or str(data.get("schema")).startswith("cvqmpt-expectations/"):
            continue
        problem = PlanningProblem.load(file)
        # replace "/": in rows, the part after it is the phase of a task
        name = problem.name.replace("/", "-")
        if cell_text(name) != name:
            raise InvalidInputError(
                f"{file}: name {name!r} cannot stand in a table: it must not start with =, +, - "
                "or @, nor have leading, trailing or consecutive blanks"
            )
        if name in paths:
            raise InvalidInputError(
                f"{paths[name]} and {file} are both named {name!r}, and rows "
                "go by names: give one of them another 'name'"
            )
        digest = hashlib.sha256(content_digest(str(file)).encode())
        for other in named_files(data, file.parent):
            digest.update(content_digest(str(other)).encode())
        for _, content in problem.robot.files:
            digest.update(content.encode())
        for function in problem.manifold.functions:
            digest.update(function.code.encode())
        # keep a problem whose name is unchanged: `changed` validates the whole problem again
        problems[name] = problem if name == problem.name else problem.changed(name=name)
        digests[name], paths[name] = digest.hexdigest(), file
    if not problems:
        raise InvalidInputError(
            f"{folder} holds no problem files (*.json); write one with: cvqmpt problems new "
            f"{folder / 'mine.json'}"
        )
    if path.name in SUITES or not path.name:
        raise InvalidInputError(
            f"folder {path}: its rows would be called {path.name!r}, as a suite of ours; give it "
            "another name"
        )
    _FOLDERS[str(path)] = suite = Suite(
        name=path.name,
        title=path.name,
        problems=tuple(problems),
        make=problems.__getitem__,
        digests=digests,
    )
    return suite


def _contents(folder: Path) -> dict[Path, dict[str, Any]]:
    """Return the json of the files that may be problems."""
    try:
        paths = [
            path for path in folder.iterdir() if path.suffix == ".json" and path.name[0] != "."
        ]
    except OSError as error:
        raise InvalidInputError(
            f"cannot read folder {folder}: {error.strerror}; name a folder of problem files, or "
            "plan one file: cvqmpt plan FILE"
        ) from error
    paths = sorted(paths, key=lambda path: natural_key(path.name))
    # `cvqmpt problems new` writes a schema beside the problem, for editors
    problems = [path for path in paths if not path.name.endswith(".schema.json")]
    return {path: read_json_object(path) for path in problems}


def suite_named(name: str) -> Suite:
    """Return the suite of a name or of a folder's full path; UnknownChoiceError lists the names."""
    if os.sep in name:
        return _FOLDERS.get(name) or folder_suite(Path(name))
    return SUITES[require_choice("suite", name, SUITES)]
