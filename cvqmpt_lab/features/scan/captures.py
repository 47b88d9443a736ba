"""Read the files of a scan; clouds that `cvqmpt scan` cleaned say so in a comment."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.features.scan.depth import has_millimetres, read_capture
from cvqmpt_lab.features.scan.depth_forms import other_units
from cvqmpt_lab.features.scan.scan import (
    MAP_RESOLUTION_M,
    Arm,
    MapSettings,
    Scan,
    ScanSettings,
    Step,
    near_robot,
    occupancy_map,
    scan,
    unseen_share,
)
from cvqmpt_lab.scene.cloud_files import Cloud, comment_of
from cvqmpt_lab.scene.scene import Scene, log

MARK = "cvqmpt-scan "  # begin of the comment in a cleaned cloud


@dataclass(frozen=True)
class Cleaned:
    """How a cloud was cleaned."""

    voxel: float  # edge of the cells in which points were averaged [m]
    arm: bool  # whether points of the robot were removed
    unseen: float = 0.0  # share of the arm's reach that no camera saw

    @property
    def comment(self) -> str:
        """The comment in the cloud's file."""
        return MARK + json.dumps(asdict(self))


def cleaned_by(path: Path) -> Cleaned | None:
    """Return how `cvqmpt scan` cleaned a cloud; None: it did not, or the format has no comments."""
    text = comment_of(path, MARK)
    return None if text is None else from_plain(Cleaned, json.loads(text), f"cloud {path}")


def captures_of(
    cameras: Iterable[tuple[Path, Path | None, Path | None]], scale: float | None, reach: float
) -> list[Cloud]:
    """Read clouds and depth images; warn about one out of reach beside others within reach.

    Args:
        cameras: file, intrinsics and extrinsics of each.
        scale: length of a unit in the files [m]; None: given by their format.
        reach: of the arm [m]; where no capture is in reach, the scene of all gives the warning.
    """
    named = [*cameras]
    captures = [read_capture(file, lens, pose, scale) for file, lens, pose in named]
    gaps = [float(np.linalg.norm(capture.in_world, axis=1).min()) for capture in captures]
    for (file, _, _), gap in zip(named, gaps, strict=True):
        if gap > reach >= min(gaps):
            log.warning(
                f"scan {file}: none of its points is in the arm's reach of {reach:.3g} m: the "
                f"nearest is {gap:.3g} m away; extrinsics not in metres, inverted, or of another "
                "frame?"
            )
    return captures


def unit_hint(files: Sequence[Path], captures: Sequence[Cloud], scale: float | None) -> str:
    """Return which --scale would bring images in millimetres nearer, in words; "": none is far.

    Args:
        files: clouds and depth images.
        captures: their points, in the same order.
        scale: length of a unit that was given [m]; None: images of whole numbers are in mm.
    """
    if scale is not None:
        return ""
    for file, capture in zip(files, captures, strict=True):
        units = other_units(capture.points[:, 2])
        if units and has_millimetres(file):
            middle = float(np.median(capture.points[:, 2]))
            return f"{file} is {middle:.3g} m deep if its units are 1 mm; else give {units}"
    return ""


def scan_of_clouds(files: Sequence[Path], arm: Arm) -> Scan:
    """Return the scan of clouds in the robot's base frame, cleaned unless `cvqmpt scan` did it.

    Args:
        files: clouds.
        arm: the robot as it stands among them.
    """
    for file in files:
        if file.suffix.lower() == ".png":
            raise InvalidInputError(
                f"{file} is a depth image: write cvqmpt scan {file} --intrinsics F --extrinsics F "
                "--arm-at Q --out clean.pcd, and give clean.pcd"
            )
    captures = captures_of(((file, None, None) for file in files), None, arm.robot.reach)
    cleaned = [cleaned_by(file) for file in files]
    if None in cleaned:
        settings = ScanSettings(highest=arm.robot.reach)
        return scan(captures, settings, np.random.default_rng(0), arm)
    points = kept = np.concatenate([capture.in_world for capture in captures])
    if not all(each is not None and each.arm for each in cleaned):
        kept = points[~near_robot(points, *arm, ScanSettings().robot_margin)]
    return Scan(kept, 0, (Step("robot", len(points), len(kept)),), tuple(captures))


def scene_of_clouds(made: Scan, files: Sequence[Path], arm: Arm) -> Scene:
    """Return the obstacles of `scan_of_clouds`, with the share of the arm's reach that is unseen.

    Args:
        made: the scan of the files.
        files: clouds.
        arm: the robot as it stands among them.
    """
    cleaned = [each for each in map(cleaned_by, files) if each is not None]
    voxel = max((each.voxel for each in cleaned), default=0.0)
    if voxel > 2.0 * MAP_RESOLUTION_M:
        raise InvalidInputError(
            f"cloud {files[0]} has one point in {voxel:g} m, of which cells of "
            f"{MAP_RESOLUTION_M:g} m make surfaces with gaps: write a scene, cvqmpt scan ... "
            f"--voxel {voxel:g} --map {voxel:g} --out scene.json, and give --scene scene.json"
        )
    if len(made.points) == 0:
        scene = made.scene()
    else:
        scene = made.scene(occupancy_map(made.points, MapSettings(), made.captures, arm))
    if len(cleaned) == len(files):
        share = max(each.unseen for each in cleaned)
    else:
        share = unseen_share(made.captures, arm.robot.reach, arm)
    return scene.changed(unseen=round(share, 3))
