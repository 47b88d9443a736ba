"""The arithmetic is pinned whatever the environment says, and what is not pinned is told."""

import json
import os
import subprocess
import sys

import pytest
from command_line import environment, run_here
from made_rows import differences

from cvqmpt_lab.base import arithmetic
from cvqmpt_lab.base.arithmetic import LIBRARY_TUNING, NATIVE, PINNED, TARGET
from cvqmpt_lab.benchmarks.results.row import RUNS_FILE, read_rows
from cvqmpt_lab.experiments.bench.processors import FEW, SETTINGS

UNABLE = arithmetic._unable() or os.environ.get(NATIVE)
PINS = pytest.mark.skipif(bool(UNABLE), reason=f"needs x86-64 with AVX2, without {NATIVE}")
FACTS = "import json, cvqmpt_lab.base.arithmetic as a; print(json.dumps(a.facts()))"


def said(code, **changes):
    """Return facts and log of a new process without the variables that this one has set."""
    clean = {k: v for k, v in environment(**changes).items() if k not in PINNED or k in changes}
    done = subprocess.run(
        [sys.executable, "-c", code], env=clean, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


@PINS
@pytest.mark.parametrize("name", ["this processor", *FEW])
def test_the_arithmetic_is_pinned_whatever_the_environment_says(name):
    setting = {k: v for k, v in SETTINGS[name].items() if k != LIBRARY_TUNING}
    found, log = said(FACTS, **setting)
    assert found["numba for"] == found["numpy for"] == TARGET and log == ""


@PINS
def test_what_was_imported_before_is_told_in_one_line():
    # numpy as other processors compute, whatever this one has
    early = {"NPY_DISABLE_CPU_FEATURES": SETTINGS["numpy with SSE"]["NPY_DISABLE_CPU_FEATURES"]}
    found, log = said("import numpy, cvqmpt_lab; " + FACTS, **early)
    (line,) = log.splitlines()
    assert line.startswith(f"numpy (which uses {found['numpy for']}) was imported before")
    assert "import cvqmpt_lab first" in line and "CVQMPT_NATIVE=1 hides this line" in line
    assert found["numba for"] == TARGET != found["numpy for"]
    found, log = said("import numpy, cvqmpt_lab; " + FACTS, CVQMPT_NATIVE="1", **early)
    assert log == "" and found["numba for"] != TARGET


def test_a_machine_that_cannot_compute_so_is_told_what_differs(monkeypatch, caplog):
    monkeypatch.delenv(NATIVE, raising=False)
    monkeypatch.setattr(arithmetic, "_unable", lambda: "this processor is aarch64, not x86_64")
    monkeypatch.delenv("OPENBLAS_CORETYPE")
    arithmetic.pin()
    assert caplog.messages == [
        "this processor is aarch64, not x86_64: counts and paths may differ from those of other "
        "machines; CVQMPT_NATIVE=1 hides this line"
    ]
    assert "OPENBLAS_CORETYPE" not in os.environ


@PINS
@pytest.mark.parametrize("name", FEW)
def test_rows_are_those_of_other_processors(name, tmp_path):
    """Settings by which libraries take kernels of other processors change no row."""
    planners = "birrt,roadmap-cvq,cvq-mpt,ompl-projected"
    words = ["reproduce", "place-task", "--problems", "2", "--planners", planners]
    words += ["--iterations", "2000", "--jobs", "1", "--out"]
    run_here([*words, str(tmp_path / "here")])
    done = subprocess.run(
        [sys.executable, "-m", "cvqmpt_lab.cli.main", *words, str(tmp_path / "there")],
        env=environment(**SETTINGS[name]), capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    here, there = (read_rows(tmp_path / side / RUNS_FILE) for side in ("here", "there"))
    assert len(here) == 8 and differences(here, there) == []
