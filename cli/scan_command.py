"""`cvqmpt scan`: make a clean cloud or a scene from depth images or clouds."""

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import json_text, write_text
from cvqmpt_lab.base.reports import Entry, Report
from cvqmpt_lab.cli.options import (
    REPEATED,
    Options,
    file_of_kind,
    option,
    picture_file,
    refuse_given,
)
from cvqmpt_lab.cli.problem_arguments import chosen_robot, configuration
from cvqmpt_lab.cli.problem_options import ROBOT, SCAN
from cvqmpt_lab.features.scan.camera_pose import Region, camera_text, pose_doubts
from cvqmpt_lab.features.scan.plane import CAMERA_UP
from cvqmpt_lab.features.scan.scan import (
    MAP_RESOLUTION_M,
    Arm,
    MapSettings,
    Scan,
    ScanSettings,
    occupancy_map,
    refuse_touching,
    scan,
    unseen_share,
)
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.cloud_files import CLOUD_HEADERS, write_cloud
from cvqmpt_lab.scene.scene import Scene, check_extent, log
from cvqmpt_lab.scene.shapes import PointCloud
from cvqmpt_lab.sensing.crop import Crop


def scan_of(args: argparse.Namespace, files: Sequence[Path], robot: Robot, arm: Arm | None) -> Scan:
    """Read and clean scanned files by the options of `SCAN`.

    Args:
        args: parsed command line.
        files: clouds and depth images.
        robot: the robot; no point above its reach is kept.
        arm: the robot as it stood during the scan; None: no point is removed as the robot's.
    """
    if args.level and args.extrinsics:
        raise InvalidInputError("--level and --extrinsics: give one of the two")
    if not args.level:
        refuse_given(args, ("front", "down"), "goes with --level table; give it")
    intrinsics = _each("--intrinsics", args.intrinsics, files)
    extrinsics = _each("--extrinsics", args.extrinsics, files)
    cameras = [*zip(files, intrinsics, extrinsics, strict=True)]
    from cvqmpt_lab.features.scan.captures import captures_of, unit_hint  # few commands need it
    from cvqmpt_lab.features.scan.depth import has_bare_quaternion

    reach = math.inf if args.level else robot.reach
    captures = captures_of(cameras, args.scale, reach)
    crop: Any = args.crop
    changes: dict[str, Any] = {
        "crop": crop and Crop(kind="box", lower=tuple(crop[:3]), upper=tuple(crop[3:])),
        "front": args.front and tuple(args.front),
        "down": args.down,
    }
    settings = ScanSettings(
        level=args.level is not None,
        highest=robot.reach,
        voxel=args.voxel,
        robot_margin=args.robot_margin,
        neighbours=args.neighbours,
        plane=args.plane,
        **{name: value for name, value in changes.items() if value is not None},
    )
    hint = unit_hint(files, captures, args.scale)
    try:
        made = scan(captures, settings, np.random.default_rng(0), arm)
    except InvalidInputError as error:
        raise InvalidInputError(f"{error}; {hint}" if hint else str(error)) from error
    away = [float(np.linalg.norm(each.in_world, axis=1).min()) for each in made.captures]
    if hint and min(away) > robot.reach:
        log.warning(hint)
    for file, pose, capture in zip(files, extrinsics, captures, strict=True):
        named = pose is not None and has_bare_quaternion(pose)
        doubts = pose_doubts(capture, Region(settings.crop, robot.reach), named)
        if doubts:
            log.warning(f"camera of {file}: {doubts}")
    return made


def scene_of(args: argparse.Namespace, made: Scan, robot: Robot, arm: Arm | None) -> Scene:
    """Return the scan as obstacles, with the share of the robot's reach that nobody saw.

    Args:
        args: values of the options.
        made: the scan.
        robot: whose reach counts.
        arm: bodies of the robot in the scan; the space inside them counts as seen.
    """
    settings = _map_settings(args)
    scene = _obstacles_of(args, made, arm, settings)
    if args.unknown == "occupied":
        return scene
    shadows = settings if args.unknown == "shadow" else None
    share = unseen_share(made.captures, robot.reach, arm, shadows=shadows)
    return replace(scene, unseen=round(share, 3))


