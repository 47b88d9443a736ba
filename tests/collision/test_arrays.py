"""The collision arrays of robots, kept on disk."""

import tempfile
import threading

import numpy as np
import pytest

from cvqmpt_lab import caches
from cvqmpt_lab.collision import arrays, geometry
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.scene.shapes import Box


def test_a_robots_arrays_are_made_once_and_the_same_from_disk_unless_the_file_is_damaged(
    slider_arm, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    made = []
    monkeypatch.setattr(
        arrays, "robot_geometry", lambda *a: made.append(a) or geometry.robot_geometry(*a)
    )

    def stored(length):
        bar = Attachment("bar", Box((0.1, 0.1, length)), pose((0.0, 0.0, 0.1)))
        return arrays.robot_arrays.__wrapped__(slider_arm, (bar,))

    first, again = stored(0.12), stored(0.12)
    assert len(made) == 1 and type(again) is type(first) and type(again.largest) is float
    for one, other in zip((*first.pieces, *first[1:]), (*again.pieces, *again[1:]), strict=True):
        np.testing.assert_array_equal(one, other)
        assert np.asarray(one).dtype == np.asarray(other).dtype
    (path,) = (tmp_path / "cvqmpt_lab" / "robot_geometry").iterdir()
    for damaged in (path.read_bytes()[:-200], b"", b"no arrays"):
        path.write_bytes(damaged)
        assert stored(0.12).largest == first.largest
    path.chmod(0o666)
    with pytest.warns(UserWarning, match="others can write"):
        monkeypatch.setattr(caches, "_WARNED", threading.Event())
        assert stored(0.12).largest == first.largest
    path.chmod(0o644)
    assert len(made) == 5
    assert len(stored(0.4).sphere) > len(first.sphere)
