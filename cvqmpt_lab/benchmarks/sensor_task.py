"""Planning in a map from depth images; paths are judged in the map and in the scene.

Scenes are kitchens and tables in turn; start and goal are random upright configurations at least
`ROOM` from everything, the straight motion between them blocked. Planners know an occupancy map
alone: noisy depth images with the arm at the start, filtered, without the robot's points.
"""

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.benchmarks.families import family_scene
from cvqmpt_lab.benchmarks.family_task import PANDA, upright_problem
from cvqmpt_lab.benchmarks.item import SensedProblem, UnsolvableProblem
from cvqmpt_lab.benchmarks.kitchen import kitchen
from cvqmpt_lab.benchmarks.place_task import CAN, CRACKER_BOX, DOOR, DOOR_ANGLE, MUSTARD_BOTTLE
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import FailReason
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.sensing.camera import KINECT, Camera, DepthNoise, look_at
from cvqmpt_lab.sensing.crop import Crop
from cvqmpt_lab.sensing.depth import read_capture, write_view
from cvqmpt_lab.sensing.observation import CameraSettings, arm_objects, views_of
from cvqmpt_lab.sensing.scan import Arm, MapSettings, ScanSettings, occupancy_map, scan

ROOM = 0.06  # [m] that start and goal keep from obstacles
THINGS = {
    "cracker_box": (CRACKER_BOX, 0.287),
    "mustard": (MUSTARD_BOTTLE, 0.262),
    "can": (CAN, 0.271),
}
"""On the counter: what, and the height of its centre of mass [m]."""


def scanned_scene(number: int) -> tuple[PlanningProblem, list[Camera]] | UnsolvableProblem:
    """The problem in the real scene with one goal, and its cameras; even: kitchens, odd: tables."""
    rng = np.random.default_rng([number, 12])
    scene = family_scene("table", 3000 + number) if number % 2 else _cluttered_kitchen(number, rng)
    truth = upright_problem(str(number), robot_from_source(PANDA), scene, rng, ROOM)
    if isinstance(truth, UnsolvableProblem):
        return truth
    cameras = []
    # [deg] azimuths of the two cameras as seen from what they look at: behind the robot
    for span in ((130, 160), (185, 205)):
        azimuth, elevation = (np.radians(rng.uniform(*angles)) for angles in (span, (20, 45)))
        target = np.add((0.45, -0.15, 0.35), rng.uniform(-0.1, 0.1, 3))
        flat = np.cos(elevation)
        away = np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)])
        eye = target + rng.uniform(1.2, 1.7) * away
        cameras.append(Camera(KINECT, look_at(eye, target)))
    return truth, cameras


def _cluttered_kitchen(number: int, rng: np.random.Generator) -> Scene:
    """The kitchen of the place task with three things on the right counter, apart."""
    while True:
        # corners x, y of where they stand [m]
        places = rng.uniform((0.32, -0.85), (0.70, -0.20), (len(THINGS), 2))
        gaps = np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(len(THINGS), 1)]
        if gaps.min() > 0.17:
            break
    things = [
        thing.at_com(name, (float(x), float(y), height), float(rng.uniform(-np.pi, np.pi)))
        for (name, (thing, height)), (x, y) in zip(THINGS.items(), places, strict=True)
    ]
    scene = kitchen(door_angles={DOOR: DOOR_ANGLE}).with_objects(*things)
    return Scene(f"kitchen_clutter_{number}", scene.objects)


def sensor_problem(number: int, padding: float = 0.0) -> SensedProblem | UnsolvableProblem:
    """The problem of `scanned_scene` in its cameras' map, of cells inflated by padding [m]."""
    scanned = scanned_scene(number)
    if isinstance(scanned, UnsolvableProblem):
        return scanned
    truth, cameras = scanned
    rng = np.random.default_rng([number, 13])
    world = truth.scene.with_objects(*arm_objects(truth.robot, truth.start))
    views = views_of(world, CameraSettings(cameras=tuple(cameras), errors=DepthNoise()), rng)
    with tempfile.TemporaryDirectory(prefix="cvqmpt-scan-") as folder:
        files = [write_view(view, Path(folder), f"camera_{k}") for k, view in enumerate(views)]
        began = time.perf_counter()
        try:
            problem = _in_map(truth, files, padding)
        except InvalidInputError as error:
            return UnsolvableProblem(truth.name, f"no map: {error}")
        seconds = time.perf_counter() - began
    checker = problem.collision_checker()
    for label, q in problem.labelled_configurations():
        if checker.in_collision(q):
            kind = FailReason.INVALID_START if label == "start" else FailReason.INVALID_GOAL
            return UnsolvableProblem(
                problem.name, f"{label} in the map: {checker.colliding_pair(q)}", kind
            )
    return SensedProblem(problem, truth.scene, seconds)


def _in_map(
    truth: PlanningProblem,
    files: list[tuple[Path, Path, Path]],
    padding: float,
    resolution: float = 0.02,
    neighbours: int = 8,
) -> PlanningProblem:
    """The problem in a map of what the files say.

    Args:
        truth: the problem in the scene that was measured.
        files: depth image, intrinsics and extrinsics of each camera.
        padding: inflation radius of the map's cells [m].
        resolution: edge of the map's cells [m].
        neighbours: points with fewer are taken for flying pixels, which come in veils behind edges.
    """
    # what of a scan the arm can touch, and a little more
    reach = Crop(radius=1.3)
    settings = ScanSettings(crop=reach, voxel=0.5 * resolution, neighbours=neighbours)
    captures = [read_capture(*each) for each in files]
    found = scan(captures, settings, np.random.default_rng(0), Arm(truth.robot, truth.start))
    mapped = occupancy_map(found.points, MapSettings(resolution=resolution, padding=padding))
    return replace(truth, scene=Scene("map", (SceneObject("map", mapped, np.eye(4)),)))
