"""What virtual cameras saw, in the files that a lab's cameras give: a 16-bit image, intrinsics and extrinsics."""

import json
from pathlib import Path
from typing import NamedTuple

from cvqmpt_lab.cameras.view import View
from cvqmpt_lab.codec.plain import to_plain
from cvqmpt_lab.files import write_text
from cvqmpt_lab.sensing.camera import Pinhole
from cvqmpt_lab.sensing.depth_images import write_depth


class CaptureFiles(NamedTuple):
    """The files of one camera, in the order that `read_capture` takes them."""

    image: Path
    """Depths, 16-bit PNG [mm]."""
    intrinsics: Path
    """Json of a `Pinhole`."""
    extrinsics: Path
    """Json of T_world_camera."""


def write_view(view: View, folder: Path, name: str) -> CaptureFiles:
    """Write what a camera saw as ``name.png``, ``name.intrinsics.json`` and ``name.extrinsics.json``."""
    files = CaptureFiles(*(folder / f"{name}.{end}" for end in ("png", "intrinsics.json", "extrinsics.json")))
    write_depth(files.image, view.depth)
    write_text(files.intrinsics, json.dumps(to_plain(Pinhole.of(view.lens)), indent=1) + "\n")
    pose = {"T_world_camera": view.camera.T_world_camera.tolist()}
    write_text(files.extrinsics, json.dumps(pose, indent=1) + "\n")
    return files
