"""Damaged files of every kind that a lab hands in, and what reading them may do: a clear error or a correct result.

`python tests/damaged_files.py 100000` tries that many, all kinds in turn, and prints what came of them.
"""

import io
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from cloud_files import GOOD, npy
from PIL import Image

from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.scene.cloud_files import read_cloud
from cvqmpt_lab.sensing.camera_files import read_extrinsics, read_intrinsics
from cvqmpt_lab.sensing.depth import read_capture
from experiments.trust.mutation import damaged

SLOWEST = 2.0  # [s] for one small file on a busy machine
MEMORY = 400 * 2**20  # [bytes] that the process may grow by


class Tried(NamedTuple):
    """What came of damaged files of one kind."""

    good: int
    """That were read."""
    refused: int
    """With a clear error."""
    slowest: float
    """[s]."""
    grown: int
    """[bytes] by which the process grew."""


def tried(path: Path, seeds: Iterable[int], data: bytes, read: Callable[[Path], None]) -> Tried:
    """Read mutated files; AssertionError, with the seed, for one that is slow, or refused without its name."""
    before, good, refused, slowest = _peak(), 0, 0, 0.0
    for seed in seeds:
        path.write_bytes(damaged(data, np.random.default_rng(seed)))
        began = time.perf_counter()
        try:
            read(path)
            good += 1
        except CvqmptError as error:
            refused += 1
            assert "\n" not in str(error) and str(path) in str(error), seed
        seconds = time.perf_counter() - began
        assert seconds < SLOWEST, (seed, seconds)
        slowest = max(slowest, seconds)
    grown = _peak() - before
    assert grown < MEMORY, grown
    return Tried(good, refused, slowest, grown)


def _peak() -> int:
    """Most memory that the process has had [bytes]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _cloud(path: Path) -> None:
    points = read_cloud(path).points
    assert points.ndim == 2 and points.shape[1] == 3 and len(points) and np.isfinite(points).all()


def _depth(path: Path) -> None:
    lens = path.with_name("good_lens.json")
    lens.write_bytes(LENS)
    points = read_capture(path, lens).points
    assert points.shape[1:] == (3,) and len(points) <= SIDE**2
    assert np.isfinite(points).all() and (points[:, 2] > 0.0).all()


def _intrinsics(path: Path) -> None:
    lens = read_intrinsics(path)
    assert 0 <= lens.cx < lens.width and 0 <= lens.cy < lens.height and lens.fx > 0.0 and lens.fy > 0.0


def _extrinsics(path: Path) -> None:
    T = read_extrinsics(path)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
    assert np.isfinite(T).all() and np.linalg.det(T[:3, :3]) > 0.0


def _png(image: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, format="PNG")
    return stream.getvalue()


SIDE = 24
_IMAGE = np.random.default_rng(0).integers(0, 3000, (SIDE, SIDE))
LENS = json.dumps({"width": SIDE, "height": SIDE, "fx": 20.0, "fy": 20.0, "cx": 11.5, "cy": 11.5}).encode()
ROS = b"""image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [525, 0.0, 319.5, 0.0, 5.26e2, 239.5, 0, 0, 1.]}
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""
KINDS: dict[str, tuple[bytes, Callable[[Path], None]]] = {
    **{
        name: (GOOD[name], _cloud) for name in ("a.pcd", "b.pcd", "c.pcd", "a.ply", "b.ply", "a.npy", "a.xyz")
    },
    "depth.png": (_png(_IMAGE.astype(np.uint16)), _depth),
    "depth.npy": (npy(0.001 * _IMAGE), _depth),
    "lens.json": (LENS, _intrinsics),
    "lens.yaml": (ROS, _intrinsics),
    "pose.json": (json.dumps(np.eye(4).tolist()).encode(), _extrinsics),
    "pose.yaml": (
        b"translation: {x: 0.1, y: -0.5, z: 1.2}\nrotation: {x: 0, y: 0, z: 0.6, w: 0.8}\n",
        _extrinsics,
    ),
}
"""Good files by their name, and how each is read and looked at."""


def main(inputs: int) -> None:
    """Try inputs of every kind and print a line for each."""
    each = -(-inputs // len(KINDS))
    with tempfile.TemporaryDirectory() as folder:
        for name, (data, read) in KINDS.items():
            came = tried(Path(folder) / name, range(each), data, read)
            said = f"{came.good:6} read, {came.refused:6} refused, slowest {1e3 * came.slowest:.0f} ms"
            print(f"{name:10} {said}, {came.grown / 2**20:.0f} MiB grown", flush=True)  # noqa: T201


if __name__ == "__main__":
    main(int(sys.argv[1]))
