"""Damaged files give a clear error or a correct result: no crash, no hang, no memory beyond the file's size."""

import resource
import time

import numpy as np
import pytest
import trimesh
from cloud_files import GOOD

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.files.clouds import read_cloud
from cvqmpt_lab.scene.files.meshes import read_triangles

SLOWEST = 2.0  # [s] for one small file on a busy machine
MEMORY = 400 * 2**20  # [bytes] that the process may grow by


def mutated(data, rng):
    """The bytes with some changed, cut out, doubled, or numbers of the header made large."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        at = int(rng.integers(len(data) + 1))
        length = int(rng.integers(1, 40))
        change = rng.integers(6)
        if change == 0:
            data[at : at + length] = rng.bytes(length)
        elif change == 1:
            del data[at : at + length]
        elif change == 2:
            data[at:at] = data[at : at + length]
        elif change == 3:
            data = data[:at]
        elif change == 4:
            digits = [k for k in range(min(len(data), 600)) if 48 <= data[k] <= 57]
            if digits:
                k = digits[rng.integers(len(digits))]
                data[k : k + 1] = rng.choice([b"999999999999", b"-1", b"0", b"1e300", b"nan", b"4294967295"])
        elif len(data):
            data[at % len(data)] ^= 1 << int(rng.integers(8))
    return bytes(data)


def read_all(path, seeds, data, read):
    """Try mutated files; how many were read."""
    before, good = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, 0
    for seed in seeds:
        path.write_bytes(mutated(data, np.random.default_rng(seed)))
        began = time.perf_counter()
        try:
            read(path)
            good += 1
        except InvalidInputError as error:
            assert "\n" not in str(error) and str(path) in str(error), seed
        assert time.perf_counter() - began < SLOWEST, seed
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < MEMORY
    return good


def check_cloud(path):
    points = read_cloud(path).points
    assert points.ndim == 2 and points.shape[1] == 3 and len(points) and np.isfinite(points).all()


def check_triangles(path):
    corners = read_triangles(path)
    assert corners.shape[1:] == (3, 3) and np.isfinite(corners).all()


CLOUDS = ("a.pcd", "b.pcd", "c.pcd", "a.ply", "b.ply", "a.npy", "a.xyz")


@pytest.mark.slow
@pytest.mark.parametrize("name", CLOUDS)
def test_damaged_clouds(name, tmp_path, part):
    seeds = part(range(3000), 200)
    assert 0 < read_all(tmp_path / name, seeds, GOOD[name], check_cloud) < len(seeds)


@pytest.mark.parametrize("suffix", ["stl", "obj", "dae"])
def test_damaged_meshes(suffix, tmp_path):
    data = trimesh.creation.annulus(0.4, 0.5, 1.0, sections=8).export(file_type=suffix)
    data = data.encode() if isinstance(data, str) else data
    read_all(tmp_path / f"a.{suffix}", range(60), data, check_triangles)
