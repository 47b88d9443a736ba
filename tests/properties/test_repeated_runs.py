"""A command repeats its rows, except times, with any workers, threads, hash seed and clock."""

import subprocess
import time

import pytest
from command_line import run, run_here
from made_rows import differences

from cvqmpt_lab.benchmarks.results.row import RUNS_FILE, read_rows
from cvqmpt_lab.planning.by_name import declared
from cvqmpt_lab.planning.planners import PLANNERS

SOME = ("birrt", "ompl-projected", "mpnet", "cvq-mpt")
JUMPING = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <time.h>
static long jump(void) { static unsigned n; n = n * 1103515245u + 12345u; \
return (long)(n >> 8) % 7200 - 3600; }
int clock_gettime(clockid_t id, struct timespec *t) {
    int (*real)(clockid_t, struct timespec *) = dlsym(RTLD_NEXT, "clock_gettime");
    int code = real(id, t);
    if (id == CLOCK_REALTIME) t->tv_sec += jump();
    return code;
}
"""  # between a process and its C library: the date jumps by up to an hour whenever it is asked for


def rows_of(out, suite, problems, planners, iterations, run=run, jobs=1, **environment):
    words = ("--problems", problems, "--planners", ",".join(planners), "--iterations", iterations)
    run(("reproduce", suite, *words, "--cutoff", 60, "--jobs", jobs, "--out", out), **environment)
    return read_rows(out / RUNS_FILE)


def repeated(what, suite, planners, iterations, ci, long):
    promise = "rows repeat: in two workers, three threads, with another hash seed"
    mark = pytest.mark.promise(promise, "problems", ci=ci, long=long)
    return pytest.param(suite, planners, iterations, marks=mark, id=what)


EVERY = (*PLANNERS, *declared("control"))
CASES = (
    repeated("four planners", "place-task", SOME, 300, ci=1, long=12),
    repeated("all planners and controls", "place-task", EVERY, 3000, ci=0, long=8),
    # few iterations: with 3000, `ompl-projected` reaches the time limit in a phase without a path
    repeated("tasks of several phases", "multi-sequence", tuple(PLANNERS), 200, ci=0, long=1),
)


# in this process, and in one with two workers, more threads and another hash seed
@pytest.mark.parametrize(("suite", "planners", "iterations"), CASES)
def test_rows_repeat(suite, planners, iterations, tmp_path, trials):
    how = (suite, trials, planners, iterations)
    one = rows_of(tmp_path / "one", *how, run=run_here)
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "PYTHONHASHSEED"), "3")
    several = rows_of(tmp_path / "several", *how, jobs=2, **threads)
    assert len(one) >= trials * len(planners) and differences(one, several) == []


@pytest.mark.promise(
    "a system clock that jumps by an hour changes no row", "problems", ci=0, long=8
)
def test_jumping_clock(tmp_path, trials):
    source, library = tmp_path / "jumping.c", tmp_path / "jumping.so"
    source.write_text(JUMPING)
    subprocess.run(("cc", "-shared", "-fPIC", "-o", library, source, "-ldl"), check=True)
    how = ("place-task", trials, ("birrt", "ompl-projected", "roadmap-cvq"), 3000)
    steady = rows_of(tmp_path / "steady", *how)
    began = time.monotonic()
    jumping = rows_of(tmp_path / "jumping", *how, LD_PRELOAD=str(library))
    most = time.monotonic() - began
    times = [value for row in jumping for name, value in vars(row).items() if name.startswith("t_")]
    assert all(value is None or 0.0 <= value <= most for value in times)
    assert differences(steady, jumping) == []
