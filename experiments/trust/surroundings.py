"""A full disk, a read-only folder, a second run in it: refused in one line."""

import ctypes
import resource
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from experiments.trust import command
from experiments.trust.check import Check, Trial
from experiments.trust.commands import GENERATE, REPRODUCE, Command, training

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1


@contextmanager
def _commands(count: int) -> Iterator[list[Command]]:
    """So many of: a reproduction, data generation and a training, in turn."""
    if count < 3:
        yield [REPRODUCE, GENERATE][:count]
        return
    with training() as train:
        yield ([REPRODUCE, GENERATE, train] * count)[:count]


def _refusal(code: int | None, err: str, *words: str) -> str:
    """What is wrong with how a command refused, or ""."""
    last = err.strip().splitlines()[-1] if err.strip() else ""
    if (
        code == 2
        and last.startswith("cvqmpt: ")
        and any(word in last for word in words)
        and "Traceback" not in err
    ):
        return ""
    return f"ended with {code}, {err[-300:]!r}"


def disk_full(count: int) -> Trial:
    """Let no file grow beyond a length drawn anew, then take the limit away: the same command must complete it."""
    rng, faults = np.random.default_rng(0), []
    with tempfile.TemporaryDirectory() as parent, _commands(count) as commands:
        for turn, what in enumerate(commands):
            whole, out = Path(parent) / f"{what.words[0]}", Path(parent) / f"full-{turn}"
            if not whole.exists():
                what.finish(whole)
            lengths = sorted(path.stat().st_size for path in whole.rglob("*") if path.is_file())
            most = int(rng.uniform(0, lengths[-1]))
            done = command.run(
                (*what.words, "--out", out),
                before=partial(resource.setrlimit, resource.RLIMIT_FSIZE, (most, most)),
            )
            if fault := _refusal(done.returncode, done.stderr, "File too large", "No space left"):
                faults.append(f"{what.words[0]}, files of {most} bytes at most: {fault}")
            what.finish(out)
            if what.result(out) != what.result(whole):
                faults.append(f"{what.words[0]}, files of {most} bytes at most: another result afterwards")
    return Trial(count, faults)


def read_only(count: int) -> Trial:
    """Name a folder in one that may not be written: refused before any work."""
    faults = []
    with tempfile.TemporaryDirectory() as parent, _commands(count) as commands:
        Path(parent).chmod(0o555)
        for what in commands:
            done = command.run((*what.words, "--out", Path(parent) / "out"), before=_obey_permissions)
            if fault := _refusal(done.returncode, done.stderr, "Permission denied"):
                faults.append(f"{what.words[0]}: {fault}")
        Path(parent).chmod(0o755)
    return Trial(count, faults)


def _obey_permissions() -> None:
    """Let root be as others are; of no effect for others."""
    ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE)


def second_run(count: int) -> Trial:
    """Start a command twice in one folder: the second refuses, the first does not notice."""
    faults = []
    with tempfile.TemporaryDirectory() as parent, _commands(count) as commands:
        for turn, what in enumerate(commands):
            whole, out = Path(parent) / f"{what.words[0]}", Path(parent) / f"twice-{turn}"
            if not whole.exists():
                what.finish(whole)
            first = command.start((*what.words, "--out", out))
            while not list(out.glob("*.json")) and first.poll() is None:  # written under the lock
                time.sleep(0.01)
            first.send_signal(signal.SIGSTOP)  # until the second one has looked
            second = command.run((*what.words, "--out", out))
            first.send_signal(signal.SIGCONT)
            first.communicate()
            if fault := _refusal(second.returncode, second.stderr, "is in use by another run"):
                faults.append(f"{what.words[0]}, the second: {fault}")
            if first.returncode or what.result(out) != what.result(whole):
                faults.append(f"{what.words[0]}, the first: ended with {first.returncode}, or another result")
    return Trial(count, faults)


def _check(promise: str, short: int, long: int, attack: Callable[[int], Trial]) -> Check:
    return Check(promise, "commands", short=short, long=long, attack=attack)


CHECKS = (
    _check("a full disk: refused in a line, completed later", 1, 60, disk_full),
    _check("a folder that is read-only: refused in a line", 2, 3, read_only),
    _check("two runs in one folder: the second refuses", 1, 3, second_run),
)
