"""The command line as others run it: a process of its own."""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def environment(**changes: str) -> Mapping[str, str]:
    """The environment of this process, with changes, in which commands import the code that runs here."""
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": paths, **changes}


def start(
    words: Sequence[object], before: Callable[[], None] | None = None, **changes: str
) -> subprocess.Popen[str]:
    """Start `cvqmpt WORDS` with changes of the environment, its output piped, in a session of its own.

    before: called in the new process, which the command then takes over.
    """
    return subprocess.Popen(
        [sys.executable, "-m", "cli.main", *map(str, words)],
        env=environment(**changes),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=before,
    )


def run(
    words: Sequence[object], before: Callable[[], None] | None = None, **changes: str
) -> subprocess.CompletedProcess[str]:
    """Run `cvqmpt WORDS` to its end, as `start` starts it."""
    process = start(words, before, **changes)
    out, err = process.communicate()
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)
