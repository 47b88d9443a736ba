"""How often a camera's pose is found from the arm in its picture, and whether wrong results are refused."""

import time
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.poses import pose
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.exact_checker import CollisionChecker
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.sensing.calibration import Calibration, calibrate
from cvqmpt_lab.sensing.camera import KINECT, DepthCamera
from cvqmpt_lab.sensing.icp import small_motions
from cvqmpt_lab.sensing.noise import DepthNoise
from cvqmpt_lab.sensing.scan import Arm
from cvqmpt_lab.sensing.virtual import CameraSettings, arm_objects, views_of
from experiments.bench.timing import Figure, single, spread

GUESS = 0.1, 10.0  # [m], [deg] that guesses are wrong at most
PROMISED = 5.0, 0.5  # [mm], [deg]
CLUTTER = 12  # boxes on the floor
JOINT_ERROR = 0.3  # [rad] of one joint in a wrong configuration


class ArmScan(NamedTuple):
    """What one noisy camera saw of an arm among boxes."""

    points: np.ndarray
    """(m, 3) [m, camera frame]."""
    T_world_camera: np.ndarray
    """(4, 4), the truth [m]."""
    T_world_guess: np.ndarray
    """(4, 4), `GUESS` from it at most [m]."""
    arm: Arm
    """As it was."""


def arm_scan(robot: Robot, seed: int) -> ArmScan:
    """A scan with random boxes, configuration, camera, materials and noise."""
    rng = np.random.default_rng(seed)
    scene = _boxes(rng)
    checker = CollisionChecker(robot, scene)
    q = robot.random_configurations(rng, 1)[0]
    while checker.in_collision(q) or robot.pose(q)[2, 3] < 0.1:
        q = robot.random_configurations(rng, 1)[0]
    target = (0.0, 0.0, 0.4) + rng.normal(0.0, 0.1, 3)
    azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(np.radians(15.0), np.radians(60.0))
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    towards = np.cos(elevation) * level + (0.0, 0.0, np.sin(elevation))
    x, y, z = (target + rng.uniform(1.2, 2.0) * towards).tolist()
    camera = DepthCamera((x, y, z), tuple(target.tolist()))
    settings = CameraSettings(cameras=(camera,), lens=KINECT, errors=DepthNoise())
    (view,) = views_of(Scene("scan", scene.objects + arm_objects(robot, q)), settings, rng)
    T = camera.T_world_camera
    wrong = np.concatenate([_in_ball(rng, np.radians(GUESS[1])), _in_ball(rng, GUESS[0])])
    points = (view.points - T[:3, 3]) @ T[:3, :3]
    return ArmScan(points, T, T @ small_motions(wrong[None])[0], Arm(robot, q))


class PoseError(NamedTuple):
    """How far a camera's pose is from the truth."""

    millimetres: float
    degrees: float

    @property
    def kept(self) -> bool:
        """Whether it is what is promised."""
        return self.millimetres <= PROMISED[0] and self.degrees <= PROMISED[1]


def pose_error(scan: ArmScan, found: Calibration) -> PoseError:
    """How wrong a calibration is."""
    way = np.linalg.inv(scan.T_world_camera) @ found.T_world_camera
    turn = Rotation.from_matrix(way[:3, :3]).magnitude()
    return PoseError(1e3 * float(np.linalg.norm(way[:3, 3])), float(np.degrees(turn)))


def bench_calibration(robot: Robot, scans: int) -> list[Figure]:
    """Calibrate from scans, with the right configuration and with ones that are not."""
    errors, trusted, seconds = [], [], []
    refused: dict[str, list[bool]] = {"another configuration": [], f"one joint {JOINT_ERROR:g} rad off": []}
    for seed in range(scans):
        scan = arm_scan(robot, seed)
        rng = np.random.default_rng(seed)
        began = time.process_time()
        found = calibrate(scan.points, scan.T_world_guess, scan.arm, rng)
        seconds.append(time.process_time() - began)
        errors.append(pose_error(scan, found))
        trusted.append(not found.doubts)
        other = robot.random_configurations(rng, 1)[0]
        bent = scan.arm.q + JOINT_ERROR * np.eye(robot.dof)[rng.integers(1, robot.dof - 1)]
        for name, q in zip(refused, (other, bent), strict=True):
            doubtful = calibrate(scan.points, scan.T_world_guess, Arm(robot, q), rng)
            refused[name].append(bool(doubtful.doubts))
    kept, sure = np.array([error.kept for error in errors]), np.array(trusted)
    lengths = np.array([error.millimetres for error in errors])
    return [
        single(
            f"within {PROMISED[0]:g} mm and {PROMISED[1]:g} deg, of {scans} scans", 100.0 * kept.mean(), "%"
        ),
        single("trusted", 100.0 * sure.mean(), "%"),
        single("trusted, but not within", float((sure & ~kept).sum()), "scans"),
        spread("camera's position, all", lengths, "mm"),
        spread("camera's position, trusted", lengths[sure], "mm"),
        *(single(f"refused: {name}", 100.0 * float(np.mean(found)), "%") for name, found in refused.items()),
        spread("time", np.array(seconds), "s"),
    ]


def _boxes(rng: np.random.Generator) -> Scene:
    """A floor and boxes that stand on it around the arm."""
    objects = [SceneObject("floor", Box((4.0, 4.0, 0.1)), pose((0.0, 0.0, -0.06)), obstacle=False)]
    for k in range(CLUTTER):
        azimuth, away = rng.uniform(-np.pi, np.pi), rng.uniform(0.35, 0.9)
        wide, deep, tall = rng.uniform((0.05, 0.05, 0.08), (0.2, 0.2, 0.4)).tolist()
        place = (away * np.cos(azimuth), away * np.sin(azimuth), 0.5 * tall)
        objects.append(SceneObject(f"box{k}", Box((wide, deep, tall)), pose(place, rng.uniform(0.0, 3.0))))
    return Scene("boxes", tuple(objects))


def _in_ball(rng: np.random.Generator, radius: float) -> np.ndarray:
    """A vector (3,), uniform in a ball."""
    direction = rng.normal(size=3)
    return radius * rng.random() ** (1.0 / 3.0) * direction / np.linalg.norm(direction)
