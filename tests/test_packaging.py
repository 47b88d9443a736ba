"""What holds the project together: pins, commands, licence, layers, and no host names in what installs it."""

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
BEFORE_TESTS = "1 failed: make test ended with exit code 2 before or beside the tests; "
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DECLARED = [Requirement(r) for r in (*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["dev"])]
TARGETS = ("venv", "reproduce", "test", "lint", "bench", "clean")


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


def test_the_command_leaves_without_interpreter_teardown():
    assert PROJECT["scripts"] == {"cvqmpt": "cli.main:entry_point"}


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


def test_make_knows_its_targets():
    for target in TARGETS:
        done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


def test_an_old_python_is_refused_in_one_line(tmp_path):
    old = tmp_path / "python3"
    old.write_text("#!/bin/sh\nexit 1\n")  # what any interpreter below 3.11 answers to the version question
    old.chmod(0o755)
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        (tmp_path / name).write_text((ROOT / name).read_text())
    done = subprocess.run(
        ["make", "--no-print-directory", "venv", f"PYTHON={old}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0 and not (tmp_path / ".venv").exists()
    assert (
        done.stdout.splitlines()[-1] == "Python 3.11 or newer is needed: make venv PYTHON=/path/to/python3.11"
    )


@pytest.mark.parametrize(
    ("prints", "code", "last"),
    [
        ("3 passed in 1.00s", 0, "3 passed in 1.00s"),
        ("1 failed, 2 passed in 1.00s", 2, "1 failed, 2 passed in 1.00s"),
        ("3 passed in 1.00s", 2, BEFORE_TESTS + "3 passed in 1.00s"),
        ("ruff is unhappy", 2, BEFORE_TESTS + "no tests ran"),
    ],
)
def test_continuous_integration_ends_with_the_summary(tmp_path, prints, code, last):
    make = tmp_path / "make"
    make.write_text(f"#!/bin/sh\necho '{prints}'\necho 'noise afterwards' >&2\nexit {code}\n")
    make.chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run([ROOT / ".ci" / "run"], env=environment, capture_output=True, text=True)
    assert done.returncode == code and done.stdout.splitlines()[-1] == last


def linted(arguments, tmp_path):
    lint = Path(sys.executable).parent / "lint-imports"
    command = [lint, "--no-logo", "--cache-dir", tmp_path / "cache", *arguments]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "COLUMNS": "200"}
    )


def test_layers_and_doors_are_kept(tmp_path):
    done = linted([], tmp_path)
    assert done.returncode == 0 and " 0 broken" in done.stdout, done.stdout


@pytest.mark.parametrize(
    ("old", "new", "broken"),
    [
        (
            "    cvqmpt_lab.scene.exact_checker\n    cvqmpt_lab.robot.hulls",
            "    cvqmpt_lab.scene.exact_checker",
            "-> coal",
        ),
        ("    cvqmpt_lab.show.recording\n\n[", "    cvqmpt_lab.show.still\n\n[", "-> rerun"),
        (
            "    cvqmpt_lab.show.rasteriser\n    cvqmpt_lab.show.meshes",
            "    cvqmpt_lab.show.meshes\n    cvqmpt_lab.show.rasteriser",
            "-> cvqmpt_lab.show.meshes",
        ),
    ],
)
def test_contracts_can_break(tmp_path, old, new, broken):
    text = (ROOT / ".importlinter").read_text()
    assert text.count(old) == 1
    (tmp_path / "contracts.ini").write_text(text.replace(old, new))
    done = linted(["--config", str(tmp_path / "contracts.ini")], tmp_path)
    assert done.returncode != 0 and broken in done.stdout, done.stdout