def _map_settings(args: argparse.Namespace) -> MapSettings:
    """Return the settings of a map; shadows are obstacles inside the crop alone."""
    region: dict[str, Any] = {}
    if args.crop and args.unknown == "shadow":
        region = {"lower": tuple(args.crop[:3]), "upper": tuple(args.crop[3:])}
    return MapSettings(
        resolution=args.map or MAP_RESOLUTION_M,
        padding=args.padding,
        unknown=args.unknown,
        robot_margin=args.robot_margin,
        **region,
    )


def _obstacles_of(
    args: argparse.Namespace, made: Scan, arm: Arm | None, settings: MapSettings
) -> Scene:
    """Return the scan as obstacles."""
    if args.radius is not None:
        if args.unknown != "free":
            raise InvalidInputError(
                f"--radius {args.radius:g} makes balls of points, --unknown {args.unknown} cells: "
                "leave one of the two out"
            )
        refuse_given(args, ["padding"], "inflates cells of a map; with --radius, add it to that")
        refuse_given(args, ["map"], "is the size of cells; --radius makes balls: leave one out")
        return made.scene(PointCloud(made.points, args.radius) if len(made.points) else None)
    if len(made.points) == 0 and args.unknown == "free":
        return made.scene()
    return made.scene(occupancy_map(made.points, settings, made.captures, arm))


def _refuse_gaps(args: argparse.Namespace) -> None:
    """Refuse voxels so large that neighbouring points make obstacles with gaps between them."""
    named, size = (
        ("--map", args.map or MAP_RESOLUTION_M)
        if args.radius is None
        else ("--radius", args.radius)
    )
    width = size + 2.0 * args.padding if args.radius is None else 2.0 * size
    if args.voxel > width:
        raise InvalidInputError(
            f"--voxel {args.voxel:g} leaves one point in {args.voxel:g} m, and {named} {size:g} "
            f"makes obstacles of it that are {width:g} m wide: surfaces would have gaps; give "
            f"--voxel {width:g} or less, or a larger {named}"
        )


def _each(option: str, given: Sequence[Path], files: Sequence[Path]) -> Sequence[Path | None]:
    """Return a value for each file, which are all given or all None."""
    if given and len(given) != len(files):
        raise InvalidInputError(
            f"{option} is given {len(given)} times for {len(files)} files; give one for each"
        )
    return given or [None] * len(files)


def scan_entries(made: Scan, files: Sequence[Path]) -> Iterator[Entry]:
    """Yield the labelled lines of the report on a scan."""
    names = ", ".join(path.name for path in files)
    yield (
        (
            "scan",
            f"{names}: {made.steps[0].before} points, {made.dropped} pixels or rows without one",
        )
    )
    if made.levelled is not None:
        from scipy.spatial.transform import Rotation  # a third of a second to import

        T, plane = made.levelled
        tilt = np.degrees(np.arccos(np.clip(plane.normal @ CAMERA_UP, -1.0, 1.0)))
        yield (
            (
                "levelled",
                f"by a table of {plane.share:.0%} of the points, flat to "
                f"{1e3 * plane.residual:.1f} mm: the camera looks {tilt:.1f} deg down from "
                f"{-plane.offset:.2f} m above it",
            )
        )
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().round(6).tolist()
        yield (
            "extrinsics",
            json.dumps({"xyz": T[:3, 3].round(4).tolist(), "quaternion": quaternion}),
        )
    for step in made.steps:
        yield (f"{step.name:11} ", f"{step.before} -> {step.after} points")
    if made.plane is not None:
        done = "now a box" if made.table is not None else "gone"
        yield (
            (
                "plane",
                f"flat to {1e3 * made.plane.residual:.1f} mm, at z = "
                f"{made.plane.offset:.3f} m: {done}",
            )
        )


