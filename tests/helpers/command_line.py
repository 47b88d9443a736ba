"""Run commands in tests, in this process or in a new process."""

import os
import subprocess
import sys
from pathlib import Path

from cvqmpt_lab.cli.main import main

SCAN_START = "-0.9,0.3,0,-2.0,0,2.3,0.8"  # of the arm in the scan that tests share
ROOT = Path(__file__).resolve().parents[2]


def refused(capsys, *words):
    """Return the one line on standard error of a command that is refused."""
    code = main([str(word) for word in words])
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert code == 2 and len(lines) == 1 and captured.out == "", (code, captured)
    assert lines[0].startswith("cvqmpt: ")
    return lines[0]


def environment(**changes):
    """Return the environment with changes, in which commands import the code under test."""
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": paths, **changes}


def python(code, *words, **changes):
    """Run code in a new Python process, which must exit with 0; return its output."""
    command = [sys.executable, "-c", code, *map(str, words)]
    done = subprocess.run(command, env=environment(**changes), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def start(words, before=None, **changes):
    """Start `cvqmpt WORDS` in a session of its own; `before` is called in the new process first."""
    return subprocess.Popen(
        [sys.executable, "-m", "cvqmpt_lab.cli.main", *map(str, words)],
        env=environment(**changes),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=before,
    )


def run(words, before=None, code=0, **changes):
    """Run `cvqmpt WORDS` to its end, which must be `code`; returns standard error."""
    process = start(words, before, **changes)
    _, err = process.communicate()
    told = words, process.returncode, err[-400:]
    assert process.returncode == code and "Traceback" not in err, told
    return err


def run_here(words, code=0):
    """Run `cvqmpt WORDS` in this process."""
    assert main([*map(str, words)]) == code
