"""Stills, task pictures, viewpoints and the rasteriser: size, place and depth of what is shown."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image
from rerun.chunk import RrdReader

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.show import film, task_frames
from cvqmpt_lab.show.picture import NAME_LETTERS, Label, draw_solution, draw_task, strip
from cvqmpt_lab.show.recording import TASK_TIMELINE, log_task
from experiments.suites.multi_sequence import CAN_NAME
from experiments.suites.place_task import DOOR


def test_picture_has_the_size_and_shows_the_trace(solution, tmp_path):
    draw_solution(solution, tmp_path / "a.png", (180, 120), ghosts=1)
    image = imread(tmp_path / "a.png")
    assert image.shape[:2] == (120, 180)
    orange = image[..., 0] - image[..., 2] > 0.35  # nothing but the trace is that colourful
    assert orange.sum() > 20
    draw_solution(replace(solution, simplified=None), tmp_path / "b.png", (180, 120))
    assert not (np.subtract(*imread(tmp_path / "b.png").T[[0, 2]]) > 0.35).any()


def test_unwritable_picture_is_refused(unsolved, tmp_path):
    with pytest.raises(InvalidInputError, match=r"cannot write .*missing"):
        draw_solution(unsolved, tmp_path / "missing" / "a.png", (3, 2))
    with pytest.raises(InvalidInputError, match=r"size \(0, 5\)"):
        draw_solution(unsolved, tmp_path / "a.png", (0, 5))
    assert not list(tmp_path.iterdir())


def test_pictures_and_recording(task_solution, tmp_path, monkeypatch):
    phases = [outcome.phase.name for outcome in task_solution.outcomes]
    monkeypatch.setattr(task_frames, "PERIOD", 1.0)
    monkeypatch.setattr(film, "TASK_FRAMES", 8)
    names = draw_task(task_solution, tmp_path / "task.png", size=(60, 40))
    assert names == ["start", *phases]
    height = 40 + len(strip([Label("1  start")], 60, NAME_LETTERS))
    assert imread(tmp_path / "task.png").shape[:2] == (2 * height + 6, 3 * 60 + 2 * 6)
    film.film_task(task_solution, tmp_path / "task.gif", size=(60, 40))
    with Image.open(tmp_path / "task.gif") as moving:
        assert moving.n_frames > len(phases)
    log_task(task_solution, tmp_path / "task.rrd")
    moments: dict[str, int] = {}
    for chunk in RrdReader(tmp_path / "task.rrd").stream():
        if TASK_TIMELINE in chunk.timeline_names:
            moments[chunk.entity_path] = moments.get(chunk.entity_path, 0) + chunk.num_rows
    assert moments.pop("/phase") == len(task_solution.task.phases)
    assert f"/world/moving/{CAN_NAME}" in moments and f"/world/moving/{DOOR}/handle_bar" in moments
    assert "/world/robot/panda_leftfinger_0" in moments and "/world/moving/mustard_bottle" not in moments
    duration = sum(outcome.trajectory.duration for outcome in task_solution.outcomes)
    assert set(moments.values()) == {len(list(task_frames.frames(task_solution)))}
    assert min(moments.values()) > duration / task_frames.PERIOD
