"""Planning in the map that depth images give of a scene, and judging paths in the map and in the
scene.

Five kitchens and five cluttered tables; start and goal are random upright configurations `ROOM`
from everything, the straight motion between them blocked. Noisy depth images with the arm at the
start become, through files, filters and the removal of the robot's points, an occupancy map, all
that planners know. A second suite varies one setting each.
"""

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.benchmarks.family_task import PANDA, upright_problem
from cvqmpt_lab.benchmarks.item import SensedProblem, UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import DOOR, DOOR_ANGLE
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import FailReason, phase_problem
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.scene.families import family_scene
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.objects import CAN, CRACKER_BOX, MUSTARD_BOTTLE
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.sensing.camera import KINECT, Camera, look_at
from cvqmpt_lab.sensing.depth import read_capture, write_view
from cvqmpt_lab.sensing.filters import BallCrop
from cvqmpt_lab.sensing.noise import DepthNoise
from cvqmpt_lab.sensing.occupancy import MapSettings, occupancy_map
from cvqmpt_lab.sensing.render import View
from cvqmpt_lab.sensing.scan import Arm, ScanSettings, scan
from cvqmpt_lab.sensing.virtual import CameraSettings, arm_objects, views_of

VARIED_SCENES = range(10)  # whose sensing is varied
FIRST_TABLE = 3000  # scene numbers that no other suite uses
ROOM = 0.06  # [m] that start and goal keep from obstacles
THINGS = {
    "cracker_box": (CRACKER_BOX, 0.287),
    "mustard": (MUSTARD_BOTTLE, 0.262),
    "can": (CAN, 0.271),
}
"""On the counter: what, and the height of its centre of mass [m]."""
COUNTER = ((0.32, -0.85), (0.70, -0.20))  # [m] corners x, y of where they stand
APART = 0.17  # [m] between their centres
STANDS = (
    ((130, 160), (20, 45)),
    ((185, 205), (20, 45)),
    ((165, 195), (50, 65)),
    ((100, 120), (15, 35)),
)
"""Azimuths and elevations [deg] of the first, second, ... camera as seen from `TARGET`:
behind the robot.
"""
TARGET, TARGET_SPREAD, DISTANCE = (0.45, -0.15, 0.35), 0.1, (1.2, 1.7)  # [m]


class ScannedScene(NamedTuple):
    """One true scene."""

    truth: PlanningProblem  # with its start and its only goal
    cameras: tuple[Camera, ...]  # as many as there are `STANDS`; the first ones are used


def scanned_scene(number: int) -> ScannedScene | UnsolvableProblem:
    """Scene `number`: even ones are kitchens, odd ones tables."""
    rng = np.random.default_rng([number, 12])
    scene = (
        family_scene("table", FIRST_TABLE + number)
        if number % 2
        else _cluttered_kitchen(number, rng)
    )
    truth = upright_problem(str(number), robot_from_source(PANDA), scene, rng, ROOM)
    if isinstance(truth, UnsolvableProblem):
        return truth
    return ScannedScene(truth, tuple(_camera(stand, rng) for stand in STANDS))


def _cluttered_kitchen(number: int, rng: np.random.Generator) -> Scene:
    """The kitchen of the place task with three things on the right counter, none touching another."""
    while True:
        places = rng.uniform(*COUNTER, (len(THINGS), 2))
        gaps = np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(len(THINGS), 1)]
        if gaps.min() > APART:
            break
    things = [
        thing.at_com(name, (float(x), float(y), height), float(rng.uniform(-np.pi, np.pi)))
        for (name, (thing, height)), (x, y) in zip(THINGS.items(), places, strict=True)
    ]
    scene = kitchen(door_angles={DOOR: DOOR_ANGLE}).with_objects(*things)
    return Scene(f"kitchen_clutter_{number}", scene.objects)


def _camera(stand: tuple[tuple[int, int], tuple[int, int]], rng: np.random.Generator) -> Camera:
    azimuth, elevation = (np.radians(rng.uniform(*span)) for span in stand)
    target = np.add(TARGET, rng.uniform(-TARGET_SPREAD, TARGET_SPREAD, 3))
    flat = np.cos(elevation)
    away = np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)])
    return Camera(KINECT, look_at(target + rng.uniform(*DISTANCE) * away, target))


# what of a scan the arm can touch, and a little more
REACH = BallCrop(centre=(0.0, 0.0, 0.33), radius=1.3)
NEIGHBOURS = 8  # points with fewer are taken for flying pixels, which come in veils behind edges


@dataclass(frozen=True, kw_only=True)
class Sensing:
    """How a scene is measured, and what map is made of it."""

    noise: float = 1.0  # errors of the cameras, times those of `DepthNoise`
    cameras: int = 2  # 1 to 4
    pixels: int | None = None  # of all images that are kept, drawn at random; None for all
    resolution: float = 0.02  # edge of the map's cells [m]
    padding: float = 0.0  # inflation radius of the cells [m]


