"""Stills, task pictures, viewpoints and the rasteriser: size, place and depth of what is shown."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image
from rerun.chunk import RrdReader

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.shapes import Box, Sphere
from cvqmpt_lab.show import film, task_frames
from cvqmpt_lab.show.meshes import Viewpoint, joined, rasterise, shape_mesh
from cvqmpt_lab.show.picture import NAME_LETTERS, Label, draw_solution, draw_task, strip
from cvqmpt_lab.show.recording import TASK_TIMELINE, log_task
from cvqmpt_lab.show.stage import AZIMUTHS, clear_viewpoint, framed
from experiments.suites.multi_sequence import CAN_NAME
from experiments.suites.place_task import DOOR, carried_can


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
        draw_solution(unsolved, tmp_path / f"{name}.png", (180, 120), carried=carried)
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


SIZE = (300, 200)
WHITE = (1.0, 1.0, 1.0)


@pytest.mark.parametrize("azimuth", AZIMUTHS[:4])
def test_all_points_are_in_the_picture(azimuth):
    points = np.random.default_rng(0).normal(size=(50, 3)) * (1.0, 0.3, 2.0)
    column, row, depth = np.moveaxis(framed(points, azimuth, SIZE).screen(points, SIZE[::-1]), -1, 0)
    assert (depth > 0).all()
    assert (column > 0).all() and (column < SIZE[0]).all() and (row > 0).all() and (row < SIZE[1]).all()
    assert max(np.ptp(column) / SIZE[0], np.ptp(row) / SIZE[1]) > 0.5


def test_a_wall_is_looked_past():
    ball = shape_mesh(Sphere(0.3))
    usual = clear_viewpoint([ball], [], SIZE)
    towards = np.subtract(usual.eye, usual.target)
    yaw = np.arctan2(towards[1], towards[0])
    wall = shape_mesh(Box((0.05, 0.7, 0.7))).placed(pose(0.5 * towards, yaw), WHITE)
    other = clear_viewpoint([ball], [wall], SIZE)
    assert np.dot(np.subtract(other.eye, other.target)[:2], towards[:2]) < 0.8 * np.dot(
        towards[:2], towards[:2]
    )


def test_rasterised_ball_has_the_right_place_size_and_depth():
    viewpoint, shape = Viewpoint((-2.0, 0.0, 0.0), (0.0, 0.0, 0.0), height_angle=0.6), (240, 320)
    ball = shape_mesh(Sphere(0.3)).placed(pose((0.0, 0.2, 0.1)), (1.0, 1.0, 1.0))
    view = rasterise(ball, viewpoint, shape)
    column, row, depth = viewpoint.screen(np.array([0.0, 0.2, 0.1]), shape)
    assert column < 160 and row < 120  # +y is left, +z is up
    assert [view.columns.mean(), view.rows.mean()] == pytest.approx([column, row], abs=2.0)
    radius = 120 / np.tan(0.3) * 0.3 / np.sqrt(depth**2 - 0.3**2)
    assert len(view.face) == pytest.approx(np.pi * radius**2, rel=0.05)
    assert view.depth.min() == pytest.approx(2.0 - 0.3, abs=0.01)
    ray = viewpoint.rays(view.rows, view.columns, shape)
    points = viewpoint.eye + view.depth[:, None] * ray
    np.testing.assert_allclose(np.linalg.norm(points - [0.0, 0.2, 0.1], axis=1), 0.3, atol=0.01)


def test_nearer_triangle_hides_the_farther_one():
    near, far = (
        shape_mesh(Box((0.1, size, size))).placed(pose((x, 0, 0)), (1.0, 1.0, 1.0))
        for x, size in ((0, 0.5), (1, 4))
    )
    view = rasterise(joined([far, near]), Viewpoint((-2.0, 0.0, 0.0), (0.0, 0.0, 0.0)), (41, 41))
    centre = (view.rows == 20) & (view.columns == 20)
    assert view.depth[centre] == pytest.approx(1.95)
    assert view.depth[(view.rows == 1) & (view.columns == 1)] == pytest.approx(2.95)
