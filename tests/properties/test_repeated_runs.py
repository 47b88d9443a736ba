"""The same command gives the same rows, times aside, whatever workers, threads, hash seed and system clock."""

import subprocess
import time

import pytest
from command_line import run
from made_rows import differences

from cvqmpt_lab.methods.table import CONTROLS, PLANNERS
from cvqmpt_lab.results.row import RUNS_FILE, read_rows

SOME = ("birrt", "ompl-projected", "mpnet", "cvq-mpt")
JUMPING = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <sys/time.h>
#include <time.h>
static long jump(void) { static unsigned n; n = n * 1103515245u + 12345u; return (long)(n >> 8) % 7200 - 3600; }
int clock_gettime(clockid_t id, struct timespec *t) {
    int (*real)(clockid_t, struct timespec *) = dlsym(RTLD_NEXT, "clock_gettime");
    int code = real(id, t);
    if (id == CLOCK_REALTIME) t->tv_sec += jump();
    return code;
}
int gettimeofday(struct timeval *t, void *zone) {
    struct timespec now;
    int code = clock_gettime(CLOCK_REALTIME, &now);
    t->tv_sec = now.tv_sec, t->tv_usec = now.tv_nsec / 1000;
    return code;
}
time_t time(time_t *t) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (t) *t = now.tv_sec;
    return now.tv_sec;
}
"""  # between a process and its C library: the date jumps by up to an hour whenever it is asked for


def rows_of(out, suite, problems, planners, iterations, jobs=1, cutoff=60, **environment):
    words = ("--problems", problems, "--planners", ",".join(planners), "--iterations", iterations)
    run(("reproduce", suite, *words, "--cutoff", cutoff, "--jobs", jobs, "--out", out), **environment)
    return read_rows(out / RUNS_FILE)


def repeated(what, suite, planners, iterations, ci, long):
    mark = pytest.mark.promise(f"rows repeat: {what}", "problems", ci=ci, long=long)
    return pytest.param(suite, planners, iterations, marks=mark, id=what)


@pytest.mark.parametrize(
    ("suite", "planners", "iterations"),
    [
        repeated("four planners", "place-task", SOME, 300, ci=1, long=12),
        repeated("all planners and controls", "place-task", (*PLANNERS, *CONTROLS), 3000, ci=0, long=8),
        repeated("tasks of several phases", "multi-sequence", tuple(PLANNERS), 3000, ci=0, long=1),
    ],
)
def test_rows_repeat(suite, planners, iterations, tmp_path, trials):
    one, several = (
        rows_of(tmp_path / str(jobs), suite, trials, planners, iterations, jobs,
                OPENBLAS_NUM_THREADS=threads, OMP_NUM_THREADS=threads, PYTHONHASHSEED=threads)
        for jobs, threads in ((1, "1"), (2, "3"))
    )  # fmt: skip
    assert len(one) >= trials * len(planners) and differences(one, several) == []


@pytest.mark.promise("a system clock that jumps by an hour changes no row", "problems", ci=0, long=8)
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
