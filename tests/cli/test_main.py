"""The whole command line: bad words give one line and exit code 2; help is fast, with examples."""

import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cli.main import COMMANDS, main

ROOT = Path(__file__).resolve().parents[2]


def test_help_is_fast():
    words, seconds = [sys.executable, "-m", "cli.main", "--help"], []
    for _ in range(3):
        began = time.perf_counter()
        subprocess.run(words, cwd=ROOT, capture_output=True, check=True)
        seconds.append(time.perf_counter() - began)
    assert statistics.median(seconds) < 1.5, "aim: 0.5 s; the rest is for busy machines"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_examples(capsys, command):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    out = capsys.readouterr().out
    assert end.value.code == 0 and "examples:\n  cvqmpt " in out


def test_as_a_process_an_error_is_one_line_without_traceback():
    words = [sys.executable, "-m", "cli.main", "plan", "nope"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == "" and len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("where", "code", "told"), [("/dev/full", 2, "cvqmpt: [Errno 28]"), ("closed", 141, "")]
)
def test_what_cannot_be_printed_is_no_success(where, code, told):
    words = [sys.executable, "-m", "cli.main", "problems", "list", "place-task", "--problems", "3"]
    if where == "closed":
        reading, writing = os.pipe()
        os.close(reading)
    else:
        writing = os.open(where, os.O_WRONLY)
    done = subprocess.run(words, cwd=ROOT, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (
        done.returncode == code
        and done.stderr.startswith(told)
        and len(done.stderr.splitlines()) == bool(told)
    )
