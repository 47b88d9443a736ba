"""Clouds that are written are read again, by their suffix."""

import numpy as np
import pytest

from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.scene.files.cloud_writing import WRITERS, write_cloud
from cvqmpt_lab.scene.files.clouds import read_cloud

POINTS = np.random.default_rng(0).uniform(-1, 1, (50, 3)).astype("f4").astype(float)


@pytest.mark.parametrize("suffix", WRITERS)
def test_what_was_written_is_read(suffix, tmp_path):
    write_cloud(tmp_path / f"cloud{suffix}", POINTS)
    np.testing.assert_array_equal(read_cloud(tmp_path / f"cloud{suffix}").points, POINTS)


def test_another_suffix_is_refused(tmp_path):
    with pytest.raises(UnknownChoiceError, match=r"'.obj'; valid choices: .pcd, .ply, .npy"):
        write_cloud(tmp_path / "cloud.obj", POINTS)
    assert not list(tmp_path.iterdir())
