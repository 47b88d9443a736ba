"""A system clock that jumps: plans under a budget in seconds are the same, and take times that can be."""

import subprocess
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from cvqmpt_lab.results.row import RUNS_FILE, ResultRow, read_rows
from experiments.trust import command
from experiments.trust.check import Check, Trial
from experiments.trust.determinism import differences

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
"""
"""Stands between a process and its C library: the date jumps by up to an hour whenever it is asked for."""
PLANNERS = ("birrt", "ompl-projected", "roadmap-cvq")
ENOUGH = 3000
"""Iterations, which end a plan that the clock does not end."""


def _run(problems: int, out: Path, changes: Mapping[str, str]) -> tuple[list[ResultRow], list[str]]:
    """Rows, and those whose times are none that a run can take."""
    words = ("reproduce", "place-task", "--problems", problems, "--planners", ",".join(PLANNERS))
    began = time.monotonic()
    budget = ("--cutoff", 60, "--iterations", ENOUGH)
    done = command.run((*words, *budget, "--jobs", 1, "--out", out), None, **changes)
    if done.returncode:
        raise RuntimeError(f"cvqmpt {words} ended with {done.returncode}: {done.stderr[-400:]}")
    rows, most = read_rows(out / RUNS_FILE), time.monotonic() - began
    times = [(row, name, value) for row in rows for name, value in vars(row).items() if name.startswith("t_")]
    return rows, [
        f"{row.key.problem} {row.key.planner}: {name} is {value} s, of {most:.0f} s"
        for row, name, value in times
        if value is not None and not 0.0 <= value <= most
    ]


def jumping_clock(problems: int) -> Trial:
    """Plan while the date jumps: rows are those of a steady clock."""
    with tempfile.TemporaryDirectory() as parent:
        source, shim = Path(parent) / "jumping.c", Path(parent) / "jumping.so"
        source.write_text(JUMPING)
        subprocess.run(("cc", "-shared", "-fPIC", "-o", shim, source, "-ldl"), check=True)
        steady, _ = _run(problems, Path(parent) / "steady", {})
        jumping, faults = _run(problems, Path(parent) / "jumping", {"LD_PRELOAD": str(shim)})
    return Trial(len(jumping), faults + differences(steady, jumping))


CHECKS = (
    Check(
        "a system clock that jumps by an hour changes no row", "rows", short=0, long=8, attack=jumping_clock
    ),
)
