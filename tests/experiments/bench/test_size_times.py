"""`cvqmpt bench sizes`: larger scenes are the same boxes in pieces, clouds lie on their faces."""

import numpy as np

from cvqmpt_lab.experiments.bench import size_times
from cvqmpt_lab.experiments.bench.stage_times import CpuClock

BOXES = [(np.array([0.5, 0.0, 0.3]), np.array([0.2, 0.1, 0.4]))]


def test_pieces_fill_the_box_and_points_lie_on_its_faces():
    pieces = size_times._pieces(BOXES[0], (5, 2, 1))
    assert len(pieces) == 10
    centre, size = BOXES[0]
    corners = [middle + sign * piece / 2 for middle, piece in pieces for sign in (-1, 1)]
    np.testing.assert_allclose(np.min(corners, axis=0), centre - size / 2)
    np.testing.assert_allclose(np.max(corners, axis=0), centre + size / 2)
    np.testing.assert_allclose(sum(np.prod(piece) for _, piece in pieces), np.prod(size))
    points = size_times._points(BOXES, 100, np.random.default_rng(0))
    np.testing.assert_allclose(np.max(np.abs(points - centre) / size, axis=1), 0.5)


def test_every_size_is_planned_once(monkeypatch):
    planned = {}

    def recorded(clock, problem, prefix):
        assert isinstance(clock, CpuClock)
        planned[prefix] = problem

    monkeypatch.setattr(size_times, "plan_stages", recorded)
    assert size_times.size_times(1) == []
    boxes = [f"{10**k} boxes: " for k in (1, 2, 3, 4)]
    points = [f"10^{k} points: " for k in (3, 4, 5, 6)]
    joints = [f"{count} joints: " for count in (2, 4, 7, 14)]
    assert list(planned) == [*boxes, *points, *joints]
    assert len(planned["1000 boxes: "].scene.objects) == 1000
    assert planned["14 joints: "].robot.dof == 14
