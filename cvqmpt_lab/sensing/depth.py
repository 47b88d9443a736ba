"""Depth images (16-bit PNG, or NPY) and captures: what one camera saw, as points."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from cvqmpt_lab.codec import to_plain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import write_bytes, write_text
from cvqmpt_lab.scene.cloud_files import (
    Cloud,
    check_lengths,
    read_array,
    read_by_suffix,
    read_cloud,
)
from cvqmpt_lab.sensing.camera import Intrinsics
from cvqmpt_lab.sensing.camera_files import read_extrinsics, read_intrinsics
from cvqmpt_lab.sensing.render import View
from cvqmpt_lab.values import FloatArray


def read_capture(
    path: Path | str,
    intrinsics: Path | str | None = None,
    extrinsics: Path | str | None = None,
    scale: float | None = None,
) -> Cloud:
    """Read a cloud, or, with intrinsics, a depth image; errors name the file.

    intrinsics, extrinsics: files of `read_intrinsics` and `read_extrinsics`; None: a cloud; the
        robot's base frame.
    scale: [m] of one unit; None: metres, of a 16-bit image millimetres.
    """
    path = Path(path)
    if intrinsics is None and path.suffix.lower() == ".png":
        raise InvalidInputError(
            f"depth image {path} needs the intrinsics of its camera; give them (json or yaml)"
        )
    T = np.eye(4) if extrinsics is None else read_extrinsics(extrinsics)
    if intrinsics is None:
        return replace(read_cloud(path, 1.0 if scale is None else scale), T_world_camera=T)
    lens = read_intrinsics(intrinsics)
    pixels = deprojected(read_depth(path, lens, scale), lens).reshape(-1, 3)
    points = pixels[np.isfinite(pixels[:, 2])]
    if len(points) == 0:
        raise InvalidInputError(
            f"depth image {path}: the camera saw nothing, every pixel is 0 or not finite"
        )
    check_lengths(points, f"depth image {path}")
    return Cloud(points, len(pixels) - len(points), T)


def read_depth(path: Path | str, lens: Intrinsics, scale: float | None = None) -> FloatArray:
    """Depth (height, width) along the camera's axis [m], NaN if not seen; errors name the file.

    scale: [m] of one unit; by default millimetres of a PNG, metres of an NPY of floats.
    """
    readers = {".png": _read_png, ".npy": _read_npy}
    image = read_by_suffix(readers, Path(path), "depth image", lens)
    unit = (0.001 if image.dtype.kind == "u" else 1.0) if scale is None else scale
    with np.errstate(over="ignore", invalid="ignore"):
        depth = unit * image.astype(np.float64)
    depth[~(np.isfinite(depth) & (depth > 0.0))] = np.nan
    return depth


def deprojected(depth: FloatArray, lens: Intrinsics) -> FloatArray:
    """Points d ((u - cx) / fx, (v - cy) / fy, 1) [m, camera frame] of a depth image d [m]."""
    x, y = lens.axes()
    return np.stack([depth * x, depth * y[:, None], depth], axis=-1)


def write_depth(path: Path | str, depth: FloatArray, scale: float = 0.001) -> None:
    """Write depth (height, width) as a 16-bit PNG, `scale` [m] per unit; 0: does not fit."""
    with np.errstate(invalid="ignore"):
        units = np.rint(depth / scale)
    units[~(units < 2**16)] = 0.0
    from PIL import Image  # here and below: plans without depth images need not pay for it

    stream = io.BytesIO()
    Image.fromarray(units.astype(np.uint16)).save(stream, format="PNG")
    write_bytes(Path(path), stream.getvalue())


def write_view(view: View, folder: Path, name: str) -> tuple[Path, Path, Path]:
    """Write name.png, name.intrinsics.json, name.extrinsics.json: paths for `read_capture`."""
    ends = ("png", "intrinsics.json", "extrinsics.json")
    image, intrinsics, extrinsics = (folder / f"{name}.{end}" for end in ends)
    write_depth(image, view.depth)
    write_text(intrinsics, json.dumps(to_plain(view.camera.intrinsics), indent=1) + "\n")
    pose = {"T_world_camera": view.camera.T_world_camera.tolist()}
    write_text(extrinsics, json.dumps(pose, indent=1) + "\n")
    return image, intrinsics, extrinsics


def _read_png(data: bytes, lens: Intrinsics) -> np.ndarray:
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        if image.mode not in ("I;16", "I;16B", "I;16L"):
            raise InvalidInputError(
                f"it is a picture of mode {image.mode}, no depth: give the 16-bit depth image"
            )
        _check_size((image.height, image.width), lens)
        # PNG packs at most 1100 bytes into one
        if image.width * image.height * 2 > 1100 * len(data):
            raise InvalidInputError(
                "its header says more pixels than the file can hold: cut short?"
            )
        pixels = np.asarray(image, dtype=np.uint16)
    if data.partition(b"IEND\xaeB`\x82")[2]:
        raise InvalidInputError("the file goes on after its image; give one image a file")
    return pixels


def _read_npy(data: bytes, lens: Intrinsics) -> np.ndarray:
    image = read_array(data)
    if image.ndim != 2 or image.dtype.kind not in "fui":
        raise InvalidInputError("it holds no array (height, width) of numbers")
    _check_size(image.shape, lens)
    return image


def _check_size(shape: tuple[int, ...], lens: Intrinsics) -> None:
    if shape != (lens.height, lens.width):
        raise InvalidInputError(
            f"the image has {shape[1]} x {shape[0]} pixels, the intrinsics are for {lens.width} x "
            f"{lens.height}; give those of this image (fx, fy, cx, cy grow with its size)"
        )
