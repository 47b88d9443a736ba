"""Packaging: pins, licences, layers, no circle of imports, no host names in installation files."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib.metadata import requires, version
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from cvqmpt_lab.robot.source import ARMS
from cvqmpt_lab.vqmpt.weights import SHIPPED

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PACKAGES = ("cvqmpt_lab", "paper_tables", "experiments", "cli")
LINKED = PACKAGES[1:]  # folders at the top that `cvqmpt_lab` holds by links
EXTRAS = PROJECT["optional-dependencies"]
RUNTIME = [Requirement(text) for text in PROJECT["dependencies"]]
DECLARED = [*RUNTIME, *map(Requirement, EXTRAS["dev"] + EXTRAS["docs"] + EXTRAS["train"])]


def pinned():
    """Return versions by name in constraints.txt."""
    lines = map(str.strip, (ROOT / "constraints.txt").read_text().splitlines())
    wanted = (Requirement(line) for line in lines if line and not line.startswith("#"))
    return {canonicalize_name(r.name): str(r.specifier).removeprefix("==") for r in wanted}


def closure(wanted):
    """Return all installed distributions that requirements need, directly or indirectly."""
    found, left = set(), [(canonicalize_name(r.name), tuple(sorted(r.extras))) for r in wanted]
    while left:
        name, extras = item = left.pop()
        if item in found:
            continue
        found.add(item)
        for requirement in map(Requirement, requires(name) or ()):
            marker = requirement.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *extras)):
                needed = canonicalize_name(requirement.name), tuple(sorted(requirement.extras))
                left.append(needed)
    return {name for name, _ in found}


def test_every_dependency_is_pinned_to_what_is_installed():
    needed, pins = closure(DECLARED), pinned()
    assert sorted(needed - pins.keys()) == [], "missing in constraints.txt"
    assert {name: version(name) for name in needed} == {name: pins[name] for name in needed}


def test_pins_satisfy_the_declared_ranges():
    for requirement in (*DECLARED, *map(Requirement, EXTRAS["notebooks"])):
        assert requirement.specifier.contains(pinned()[canonicalize_name(requirement.name)])


def test_the_locked_set_is_what_planning_needs_as_pinned_with_hashes():
    """`make locked` writes the locked set."""
    text = (ROOT / "locked.txt").read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    locked = {line.split("==")[0]: line.split()[0].split("==")[1] for line in lines}
    pins = pinned()
    assert locked == {name: pins[name] for name in locked}
    needed = closure(RUNTIME) | {"setuptools"}  # setuptools builds the project itself
    assert needed <= locked.keys() and all("--hash=sha256:" in line for line in lines)


def test_the_licence_of_all_that_ships_or_is_installed_is_listed():
    """`make inventory` writes the list of distributions."""
    rows = [re.split(r" *\| *", line) for line in (ROOT / "LICENSES.md").read_text().splitlines()]
    listed = {canonicalize_name(row[1]): row[-2] for row in rows if len(row) > 3}
    robots = {canonicalize_name(arm.urdf.split("/")[0]) for arm in ARMS.values()}
    weights = {canonicalize_name(f"weights {name}") for name in SHIPPED}
    assert sorted((closure(RUNTIME) | robots | weights) - listed.keys()) == []
    assert [name for name, licence in listed.items() if licence == "UNKNOWN"] == ["cmeel-qhull"]


INSTALLING = (
    "Makefile Dockerfile .ci/run .pre-commit-config.yaml constraints.txt locked.txt pyproject.toml"
)


@pytest.mark.parametrize("name", INSTALLING.split())
def test_no_package_index_is_named(name):
    text = (ROOT / name).read_text()
    assert re.search(r"https?://|--index-url|--find-links|--trusted-host", text) is None


def test_hooks_before_a_commit_run_the_commands_of_make_lint():
    """All hooks are local: pre-commit downloads nothing."""
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert repository["repo"] == "local"
    make = (ROOT / "Makefile").read_text()
    for hook in repository["hooks"]:
        assert hook["language"] == "system"
        folder, command = hook["entry"].removeprefix(".venv/").split("/")
        assert folder == "bin" and (Path(sys.executable).parent / command.split()[0]).is_file()
        assert f"$(BIN)/{command}" in make
    assert {hook["id"] for hook in repository["hooks"]} == {
        "ruff-check",
        "ruff-format",
        "mypy",
        "lint-imports",
    }


def test_the_container_has_a_supported_python_and_runs_as_a_user():
    instructions = re.findall(r"^([A-Z]+) (.*)", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    (base,) = (value for name, value in instructions if name == "FROM")
    python = base.removeprefix("python:").removesuffix("-slim")
    assert SpecifierSet(PROJECT["requires-python"]).contains(f"{python}.5")
    assert [value for name, value in instructions if name == "USER"] == ["user"]
    assert instructions[-1] == ("CMD", '["make", "reproduce"]')


def linted(arguments, tmp_path):
    lint = Path(sys.executable).parent / "lint-imports"
    command = [lint, "--no-logo", "--cache-dir", tmp_path / "cache", *arguments]
    how = {"cwd": ROOT, "env": {**os.environ, "COLUMNS": "200"}}
    return subprocess.run(command, **how, capture_output=True, text=True)


def test_layers_and_doors_are_kept(tmp_path):
    done = linted([], tmp_path)
    assert done.returncode == 0 and " 0 broken" in done.stdout, done.stdout


def test_contracts_can_break(tmp_path):
    text, forbidden = (ROOT / ".importlinter").read_text(), "    rerun\n    torch\n"
    assert text.count(forbidden) == 1
    wrong = text.replace(forbidden, forbidden.replace("torch", "numba"))
    (tmp_path / "c.ini").write_text(wrong)
    done = linted(["--config", str(tmp_path / "c.ini")], tmp_path)
    assert done.returncode != 0 and "-> numba" in done.stdout, done.stdout


def test_the_plan_of_the_house_names_every_room():
    block = (ROOT / "docs" / "architecture.md").read_text().split("```")[1]
    rooms = set(" ".join(re.findall(r"^  (\w.{,25})", block, re.MULTILINE)).split())
    package = ROOT / "cvqmpt_lab"
    found = {path.stem for path in package.glob("*.py")} - {"__init__", "__main__"}
    found |= {f"{path.parent.name}/" for path in package.glob("*/__init__.py")}
    assert {path.parent.name for path in package.glob("features/*/__init__.py")} <= {*block.split()}
    assert rooms == found - {f"{name}/" for name in LINKED}


@pytest.mark.parametrize("name", LINKED)
def test_folders_at_the_top_are_parts_of_the_package_by_links(name):
    link = ROOT / "cvqmpt_lab" / name
    assert link.is_symlink() and link.resolve() == ROOT / name


@cache
def modules():
    """Return the file of each module by its name; a package has the name of its folder."""
    files = [file for name in PACKAGES for file in (ROOT / name).rglob("*.py")]
    names = {}
    for file in files:
        parts = file.relative_to(ROOT).with_suffix("").parts
        parts = parts if parts[0] == "cvqmpt_lab" else ("cvqmpt_lab", *parts)
        names[".".join(part for part in parts if part != "__init__")] = file
    return names


def imported(file, known):
    """Return own modules that a file imports, or names in a string, which may import them."""
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
    """Return the own modules that each module imports, without `__init__` of its own packages."""
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
