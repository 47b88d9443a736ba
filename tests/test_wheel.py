"""The wheel has all that planning needs: installed elsewhere, it plans with shipped weights."""

import filecmp
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("cvqmpt_lab", "cli", "experiments", "paper_tables")
DATA = ("*.py", "weights/*/*", "schemas/*.json", "show/*.html", "published/*.csv")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with the installed wheel, which was built from a copy of the tree."""
    folder = tmp_path_factory.mktemp("wheel")
    skip = shutil.ignore_patterns("__pycache__", "results")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, folder / "tree" / name, ignore=skip)
    for name in ("pyproject.toml", "README.md", "LICENSE", "LICENSES.md"):
        shutil.copy(ROOT / name, folder / "tree")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    words = f"wheel --no-deps --no-build-isolation --wheel-dir {folder} {folder}/tree".split()
    subprocess.run([*pip, *words], check=True)
    (wheel,) = folder.glob("cvqmpt_lab-*.whl")
    words = f"install --no-deps --target {folder}/site {wheel}".split()
    subprocess.run([*pip, *words], check=True)
    return folder / "site"


def run(site, folder, words):
    """Python with these words in a folder, with the installed wheel."""
    how = {"cwd": folder, "env": os.environ | {"PYTHONPATH": str(site)}}
    return subprocess.run([sys.executable, *words], **how, capture_output=True, text=True)


def test_it_holds_every_module_and_all_data(site):
    for name in PACKAGES:
        found = (path for pattern in DATA for path in (ROOT / name).rglob(pattern))
        wanted = [p.relative_to(ROOT) for p in found if "results" not in p.parts[-3:-1]]
        assert wanted and [path for path in wanted if not (site / path).is_file()] == []
        assert all(filecmp.cmp(ROOT / path, site / path, shallow=False) for path in wanted)


def test_it_plans_from_an_empty_folder(site, tmp_path):
    options = "--problem 7 --planner roadmap-cvq --iterations 2000"
    done = run(site, tmp_path, f"{site}/bin/cvqmpt plan place-task {options}".split())
    assert done.returncode == 0, done.stderr
    assert "status      solved" in done.stdout and "certificate valid" in done.stdout
    assert list(tmp_path.iterdir()) == []
    found = run(site, tmp_path, ["-c", "import cli.main, cvqmpt_lab; print(cvqmpt_lab.__file__)"])
    assert Path(found.stdout.strip()) == site / "cvqmpt_lab" / "__init__.py"


@pytest.mark.parametrize("command", ["check-tables", "check-tables --update", "claims"])
def test_comparing_with_committed_results_needs_a_checkout(site, tmp_path, command):
    done = run(site, tmp_path, [site / "bin" / "cvqmpt", *command.split()])
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "needs a checkout" in done.stderr and not list((site / "paper_tables").glob("*.md"))
