"""Films have a picture for each moment; errors if they cannot be written."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.show.picture import film_solution, save_film

FRAMES = [np.full((21, 31, 3), shade, np.uint8) for shade in (0, 90, 250)]


def test_the_robot_moves_from_start_to_goal(solution, tmp_path):
    film_solution(solution, tmp_path / "a.gif", (120, 80), pictures=5)
    with Image.open(tmp_path / "a.gif") as shown:
        assert shown.n_frames >= 5
        shown.seek(0)
        first = np.array(shown.convert("RGB"), dtype=int)
        shown.seek(shown.n_frames - 1)
        assert (
            np.abs(np.array(shown.convert("RGB"), dtype=int) - first).max(axis=2) > 60
        ).sum() > 50


def test_films_that_cannot_be_written_are_refused(tmp_path):
    with pytest.raises(UnknownChoiceError, match=r"'\.avi'; valid choices: \.gif"):
        save_film(FRAMES, Path("a.avi"))
    with pytest.raises(InvalidInputError, match="cannot write"):
        save_film(FRAMES, tmp_path / "missing" / "a.gif")