def sensor_problem(
    number: int, sensing: Sensing | None = None
) -> SensedProblem | UnsolvableProblem:
    """`scanned_scene` measured; the same noise, start and goal whatever else is varied."""
    scanned = scanned_scene(number)
    if isinstance(scanned, UnsolvableProblem):
        return scanned
    sensing = sensing or Sensing()
    with tempfile.TemporaryDirectory(prefix="cvqmpt-scan-") as folder:
        files = _images(scanned, sensing, Path(folder))
        began = time.perf_counter()
        try:
            problem = _in_map(scanned.truth, files, sensing)
        except InvalidInputError as error:
            return UnsolvableProblem(scanned.truth.name, f"no map: {error}")
        seconds = time.perf_counter() - began
    checker = problem.collision_checker()
    for label, q in problem.labelled_configurations():
        if checker.in_collision(q):
            kind = FailReason.INVALID_START if label == "start" else FailReason.INVALID_GOAL
            return UnsolvableProblem(
                problem.name, f"{label} in the map: {checker.colliding_pair(q)}", kind
            )
    return SensedProblem(problem, scanned.truth.scene, seconds)


def _images(scanned: ScannedScene, sensing: Sensing, folder: Path) -> list[tuple[Path, Path, Path]]:
    """What the cameras measure of the scene with the arm at the start, written to files."""
    truth = scanned.truth
    rng = np.random.default_rng([int(truth.name), 13])
    world = truth.scene.with_objects(*arm_objects(truth.robot, truth.start))
    errors = DepthNoise().times(sensing.noise)
    settings = CameraSettings(cameras=scanned.cameras[: sensing.cameras], errors=errors)
    views = views_of(world, settings, rng)
    if sensing.pixels is not None:
        views = [_thinned(view, sensing.pixels // len(views), rng) for view in views]
    return [write_view(view, folder, f"camera_{k}") for k, view in enumerate(views)]


def _thinned(view: View, pixels: int, rng: np.random.Generator) -> View:
    """The view with no more than so many pixels that measured something."""
    seen = np.flatnonzero(np.isfinite(view.depth))
    depth = np.full(view.depth.size, np.inf)
    kept = rng.choice(seen, min(pixels, len(seen)), replace=False)
    depth[kept] = view.depth.ravel()[kept]
    return replace(view, depth=depth.reshape(view.depth.shape))


def _in_map(
    truth: PlanningProblem, files: list[tuple[Path, Path, Path]], sensing: Sensing
) -> PlanningProblem:
    """The problem in a map of what the files say."""
    captures = [read_capture(*each) for each in files]
    settings = ScanSettings(crop=REACH, voxel=0.5 * sensing.resolution, neighbours=NEIGHBOURS)
    found = scan(captures, settings, np.random.default_rng(0), Arm(truth.robot, truth.start))
    mapped = occupancy_map(
        found.points, MapSettings(resolution=sensing.resolution, padding=sensing.padding)
    )
    return replace(truth, scene=Scene("map", (SceneObject("map", mapped, np.eye(4)),)))


# values tried of each field of `Sensing`, beside its default
LEVELS: Mapping[str, Sequence[Any]] = {
    "noise": (0.0, 2.0, 4.0),
    "cameras": (1, 4),
    "pixels": (40_000, 10_000, 2_500),
    "resolution": (0.01, 0.04),
    "padding": (0.0, 0.01, 0.03, 0.04),
}


def variants() -> tuple[Sensing, ...]:
    """The default, then everything that differs from it in one field."""
    default = Sensing()
    others = (
        replace(default, **{name: level})
        for name, levels in LEVELS.items()
        for level in levels
        if level != getattr(default, name)
    )
    return (default, *others)


def setting(sensing: Sensing) -> str:
    """All fields of a `Sensing` in words, as the table of the rows reads them."""
    values = ((item.name, getattr(sensing, item.name)) for item in fields(sensing))
    return " ".join(
        f"{name}={'all' if value is None else format(value, 'g')}" for name, value in values
    )


def robustness_problem(index: int) -> SensedProblem | UnsolvableProblem:
    """Variant index // 10 of scene index % 10;
    its rows are named like a phase, by scene and setting.
    """
    sensing, number = variants()[index // len(VARIED_SCENES)], index % len(VARIED_SCENES)
    item = sensor_problem(number, sensing)
    name = phase_problem(str(index), number + 1, setting(sensing))
    if isinstance(item, UnsolvableProblem):
        return replace(item, name=name)
    return replace(item, problem=replace(item.problem, name=name))
