"""The rerun viewer, a separate program that listens on the loopback address only."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from cvqmpt_lab.errors import InvalidInputError


def check_viewer() -> None:
    """Raise InvalidInputError if no window can be opened here."""
    windows = not sys.platform.startswith("linux")
    if not (windows or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InvalidInputError(
            "no display to open the rerun viewer on: save a recording here (RUN.rrd) and open it "
            "elsewhere with: rerun RUN.rrd"
        )


def open_viewer(recording: Path, settle: float = 2.0) -> None:
    """Open a .rrd file in the viewer of rerun-sdk, which stays open after this program.

    settle: time [s] after which it is left alone; one that cannot open its window gives up sooner.
    """
    check_viewer()
    program = shutil.which("rerun", path=str(Path(sys.executable).parent)) or shutil.which("rerun")
    if program is None:
        raise InvalidInputError(
            "cannot open the rerun viewer: no program 'rerun'; install rerun-sdk"
        )
    command = [program, "--bind", "127.0.0.1", "--port", "auto", str(recording)]
    viewer = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )
    try:
        _, errors = viewer.communicate(timeout=settle)
    except subprocess.TimeoutExpired:
        return
    if viewer.returncode != 0:
        reason = " ".join(errors.split())[-200:] or f"exit code {viewer.returncode}"
        raise InvalidInputError(
            f"cannot open the rerun viewer ({reason}): save a file (RUN.rrd) and open it elsewhere"
        )
