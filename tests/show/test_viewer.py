"""The viewer listens on the loopback address only, and says at once when it cannot be opened."""

import stat
import time

import pytest

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.show import viewer
from cvqmpt_lab.show.recording import log_solution
from cvqmpt_lab.show.viewer import open_viewer


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """A program "rerun" beside Python, whose script the test writes."""
    program = tmp_path / "rerun"
    monkeypatch.setattr(viewer.sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("DISPLAY", ":99")

    def write(script):
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(program.stat().st_mode | stat.S_IEXEC)

    return write


def test_without_a_display_it_is_refused_before_anything_is_logged(unsolved, monkeypatch):
    monkeypatch.setattr(viewer.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InvalidInputError, match=r"no display.*open it elsewhere with: rerun RUN\.rrd"):
        log_solution(unsolved, view=True)


def test_the_viewer_is_bound_to_the_loopback_address(stand_in, tmp_path, monkeypatch):
    monkeypatch.setattr(viewer, "SETTLE_SECONDS", 0.5)
    stand_in(f'echo "$@" > {tmp_path}/told; sleep 2')
    began = time.perf_counter()
    open_viewer(tmp_path / "run.rrd")
    assert time.perf_counter() - began < 1.9  # it is not waited for
    assert (tmp_path / "told").read_text().split() == [
        *("--bind", "127.0.0.1", "--port", "auto"),
        str(tmp_path / "run.rrd"),
    ]


def test_a_viewer_that_gives_up_is_an_error(stand_in, tmp_path):
    stand_in("echo 'no graphics device' >&2; exit 3")
    with pytest.raises(InvalidInputError, match=r"cannot open the rerun viewer \(no graphics device\)"):
        open_viewer(tmp_path / "run.rrd")
