"""Planning in the map that depth images give of a scene, and judging paths in the map and in the scene.

The arm stands at the start while it is looked at. Everything goes through files, as in a lab: images with the errors
of depth cameras, intrinsics, extrinsics; then the robot's own points and lonely ones go, and what is left becomes an
occupancy map. Planners know nothing else.
"""

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import FailReason
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.sensing.depth import read_capture, write_view
from cvqmpt_lab.sensing.filters import BallCrop
from cvqmpt_lab.sensing.noise import DepthNoise
from cvqmpt_lab.sensing.occupancy import MapSettings, occupancy_map
from cvqmpt_lab.sensing.render import View
from cvqmpt_lab.sensing.scan import Arm, ScanSettings, scan
from cvqmpt_lab.sensing.virtual import CameraSettings, arm_objects, views_of
from experiments.suites.place_task import UnsolvableProblem
from experiments.suites.scanned_scenes import ScannedScene, scanned_scene

REACH = BallCrop(centre=(0.0, 0.0, 0.33), radius=1.3)
"""What of a scan the arm can touch, and a little more."""

NEIGHBOURS = 8
"""Points with fewer are taken for flying pixels, which come in veils behind edges."""


@dataclass(frozen=True, kw_only=True)
class Sensing:
    """How a scene is measured, and what map is made of it."""

    noise: float = 1.0
    """Errors of the cameras, times those of `DepthNoise`."""
    cameras: int = 2
    """1 to 4."""
    pixels: int | None = None
    """That are kept of all images, drawn at random; None for all."""
    resolution: float = 0.02
    """Edge of the map's cells [m]."""
    padding: float = 0.0
    """Distance by which they are swelled [m]."""


@dataclass(frozen=True)
class SensedProblem:
    """A problem in a map, and the scene that the map is of."""

    problem: PlanningProblem
    """As planners are given it."""
    truth: Scene
    """As it really is."""
    seconds: float
    """From images in files to the problem [s]."""

    @property
    def name(self) -> str:
        """Of the problem."""
        return self.problem.name

    @property
    def true_problem(self) -> PlanningProblem:
        """The same problem in the scene as it really is."""
        return replace(self.problem, scene=self.truth)


def sensor_problem(number: int, sensing: Sensing | None = None) -> SensedProblem | UnsolvableProblem:
    """Scene `number` of `scanned_scenes`, measured; the same noise, start and goal whatever else is varied."""
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
            return UnsolvableProblem(problem.name, f"{label} in the map: {checker.colliding_pair(q)}", kind)
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
    mapped = occupancy_map(found.points, MapSettings(resolution=sensing.resolution, padding=sensing.padding))
    return replace(truth, scene=Scene("map", (SceneObject("map", mapped, np.eye(4)),)))
