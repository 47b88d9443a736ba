"""The project's import graph: no cycle, names in strings counted."""

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("cvqmpt_lab", "paper_tables", "experiments", "cli")


@cache
def modules():
    """The file of each module; a package has the name of its folder."""
    files = [file for name in PACKAGES for file in (ROOT / name).rglob("*.py")]
    relative = {file: file.relative_to(ROOT).with_suffix("").parts for file in files}
    return {".".join(part for part in relative[f] if part != "__init__"): f for f in files}


def imported(file, known):
    """Names of own modules that a file imports, or names in a string, which may import them."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            inside = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (name if name in known else node.module for name in inside)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


@cache
def arrows():
    """The own modules that each module imports; imports of a package's own `__init__` left out."""
    known = modules()
    return {
        name: {other for other in imported(file, known) if other in known and other != name}
        for name, file in known.items()
    }


def test_no_circle():
    graph = {
        name: {other for other in others if modules()[other].name != "__init__.py"}
        for name, others in arrows().items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))
