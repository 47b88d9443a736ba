"""Views from files: a depth image with its camera, or a cloud."""

from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.files.clouds import read_cloud
from cvqmpt_lab.scene.files.reading import check_lengths
from cvqmpt_lab.sensing.camera import read_extrinsics, read_intrinsics
from cvqmpt_lab.sensing.depth_images import deprojected, read_depth
from cvqmpt_lab.sensing.scan import Capture

IMAGE = ".png"


def read_capture(
    path: Path | str,
    intrinsics: Path | str | None = None,
    extrinsics: Path | str | None = None,
    scale: float | None = None,
) -> Capture:
    """Read what one camera saw.

    Parameters
    ----------
    path: a cloud, or, with intrinsics, a depth image.
    intrinsics, extrinsics: files of `read_intrinsics` and `read_extrinsics`; None: a cloud; the robot's base frame.
    scale: [m] of one unit; None: metres, of a 16-bit image millimetres.

    Raises
    ------
    InvalidInputError, UnknownChoiceError: a file that cannot be used, by name.
    """
    path = Path(path)
    if intrinsics is None and path.suffix.lower() == IMAGE:
        raise InvalidInputError(
            f"depth image {path} needs the intrinsics of its camera; give them (json or yaml)"
        )
    T = np.eye(4) if extrinsics is None else read_extrinsics(extrinsics)
    if intrinsics is None:
        cloud = read_cloud(path, 1.0 if scale is None else scale)
        return Capture(cloud.points, cloud.dropped, T)
    camera = read_intrinsics(intrinsics)
    pixels = deprojected(read_depth(path, camera, scale), camera).reshape(-1, 3)
    points = pixels[np.isfinite(pixels[:, 2])]
    if len(points) == 0:
        raise InvalidInputError(f"depth image {path}: the camera saw nothing, every pixel is 0 or not finite")
    check_lengths(points, f"depth image {path}")
    return Capture(points, len(pixels) - len(points), T)
