"""Damaged files give a clear error or a correct result: no crash, no hang, no memory beyond the file's size."""

import numpy as np
import pytest
import trimesh
from damaged_files import KINDS, tried

from cvqmpt_lab.scene.mesh_files import read_triangles


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_damaged_scans_and_settings(name, tmp_path, part):
    seeds = part(range(3000), 200)
    data, read = KINDS[name]
    came = tried(tmp_path / name, seeds, data, read)
    assert came.good > 0 and came.refused > 0


def check_triangles(path):
    corners = read_triangles(path)
    assert corners.shape[1:] == (3, 3) and np.isfinite(corners).all()


@pytest.mark.parametrize("suffix", ["stl", "obj", "dae"])
def test_damaged_meshes(suffix, tmp_path):
    data = trimesh.creation.annulus(0.4, 0.5, 1.0, sections=8).export(file_type=suffix)
    data = data.encode() if isinstance(data, str) else data
    tried(tmp_path / f"a.{suffix}", range(60), data, check_triangles)
