"""Runs that are killed at any moment: the same command completes them, and nothing is lost, repeated or damaged."""

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.results.row import RUNS_FILE, read_rows
from cvqmpt_lab.training.shards import INDEX_FILE, SHARDS_FOLDER, finished_shards
from experiments.trust import command
from experiments.trust.check import Check, Trial
from experiments.trust.determinism import untimed

REPRODUCE = (
    "reproduce",
    "place-task",
    "--problems",
    3,
    "--planners",
    "birrt",
    "--iterations",
    300,
    "--jobs",
    2,
)
GENERATE = ("data", "generate", "--scenes", 48, "--paths-per-scene", 1, "--family", "table", "--jobs", 2)


def _rows(out: Path) -> object:
    return [untimed(row) for row in read_rows(out / RUNS_FILE)]


def _shards(out: Path) -> object:
    files = sorted((out / SHARDS_FOLDER).iterdir())
    return [(file.name, file.read_bytes()) for file in files], (out / INDEX_FILE).read_bytes()


def _kept_shards(out: Path) -> set[object]:
    with contextlib.suppress(CvqmptError):
        return set(finished_shards(out))
    return set()


def killed(
    words: tuple[object, ...], result: Callable[[Path], object], kept: Callable[[Path], set], kills: int
) -> Trial:
    """Kill a command so often, at moments spread over its time, each time continuing it; compare the end."""
    faults: list[str] = []
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as parent:
        began = time.monotonic()
        _finish(words, Path(parent) / "whole")
        seconds = time.monotonic() - began
        whole, done, turn = result(Path(parent) / "whole"), 0, 0
        while done < kills:
            turn += 1
            out = Path(parent) / f"killed-{turn}"
            before: set[object] = set()
            for _ in range(min(4, kills - done)):
                process = command.start((*words, "--out", out))
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.communicate(timeout=seconds * rng.uniform(0.2, 1.0))
                process.kill()
                process.communicate()
                done += 1
                if _left(process.pid):
                    faults.append(f"kill {done}: a worker outlived its parent")
                now = kept(out) if out.is_dir() else set()
                if before - now:
                    faults.append(f"kill {done}: finished work was lost")
                before = now
            _finish(words, out)
            if result(out) != whole:
                faults.append(
                    f"folder {turn}, after kill {done}: its end is not that of an uninterrupted run"
                )
            if left := [path.name for path in out.rglob(".*")]:
                faults.append(f"folder {turn}: left behind {left[:3]}")
    return Trial(kills, faults)


def _finish(words: tuple[object, ...], out: Path) -> None:
    done = command.run((*words, "--out", out))
    if done.returncode:
        raise RuntimeError(f"{words} ended with {done.returncode}: {done.stderr[-400:]}")


def _left(session: int) -> bool:
    """Whether a process of a session is still there two seconds later; it is ended then."""
    for _ in range(40):
        try:
            os.killpg(session, 0)
        except ProcessLookupError:
            return False
        time.sleep(0.05)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(session, signal.SIGKILL)
    return True


CHECKS = (
    Check(
        "kill -9 of data generation",
        "kills",
        short=2,
        long=50,
        attack=lambda kills: killed(GENERATE, _shards, _kept_shards, kills),
    ),
    Check(
        "kill -9 of a reproduction",
        "kills",
        short=2,
        long=50,
        attack=lambda kills: killed(REPRODUCE, _rows, lambda out: set(), kills),
    ),
)
