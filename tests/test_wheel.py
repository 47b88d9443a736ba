"""The wheel contains everything for planning; installed elsewhere, it plans."""

import filecmp
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cvqmpt_lab.base.jit import folder

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("cvqmpt_lab", "cli", "experiments", "paper_tables")
DATA = (
    *("*.py", "weights/*/*", "show/*.html", "py.typed"),
    *("published/*", "expected/*", "results/*/*", "templates/*", "README.md"),
)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with the installed wheel, which was built from a copy of the tree."""
    folder = tmp_path_factory.mktemp("wheel")
    skip = shutil.ignore_patterns("__pycache__")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, folder / "tree" / name, symlinks=True, ignore=skip)
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
    """Run Python with these arguments in a folder, with the installed wheel."""
    how = {"cwd": folder, "env": os.environ | {"PYTHONPATH": str(site)}}
    return subprocess.run([sys.executable, *words], **how, capture_output=True, text=True)


def test_it_holds_every_module_and_all_data(site):
    for name in PACKAGES:
        found = (path for pattern in DATA for path in (ROOT / name).rglob(pattern))
        wanted = [path.relative_to(ROOT) for path in found if path.suffix != ".pyc"]
        inside = site if name == "cvqmpt_lab" else site / "cvqmpt_lab"
        assert wanted and [path for path in wanted if not (inside / path).is_file()] == []
        assert all(filecmp.cmp(ROOT / path, inside / path, shallow=False) for path in wanted)


def test_it_installs_no_other_name_than_the_package(site):
    installed = {path.name for path in site.iterdir() if not path.name.endswith(".dist-info")}
    assert installed == {"bin", "cvqmpt_lab"}


def test_it_finds_the_machine_code_that_the_checkout_compiled(site, tmp_path):
    found = run(site, tmp_path, ["-c", "from cvqmpt_lab.base import jit; print(jit.folder())"])
    assert found.stdout.strip() == str(folder())


def test_it_plans_from_an_empty_folder(site, tmp_path):
    options = "--problem 7 --planner roadmap-cvq --iterations 2000"
    done = run(site, tmp_path, f"{site}/bin/cvqmpt plan place-task {options}".split())
    assert done.returncode == 0, done.stderr
    assert "status      solved" in done.stdout and "certificate certified" in done.stdout
    assert list(tmp_path.iterdir()) == []
    found = run(site, tmp_path, ["-c", "import cvqmpt_lab.cli.main; print(cvqmpt_lab.__file__)"])
    assert Path(found.stdout.strip()) == site / "cvqmpt_lab" / "__init__.py"


def test_it_judges_the_claims_by_the_committed_rows(site, tmp_path):
    done = run(site, tmp_path, [site / "bin" / "cvqmpt", "claims"])
    assert done.returncode == 0, done.stderr
    assert "twice as fast" in done.stdout and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["check-tables --update", "claims --write"])
def test_what_writes_committed_files_needs_a_checkout(site, tmp_path, command):
    done = run(site, tmp_path, [site / "bin" / "cvqmpt", *command.split()])
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "needs a checkout" in done.stderr


def test_an_extra_is_named_by_its_packages_as_no_index_has_ours(site, tmp_path):
    (tmp_path / "sitecustomize.py").write_text("import sys; sys.modules['viser'] = None")
    site_first = f"{tmp_path}{os.pathsep}{site}"
    done = run(site_first, tmp_path, [site / "bin" / "cvqmpt", "studio"])
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "pip install 'viser" in done.stderr
