"""Runs that are killed at any moment: the same command completes them, and nothing is lost, repeated or damaged."""

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from experiments.trust import clock, command, surroundings
from experiments.trust.check import Check, Trial
from experiments.trust.commands import GENERATE, REPRODUCE, Command, training


def killed(what: Command, kills: int) -> Trial:
    """Kill a command so often, at moments spread over its time, each time continuing it; compare the end."""
    faults: list[str] = []
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as parent:
        began = time.monotonic()
        what.finish(Path(parent) / "whole")
        seconds = time.monotonic() - began
        whole, done, turn = what.result(Path(parent) / "whole"), 0, 0
        while done < kills:
            turn += 1
            out = Path(parent) / f"killed-{turn}"
            before: set[object] = set()
            for _ in range(min(4, kills - done)):
                process = command.start((*what.words, "--out", out))
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.communicate(timeout=seconds * rng.uniform(0.2, 1.0))
                process.kill()
                process.communicate()
                done += 1
                if _left(process.pid):
                    faults.append(f"kill {done}: a worker outlived its parent")
                now = what.kept(out) if out.is_dir() else set()
                if before - now:
                    faults.append(f"kill {done}: finished work was lost")
                before = now
            what.finish(out)
            if what.result(out) != whole:
                faults.append(
                    f"folder {turn}, after kill {done}: its end is not that of an uninterrupted run"
                )
            if left := [path.name for path in out.rglob(".*")]:
                faults.append(f"folder {turn}: left behind {left[:3]}")
    return Trial(kills, faults)


def _killed_training(kills: int) -> Trial:
    with training() as train:
        return killed(train, kills)


def _left(session: int) -> bool:
    """Whether a process of a session is still there ten seconds later; it is ended then."""
    for _ in range(200):
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
        long=40,
        attack=lambda kills: killed(GENERATE, kills),
    ),
    Check(
        "kill -9 of a reproduction",
        "kills",
        short=2,
        long=30,
        attack=lambda kills: killed(REPRODUCE, kills),
    ),
    Check("kill -9 of a training", "kills", short=0, long=30, attack=_killed_training),
    *surroundings.CHECKS,
    *clock.CHECKS,
)
