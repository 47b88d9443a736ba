"""What an external planner started ends with it, however it was made and however it ends."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import environment

from cvqmpt_lab.external.process import PlannerProcess

# a pool, a process in another session, a daemon, and one that ignores signals; two are stopped
PLANNER = """
import multiprocessing, os, signal, subprocess, sys
pool = multiprocessing.get_context("fork").Pool(2)
wait = "import signal, time; signal.signal(15, signal.SIG_IGN); time.sleep(600)"
started = [
    subprocess.Popen([sys.executable, "-c", wait], start_new_session=own).pid for own in (0, 1)
]
read, write = os.pipe()
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        os.write(write, b"%d" % os.getpid())
        os.execv(sys.executable, [sys.executable, "-c", wait])
    os._exit(0)
started.append(int(os.read(read, 20)))
started += [worker.pid for worker in pool._pool]
for number in started[:2]:
    os.kill(number, signal.SIGSTOP)
with open(os.environ["STARTED"], "w") as file:
    file.write(" ".join(map(str, [*started, os.getpid()])))
print("one line", file=sys.stderr)

def plan(problem, budget, seed):
    return None
"""
OWNER = """
import os, signal, sys
from cvqmpt_lab.external.process import PlannerProcess
process = PlannerProcess("pooled:plan", "pooled", "plan")
process.start()
print("started", flush=True)
END
"""


@pytest.fixture
def pooled(tmp_path, monkeypatch):
    """A module with the planner; returns the file with the ids of what it starts."""
    (tmp_path / "pooled.py").write_text(PLANNER)
    monkeypatch.setenv("STARTED", str(tmp_path / "started"))
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path / "started"


def living(file):
    """Ids of processes of a file that still run."""
    found = []
    for number in file.read_text().split():
        stat = Path("/proc", number, "stat")
        if stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z":
            found.append(int(number))
    return found


pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="orphans are found on Linux only")


def test_all_that_a_planner_started_ends_when_it_is_stopped(pooled, capfd):
    process = PlannerProcess("pooled:plan", "pooled", "plan")
    process.start()
    assert len(living(pooled)) == 6
    began = time.monotonic()
    process.stop()
    assert living(pooled) == [] and time.monotonic() - began < 5.0
    assert "one line" in capfd.readouterr().err and process.note() == ""


@pytest.mark.parametrize(
    ("end", "code"),
    [
        ("", 0),
        ("os._exit(0)", 0),
        ("os.kill(os.getpid(), 9)", -signal.SIGKILL),
        ("os.kill(process._planner, 9); os._exit(0)", 0),
    ],
)
def test_all_ends_with_its_run_and_keeps_no_pipe_of_it_open(pooled, end, code):
    """`cvqmpt reproduce ... | tail` did not end: a stopped pool kept standard error open."""
    paths = os.pathsep.join((str(pooled.parent), environment()["PYTHONPATH"]))
    done = subprocess.run(
        [sys.executable, "-c", OWNER.replace("END", end)],
        env=environment(PYTHONPATH=paths),
        capture_output=True,  # waits until nothing holds the pipes
        text=True,
        timeout=60.0,
    )
    assert done.returncode == code and "started" in done.stdout
    until = time.monotonic() + 5.0
    while living(pooled) and time.monotonic() < until:
        time.sleep(0.01)
    assert living(pooled) == []
