"""What holds the project together: pins, licence, layers, and no host names in what installs it."""

import os
import re
import subprocess
import sys
import tomllib
from importlib.metadata import distribution, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
DECLARED = [Requirement(r) for r in (*PROJECT["dependencies"], *EXTRAS["train"], *EXTRAS["dev"])]


def pins():
    """Name -> version of constraints.txt."""
    lines = [line.strip() for line in (ROOT / "constraints.txt").read_text().splitlines()]
    requirements = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(r.name): str(r.specifier) for r in requirements}


def closure(requirements):
    """Names of all distributions that requirements pull in here."""
    found = set()
    open_names = [(canonicalize_name(r.name), tuple(sorted(r.extras))) for r in requirements]
    while open_names:
        item = open_names.pop()
        if item in found:
            continue
        found.add(item)
        for text in distribution(item[0]).requires or []:
            requirement = Requirement(text)
            markers = ({"extra": extra} for extra in ("", *item[1]))
            if requirement.marker is None or any(requirement.marker.evaluate(m) for m in markers):
                open_names.append((canonicalize_name(requirement.name), tuple(sorted(requirement.extras))))
    return {name for name, _ in found}


def test_every_dependency_is_pinned_to_what_is_installed():
    needed, pinned = closure(DECLARED), pins()
    assert sorted(needed - pinned.keys()) == [], "missing in constraints.txt"
    assert all(specifier.startswith("==") for specifier in pinned.values())
    assert {name: f"=={version(name)}" for name in needed} == {name: pinned[name] for name in needed}


def test_pins_satisfy_the_declared_ranges():
    for requirement in DECLARED:
        assert requirement.specifier.contains(pins()[canonicalize_name(requirement.name)].removeprefix("=="))


def test_licence_and_readme_are_there():
    assert (
        (ROOT / "LICENSE").read_text().startswith("MIT License\n\nCopyright (c) 2026 cvqmpt_lab founders\n")
    )
    text = (ROOT / PROJECT["readme"]).read_text()
    assert len(text.splitlines()) < 200 and "TODO" not in text
    linked = re.findall(r"\]\(([^)#:]+)\)", text)
    assert linked and [path for path in linked if not (ROOT / path).exists()] == []


@pytest.mark.parametrize("name", ["Makefile", ".ci/run", "constraints.txt", "pyproject.toml"])
def test_no_package_index_is_named(name):
    text = (ROOT / name).read_text()
    assert re.search(r"https?://|--index-url|--find-links|--trusted-host", text) is None


def linted(arguments, tmp_path):
    lint = Path(sys.executable).parent / "lint-imports"
    command = [lint, "--no-logo", "--cache-dir", tmp_path / "cache", *arguments]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "COLUMNS": "200"}
    )


def test_layers_and_doors_are_kept(tmp_path):
    done = linted([], tmp_path)
    assert done.returncode == 0 and " 0 broken" in done.stdout, done.stdout


SPOILED = (  # a line of each kind of contract, what it is changed to, and what is found then
    ("    cvqmpt_lab.planning.ompl_planners\n", "    cvqmpt_lab.planning.result\n", "-> ompl"),
    ("    rerun\n    torch\n", "    rerun\n    numba\n", "-> numba"),
    (
        "    cvqmpt_lab.show.rasteriser\n    cvqmpt_lab.show.meshes\n",
        "    cvqmpt_lab.show.meshes\n    cvqmpt_lab.show.rasteriser\n",
        "-> cvqmpt_lab.show.meshes",
    ),
)


def test_contracts_can_break(tmp_path):
    text = (ROOT / ".importlinter").read_text()
    for old, new, _ in SPOILED:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (tmp_path / "contracts.ini").write_text(text)
    done = linted(["--config", str(tmp_path / "contracts.ini")], tmp_path)
    assert done.returncode != 0
    assert [found for _, _, found in SPOILED if found not in done.stdout] == [], done.stdout
