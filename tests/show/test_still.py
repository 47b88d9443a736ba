"""Pictures have the right size and show the right things."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.show.meshes import Viewpoint
from cvqmpt_lab.show.picture import draw_solution
from experiments.suites.place_task import carried_can


def test_picture_has_the_size_and_shows_the_trace(solution, tmp_path):
    draw_solution(solution, tmp_path / "a.png", (180, 120), ghosts=1)
    image = imread(tmp_path / "a.png")
    assert image.shape[:2] == (120, 180)
    orange = image[..., 0] - image[..., 2] > 0.35  # nothing but the trace is that colourful
    assert orange.sum() > 20
    draw_solution(replace(solution, simplified=None), tmp_path / "b.png", (180, 120))
    assert not (np.subtract(*imread(tmp_path / "b.png").T[[0, 2]]) > 0.35).any()


def test_what_the_hand_carries_is_drawn_where_the_problem_leaves_it_out(unsolved, tmp_path):
    for name, carried in (("without", ()), ("with", (carried_can(),))):
        draw_solution(unsolved, tmp_path / f"{name}.png", (180, 120), viewpoint=Viewpoint(), carried=carried)
    red = [
        np.sum(imread(tmp_path / f"{name}.png")[..., 0] - imread(tmp_path / f"{name}.png")[..., 1] > 0.3)
        for name in ("without", "with")
    ]
    assert red[0] == 0 and red[1] > 15


def test_unwritable_picture_is_refused(unsolved, tmp_path):
    with pytest.raises(InvalidInputError, match=r"cannot write .*missing"):
        draw_solution(unsolved, tmp_path / "missing" / "a.png", (3, 2))
    with pytest.raises(InvalidInputError, match=r"size \(0, 5\)"):
        draw_solution(unsolved, tmp_path / "a.png", (0, 5))
    assert not list(tmp_path.iterdir())
