"""Commands interrupted at any moment: the same command completes the folder with equal content.

A round has a full disk, kill -9 and a second run in the folder; then the command runs again.
"""

import contextlib
import csv
import ctypes
import json
import os
import resource
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from command_line import run, run_here, start
from made_rows import untimed

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.base.files import locked
from cvqmpt_lab.benchmarks.results.row import RUNS_FILE, read_rows
from cvqmpt_lab.training.shards import shard_files

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1  # of Linux
START = 1.0  # [s] that a process takes to start
ORPHANS_END = 10.0  # [s] after which no worker may live on


class Command(NamedTuple):
    words: tuple  # of `cvqmpt WORDS --out DIR`
    result: Callable[[Path], object]  # what must be the same in the end
    kept: Callable[[Path], set]  # what is finished in a folder, and must never be lost
    run: Callable = run  # runs a command to its end where neither kill nor full disk is at work


def shards(out):
    return {path.name: path.read_bytes() for path in shard_files(out)}


def curves(out):
    """Lines of the training curves without their times."""
    if not (out / "curves.csv").is_file():
        return []
    with (out / "curves.csv").open(newline="") as file:
        return [tuple(v for k, v in row.items() if k != "seconds") for row in csv.DictReader(file)]


def trained(out):
    return [path.read_bytes() for path in sorted(out.glob("model/*.safetensors"))], curves(out)


def reproduce(folder):
    options = "--problems 3 --planners birrt --iterations 300 --jobs 2"
    words = ("reproduce", "place-task", *options.split())
    return Command(words, untimed_rows, lambda out: set(), run_here)


def untimed_rows(out):
    return [*map(untimed, read_rows(out / RUNS_FILE))]


def generate(folder):
    options = "--scenes 48 --paths-per-scene 1 --family table --jobs 2"
    return Command(("data", "generate", *options.split()), shards, lambda out: {*shards(out)})


def train(folder):
    """A dictionary's training of twelve short epochs, saved after each, on data made for it."""
    from cvqmpt_lab.training.profiles import profile_named  # imports torch

    smoke, data, config = profile_named("smoke"), folder / "data", folder / "profile.json"
    few = {"epochs": 12, "batches_per_epoch": 5, "restart_every": 7, "restart_epochs": 9}
    stage1 = replace(smoke.stage1, **few)
    run((*generate(folder).words, "--out", data))
    config.write_text(json.dumps(to_plain(replace(smoke, stage1=stage1), complete=True)))
    words = ("train", "stage1", "--config", config, "--data", data, "--device", "cpu")
    return Command(words, trained, lambda out: set(curves(out)))


def broken_off(what, command, ci, long):
    promise = f"{what} survives a full disk, kill -9 and a second run in its folder"
    mark = pytest.mark.promise(promise, "rounds", ci=ci, long=long)
    return pytest.param(command, marks=mark, id=what)


COMMANDS = (
    broken_off("a reproduction", reproduce, ci=1, long=20),
    broken_off("data generation", generate, ci=0, long=20),
    broken_off("a training", train, ci=0, long=15),
)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_same_command_completes_it(command, tmp_path, trials):
    command, whole, rng = command(tmp_path), tmp_path / "whole", np.random.default_rng(0)
    began = time.monotonic()
    command.run((*command.words, "--out", whole))
    seconds = START + time.monotonic() - began
    largest = max(path.stat().st_size for path in whole.rglob("*") if path.is_file())
    for turn in range(trials):
        words, out = (*command.words, "--out", tmp_path / f"{turn}"), tmp_path / f"{turn}"
        disk_full(words, int(rng.uniform(0, largest)))
        finished = command.kept(out)
        killed(words, seconds * rng.uniform(0.2, 1.0))
        assert finished <= command.kept(out), "finished work was lost"
        with locked(out):
            command.run(words, code=2)
        command.run(words)
        assert command.result(out) == command.result(whole)
        assert list(out.rglob(".*")) == [], "temporary files are left"


def disk_full(words, most):
    """Limit file sizes to `most` [bytes], less than the command writes."""
    limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (most, most))
    line = last_line(run(words, limit, code=2))
    assert "File too large" in line or "No space left" in line


def killed(words, seconds):
    process = start(words)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.communicate(timeout=seconds)
    process.kill()
    process.communicate()
    until = time.monotonic() + ORPHANS_END
    with contextlib.suppress(ProcessLookupError):
        while time.monotonic() < until:
            os.killpg(process.pid, 0)
            time.sleep(0.05)
        raise AssertionError("a worker outlived its parent")


def last_line(err):
    line = err.strip().splitlines()[-1]
    assert line.startswith("cvqmpt: ")
    return line


@pytest.mark.promise("a folder that is read-only: refused in a line", "commands", ci=0, long=2)
def test_read_only(tmp_path, trials):
    tmp_path.chmod(0o555)
    for command in (reproduce, generate)[:trials]:
        words = (*command(tmp_path).words, "--out", tmp_path / "out")
        assert "Permission denied" in last_line(run(words, obey_permissions, code=2))
    tmp_path.chmod(0o755)


def obey_permissions():
    """Make root obey file permissions; no effect for other users."""
    ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE)
