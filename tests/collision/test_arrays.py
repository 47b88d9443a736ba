"""The collision arrays of robots, kept on disk."""

import tempfile
import threading

import numpy as np
import pytest

from cvqmpt_lab import caches
from cvqmpt_lab.collision import arrays, geometry
from cvqmpt_lab.collision.arrays import stored_robot_geometry
from cvqmpt_lab.collision.geometry import ShapeSpec
from cvqmpt_lab.collision.separation import BOX


def arm(length):
    shapes = [ShapeSpec(BOX, (0.1, 0.1, length), np.empty((0, 3)), np.eye(4)) for _ in range(3)]
    return shapes, [0, 1, 3], [(0, 2)]


def members(bundle):
    return [*bundle.pieces, *bundle[1:]]


def test_a_robots_arrays_are_made_once_and_the_same_from_disk_unless_the_file_is_damaged(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    made = []
    monkeypatch.setattr(
        arrays, "robot_geometry", lambda *a: made.append(a) or geometry.robot_geometry(*a)
    )
    first = stored_robot_geometry(*arm(0.6))
    again = stored_robot_geometry(*arm(0.6))
    assert len(made) == 1 and type(again) is type(first) and type(again.largest) is float
    for one, other in zip(members(first), members(again), strict=True):
        np.testing.assert_array_equal(one, other)
        assert np.asarray(one).dtype == np.asarray(other).dtype
    (path,) = (tmp_path / "cvqmpt_lab" / "robot_geometry").iterdir()
    for damaged in (path.read_bytes()[:-200], b"", b"no arrays"):
        path.write_bytes(damaged)
        assert stored_robot_geometry(*arm(0.6)).largest == first.largest
    path.chmod(0o666)
    with pytest.warns(UserWarning, match="others can write"):
        monkeypatch.setattr(caches, "_WARNED", threading.Event())
        assert stored_robot_geometry(*arm(0.6)).largest == first.largest
    path.chmod(0o644)
    assert len(made) == 5
    assert stored_robot_geometry(*arm(0.9)).largest > first.largest
