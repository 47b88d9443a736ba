"""The version, `python -m cvqmpt_lab`, completion, and planners of OMPL where ompl is missing."""

import subprocess
import sys
from importlib.metadata import version

import pytest

import cvqmpt_lab


def run(*words, path=""):
    """Run Python in a process; path: folder of a sitecustomize."""
    env = {"PYTHONPATH": f"{path}:{':'.join(sys.path)}", "PATH": ""}
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, env=env)


def test_the_package_has_a_version_and_runs_as_a_module():
    assert cvqmpt_lab.__version__ == version("cvqmpt-lab")
    done = run("-m", "cvqmpt_lab", "--version")
    assert done.stdout == f"cvqmpt_lab {cvqmpt_lab.__version__}\n", done.stderr


def test_planners_of_ompl_say_in_one_line_that_ompl_is_missing(tmp_path):
    (tmp_path / "sitecustomize.py").write_text("import sys; sys.modules['ompl'] = None")
    words = [
        "-m",
        "cvqmpt_lab",
        "plan",
        "place-task",
        "--problem",
        "7",
        "--planner",
        "ompl-projected",
    ]
    done = run(*words, path=tmp_path)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "ompl, which is not installed: it is not available for Python 3.14" in done.stderr


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_has_every_command(shell, cvqmpt):
    pytest.importorskip("shtab")
    told = cvqmpt(f"completion {shell}")
    assert "reproduce" in told and "--planner" in told
