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
    subprocess.run(
        [*pip, "install", "--no-deps", "--target", str(folder / "site"), str(wheel)], check=True
    )
    return folder / "site"


def test_it_holds_every_module_and_all_data(site):
    for name in PACKAGES:
        wanted = {
            path
            for pattern in DATA
            for path in (ROOT / name).rglob(pattern)
            if "results" not in path.parts[-3:-1]
        }
        missing = [path for path in wanted if not (site / path.relative_to(ROOT)).is_file()]
        assert wanted and missing == []
        assert all(
            filecmp.cmp(path, site / path.relative_to(ROOT), shallow=False) for path in wanted
        )


def test_it_plans_from_an_empty_folder(site, tmp_path):
    words = [
        "plan",
        "place-task",
        "--problem",
        "7",
        "--planner",
        "roadmap-cvq",
        "--iterations",
        "2000",
    ]
    environment = os.environ | {"PYTHONPATH": str(site)}
    done = subprocess.run(
        [sys.executable, site / "bin" / "cvqmpt", *words],
        cwd=tmp_path, env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "status      solved" in done.stdout and "certificate valid" in done.stdout
    assert list(tmp_path.iterdir()) == []
    where = [sys.executable, "-c", "import cli.main, cvqmpt_lab; print(cvqmpt_lab.__file__)"]
    found = subprocess.run(
        where, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert Path(found.stdout.strip()) == site / "cvqmpt_lab" / "__init__.py"


@pytest.mark.parametrize("command", ["check-tables", "check-tables --update", "claims"])
def test_what_compares_with_committed_results_says_that_it_needs_a_checkout(
    site, tmp_path, command
):
    done = subprocess.run(
        [sys.executable, site / "bin" / "cvqmpt", *command.split()],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(site)}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "needs a checkout" in done.stderr and not list((site / "paper_tables").glob("*.md"))
