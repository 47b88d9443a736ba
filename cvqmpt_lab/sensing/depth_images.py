"""Depth images to points, and back to files: 16-bit PNG, or NPY with a number a pixel."""

import io
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import write_bytes
from cvqmpt_lab.scene.files.npy import read_array
from cvqmpt_lab.scene.files.reading import file_bytes, kind_of, parsing
from cvqmpt_lab.sensing.camera import Pinhole

MILLIMETRES = 0.001
"""[m] of one unit of a 16-bit image, as depth cameras write them."""
SIXTEEN_BITS = ("I;16", "I;16B", "I;16L")
"""What Pillow calls them."""
EXPANSION = 1100
"""Bytes, at most, that PNG packs into one."""


def read_depth(path: Path | str, camera: Pinhole, scale: float | None = None) -> FloatArray:
    """Depth (height, width) along the camera's axis [m], NaN where the camera saw nothing (0, or not finite).

    Parameters
    ----------
    scale: [m] of one unit; by default millimetres of a PNG, metres of an NPY of floats.

    Raises
    ------
    UnknownChoiceError: another suffix than those of `DEPTH_READERS`.
    InvalidInputError: a file that cannot be read, that is no depth image, or not the camera's; names it.
    """
    path = Path(path)
    reader = DEPTH_READERS[kind_of(path, DEPTH_READERS, "depth image")]
    data = file_bytes(path, "depth image")
    with parsing(path, "depth image"), np.errstate(over="ignore", invalid="ignore"):
        image = reader(data, camera)
        unit = (MILLIMETRES if image.dtype.kind == "u" else 1.0) if scale is None else scale
        depth = unit * image.astype(np.float64)
    depth[~(np.isfinite(depth) & (depth > 0.0))] = np.nan
    return depth


def write_depth(path: Path | str, depth: FloatArray, scale: float = MILLIMETRES) -> None:
    """Write depth (height, width) [m] as a 16-bit PNG; what is not finite or does not fit becomes 0, not seen.

    scale: [m] of one unit.
    """
    with np.errstate(invalid="ignore"):
        units = np.rint(depth / scale)
    units[~(units < 2**16)] = 0.0
    from PIL import Image  # here and below: plans without depth images need not pay for it

    stream = io.BytesIO()
    Image.fromarray(units.astype(np.uint16)).save(stream, format="PNG")
    write_bytes(Path(path), stream.getvalue())


def deprojected(depth: FloatArray, camera: Pinhole) -> FloatArray:
    """The organised cloud (height, width, 3) [m, camera frame] of a depth image (height, width) [m]; NaN stays."""
    across = (np.arange(camera.width) - camera.cx) / camera.fx
    down = (np.arange(camera.height) - camera.cy) / camera.fy
    return np.stack([depth * across, depth * down[:, None], depth], axis=-1)


def _read_png(data: bytes, camera: Pinhole) -> np.ndarray:
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        if image.mode not in SIXTEEN_BITS:
            raise InvalidInputError(
                f"it is a picture of mode {image.mode}, no depth: give the 16-bit depth image"
            )
        _check_size((image.height, image.width), camera)
        if image.width * image.height * 2 > EXPANSION * len(data):
            raise InvalidInputError("its header says more pixels than the file can hold: cut short?")
        return np.asarray(image, dtype=np.uint16)


def _read_npy(data: bytes, camera: Pinhole) -> np.ndarray:
    image = read_array(data)
    if image.ndim != 2 or image.dtype.kind not in "fui":
        raise InvalidInputError("it holds no array (height, width) of numbers")
    _check_size(image.shape, camera)
    return image


def _check_size(shape: tuple[int, ...], camera: Pinhole) -> None:
    if shape != (camera.height, camera.width):
        raise InvalidInputError(
            f"the image has {shape[1]} x {shape[0]} pixels, the intrinsics are for {camera.width} x {camera.height}; "
            "give those of this image (fx, fy, cx, cy grow with its size)"
        )


DEPTH_READERS: Mapping[str, Callable[[bytes, Pinhole], np.ndarray]] = {".png": _read_png, ".npy": _read_npy}
"""Readers of (height, width) numbers by the suffix of the file."""
