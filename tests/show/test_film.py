"""Films hold a picture for each moment; what cannot be written is refused before anything is drawn."""

import shutil
import stat
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.show import film
from cvqmpt_lab.show.film import check_film, film_solution, save_film

FRAMES = [np.full((21, 31, 3), shade, np.uint8) for shade in (0, 90, 250)]


def test_the_robot_moves_from_start_to_goal(solution, tmp_path, monkeypatch):
    monkeypatch.setattr(film, "FRAMES", 4)
    film_solution(solution, tmp_path / "a.gif", (120, 80))
    with Image.open(tmp_path / "a.gif") as shown:
        assert shown.n_frames >= 5
        shown.seek(0)
        first = np.array(shown.convert("RGB"), dtype=int)
        shown.seek(shown.n_frames - 1)
        assert (
            np.abs(np.array(shown.convert("RGB"), dtype=int) - first).max(axis=2) > 60
        ).sum() > 50


def test_mp4_is_written_through_ffmpeg(tmp_path, monkeypatch):
    """A stand-in for ffmpeg keeps what it is given: three pictures and the rests, of even size."""
    program = tmp_path / "bin" / "ffmpeg"
    program.parent.mkdir()
    program.write_text('#!/bin/sh\nfor out; do :; done\ncat > "$out"\n')
    program.chmod(program.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setenv("PATH", f"{program.parent}:/usr/bin:/bin")
    save_film(FRAMES, tmp_path / "a.mp4")
    assert (tmp_path / "a.mp4").stat().st_size == (len(FRAMES) + film.REST) * 20 * 30 * 3
    program.write_text("#!/bin/sh\necho 'Unknown encoder' >&2\nexit 1\n")
    with pytest.raises(InvalidInputError, match=r"ffmpeg says 'Unknown encoder'; save a .gif"):
        save_film(FRAMES, tmp_path / "b.mp4")
    assert not (tmp_path / "b.mp4").exists()


def test_films_that_cannot_be_written_are_refused(tmp_path, monkeypatch):
    with pytest.raises(UnknownChoiceError, match=r"'\.avi'; valid choices: \.gif, \.mp4"):
        check_film(Path("a.avi"))
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(InvalidInputError, match=r"no ffmpeg is installed; save a \.gif"):
        check_film(Path("a.mp4"))
    with pytest.raises(InvalidInputError, match="cannot write"):
        save_film(FRAMES, tmp_path / "missing" / "a.gif")
