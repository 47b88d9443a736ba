"""Planning in a map from depth images; paths are judged in the map and in the scene.

Scenes are kitchens and tables in turn; start and goal are random upright configurations at least
6 cm from all obstacles, with a blocked straight motion. Planners know only an
occupancy map: noisy depth images with the arm at the start, filtered, without the robot's points.
"""

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.benchmarks.families import family_scene
from cvqmpt_lab.benchmarks.family_task import upright_problem
from cvqmpt_lab.benchmarks.item import SensedProblem, UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import CAN, COUNTER_OBJECTS, place_kitchen
from cvqmpt_lab.benchmarks.results.row import FailReason
from cvqmpt_lab.collision.exact import checker_of
from cvqmpt_lab.features.scan.depth import read_capture, write_view
from cvqmpt_lab.features.scan.scan import Arm, MapSettings, ScanSettings, occupancy_map, scan
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.sensing.camera import KINECT, Camera, DepthNoise, look_at
from cvqmpt_lab.sensing.crop import Crop
from cvqmpt_lab.sensing.observation import CameraSettings, arm_objects, views_of


def scanned_scene(
    number: int, clear: float = 0.06
) -> tuple[PlanningProblem, list[Camera]] | UnsolvableProblem:
    """Return the problem in the real scene with one goal, and its cameras.

    Args:
        number: number of the scene; even ones are kitchens, odd ones tables.
        clear: distance of start and goal from obstacles [m].
    """
    rng = np.random.default_rng([number, 12])
    scene = family_scene("table", 3000 + number) if number % 2 else _cluttered_kitchen(number, rng)
    panda = robot_from_source({"name": "panda"})
    truth = upright_problem(str(number), panda, scene, rng, clear)
    if isinstance(truth, UnsolvableProblem):
        return truth
    cameras = []
    # ranges of the azimuths of two cameras behind the robot, seen from their targets [deg]
    for span in ((130, 160), (185, 205)):
        azimuth, elevation = (np.radians(rng.uniform(*angles)) for angles in (span, (20, 45)))
        target = np.add((0.45, -0.15, 0.35), rng.uniform(-0.1, 0.1, 3))
        flat = np.cos(elevation)
        away = np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)])
        eye = target + rng.uniform(1.2, 1.7) * away
        cameras.append(Camera(KINECT, look_at(eye, target)))
    return truth, cameras


def _cluttered_kitchen(number: int, rng: np.random.Generator) -> Scene:
    """Return the kitchen of the place task with three separate objects on the right counter."""
    models = {  # and the height of the centre of mass [m]
        "cracker_box": (COUNTER_OBJECTS["cracker_box"], 0.287),
        "mustard": (COUNTER_OBJECTS["mustard_bottle"], 0.262),
        "can": (CAN, 0.271),
    }
    while True:
        # between two corners of the counter, x and y [m]
        places = rng.uniform((0.32, -0.85), (0.70, -0.20), (len(models), 2))
        gaps = np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(len(models), 1)]
        if gaps.min() > 0.17:
            break
    things = [
        model.at_com(name, (float(x), float(y), height), float(rng.uniform(-np.pi, np.pi)))
        for (name, (model, height)), (x, y) in zip(models.items(), places, strict=True)
    ]
    scene = place_kitchen().with_objects(*things)
    return Scene(f"kitchen_clutter_{number}", scene.objects)


def sensor_problem(number: int, padding: float = 0.0) -> SensedProblem | UnsolvableProblem:
    """Return the problem of `scanned_scene` in the map of its cameras.

    padding: inflation radius of the map's cells [m].
    """
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
    checker = checker_of(problem)
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
    """Return the problem in a map that is made of camera files.

    Args:
        truth: problem in the scene that was measured.
        files: depth image, intrinsics and extrinsics of each camera.
        padding: inflation radius of the map's cells [m].
        resolution: edge of the map's cells [m].
        neighbours: points with fewer neighbours are removed as flying pixels behind edges.
    """
    # points that the arm can touch, and a little more
    reach = Crop(radius=1.3)
    settings = ScanSettings(crop=reach, voxel=0.5 * resolution, neighbours=neighbours)
    captures = [read_capture(*each) for each in files]
    found = scan(captures, settings, np.random.default_rng(0), Arm(truth.robot, truth.start))
    mapped = occupancy_map(found.points, MapSettings(resolution=resolution, padding=padding))
    return replace(truth, scene=Scene("map", (SceneObject("map", mapped, np.eye(4)),)))