def camera_entries(made: Scan, files: Sequence[Path]) -> Iterator[Entry]:
    """Yield a line on each camera: where it is and where it looks."""
    for file, capture in zip(files, made.captures, strict=True):
        name = f"{file.name}: " if len(files) > 1 else ""
        yield ("camera", f"{name}{camera_text(capture)}")


def _spared(args: argparse.Namespace, arm: Arm | None) -> list[Entry]:
    """Return a line on which unknown cells --unknown makes obstacles."""
    if args.unknown == "free":
        return []
    spared = "the arm may stand in them: give --arm-at Q, its configuration, to leave out its own"
    if arm is not None:
        spared = f"except those in which {arm.robot.name} stands during the scan"
    if args.unknown == "occupied":
        return [("unknown", f"cells that no ray crossed are obstacles, {spared}")]
    if arm is not None:
        spared = f"except those that {arm.robot.name} alone hides or in which it stands"
    hidden = "cells that no ray crossed, behind a measured point, are obstacles"
    return [("unknown", f"{hidden}, {spared}")]


def run(args: argparse.Namespace) -> None:
    """Read and clean a scan, report on it and write files."""
    files = [path for path in args.files if path.suffix != ".json"]
    named = [path for path in args.files if path.suffix == ".json"]
    if len(named) > 1 or not files:
        raise InvalidInputError(
            f"{' '.join(map(str, args.files))}: give clouds or depth images, and at most one "
            "problem file"
        )
    file = named[0] if named else None
    robot = chosen_robot(args, file)
    if any(path.suffix == ".json" for path in args.out):
        _refuse_gaps(args)
    arm = None
    if args.arm_at is not None:
        arm = Arm(robot, configuration(robot, "--arm-at", args.arm_at, file))
    made = scan_of(args, files, robot, arm)
    scene = scene_of(args, made, robot, arm)
    check_extent(scene, robot.reach, "scan")
    if arm is not None:
        refuse_touching(scene, arm)
    lines = (*scan_entries(made, files), *camera_entries(made, files), *_spared(args, arm))
    print(Report.of(lines))
    for note in scene.notes:
        print(f"unseen      {note}")
    for path in args.out:
        if path.suffix == ".json":
            write_text(path, json_text(to_plain(scene)) + "\n")
        else:
            from cvqmpt_lab.features.scan.captures import Cleaned

            share = scene.unseen
            if share is None:
                share = round(unseen_share(made.captures, robot.reach, arm), 3)
            cleaned = Cleaned(args.voxel, arm is not None, share)
            write_cloud(path, made.points, cleaned.comment)
        print(f"written to {path}")
    if args.picture:
        shown = None
        if args.robot is not None or file is not None:
            shown = arm or Arm(robot, 0.5 * (robot.lower + robot.upper))
        # Pillow and drawing take 0.2 s to import
        from cvqmpt_lab.features.scan.scan_picture import draw_scan

        draw_scan(made, scene, args.voxel, args.picture, shown)
        print(f"picture written to {args.picture}")


OPTIONS: Options = {
    "files": option(
        "clouds (pcd, ply, npy, xyz) or depth images (png, npy); and a problem or task file with "
        "the robot",
        nargs="+",
        type=Path,
        metavar="FILE",
    ),
    "--out": option(
        "the cleaned cloud, for plan --cloud, or as json a scene, for plan --scene; repeatable",
        type=partial(file_of_kind, "--out", (".json", *CLOUD_HEADERS)),
        metavar="OUT.pcd|ply|npy|json",
        **REPEATED,
    ),
    "--picture": option(
        "picture of points (also removed ones), cameras, axes, obstacles, and of a named robot",
        type=picture_file,
        metavar="P.png|jpg|pdf",
    ),
    **SCAN,
    **ROBOT,
}
COMMANDS = {"scan": (run, OPTIONS)}
