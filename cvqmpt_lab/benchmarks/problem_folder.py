"""A folder of problem files as a suite: every ``*.json`` is a problem, in order of file names."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_json_object
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import natural_key, one_line
from cvqmpt_lab.robot.source import content_digest
from cvqmpt_lab.scene.scene import named_files


def read_folder(folder: Path) -> tuple[dict[str, PlanningProblem], dict[str, str]]:
    """All problems of a folder by their names in rows, and their digests.

    A digest is the sha256 over the file and all that it names: scene, clouds, meshes, URDF, SRDF.

    Left out are hidden files, json schemas for editors, expectations of `cvqmpt check-tables`, and
    scenes that a problem of the folder names. InvalidInputError names the file that is no problem,
    and what is wrong in it; two of one name; an empty folder.
    """
    contents = _contents(folder)
    named = [data["scene"] for data in contents.values() if isinstance(data.get("scene"), str)]
    scenes = {(folder / scene).resolve() for scene in named}
    problems: dict[str, PlanningProblem] = {}
    digests, paths = dict[str, str](), dict[str, Path]()
    for path, data in contents.items():
        if path.resolve() in scenes or str(data.get("schema")).startswith("cvqmpt-expectations/"):
            continue
        problem = PlanningProblem.load(path)
        # a slash, after which rows name the phase of a task, becomes a hyphen
        name = problem.name.replace("/", "-")
        if one_line(name) != name:
            raise InvalidInputError(
                f"{path}: name {name!r} cannot stand in a table: no =, +, - or @ first, no blanks "
                "around or in a row"
            )
        problem = problem if name == problem.name else replace(problem, name=name)
        if name in paths:
            raise InvalidInputError(
                f"{paths[name]} and {path} are both named {name!r}, and rows "
                "go by names: give one of them another 'name'"
            )
        digest = hashlib.sha256(content_digest(str(path)).encode())
        for other in named_files(data, path.parent):
            digest.update(content_digest(str(other)).encode())
        for _, content in problem.robot.files:
            digest.update(content.encode())
        problems[name], digests[name], paths[name] = problem, digest.hexdigest(), path
    if not problems:
        raise InvalidInputError(
            f"{folder} holds no problem files (*.json); write one with: cvqmpt problems new "
            f"{folder / 'mine.json'}"
        )
    return problems, digests


def _contents(folder: Path) -> dict[Path, dict[str, Any]]:
    """Json of the files that may be problems."""
    try:
        paths = [
            path for path in folder.iterdir() if path.suffix == ".json" and path.name[0] != "."
        ]
    except OSError as error:
        raise InvalidInputError(
            f"cannot read folder {folder}: {error.strerror}; name a folder of problem files, or "
            "one file by --problem-file"
        ) from error
    paths = sorted(paths, key=lambda path: natural_key(path.name))
    # `cvqmpt problems new` writes a schema beside the problem, for editors
    problems = [path for path in paths if not path.name.endswith(".schema.json")]
    return {path: read_json_object(path) for path in problems}
