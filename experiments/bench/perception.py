"""What seeing costs and how well it is done:
edge validity, scans, the pose of a camera from the arm in its picture.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.task_space_region import upright
from cvqmpt_lab.labels.edge_labels import area, calibration_error
from cvqmpt_lab.labels.path_labels import unconstrained_space
from cvqmpt_lab.labels.roadmap_labels import roadmap_graph, verdicts
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.cloud_files import write_cloud
from cvqmpt_lab.scene.families import FAMILIES, another_scene, family_scene
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.sensing.calibration import Calibration, calibrate
from cvqmpt_lab.sensing.camera import KINECT, Camera, Intrinsics, cameras_on_sphere, look_at
from cvqmpt_lab.sensing.depth import read_capture, write_view
from cvqmpt_lab.sensing.filters import BallCrop, BoxCrop, near_robot, outliers
from cvqmpt_lab.sensing.icp import small_motions
from cvqmpt_lab.sensing.noise import DepthNoise
from cvqmpt_lab.sensing.plane import CAMERA_TILT, CAMERA_UP, supporting_plane
from cvqmpt_lab.sensing.render import view_of
from cvqmpt_lab.sensing.scan import Arm, ScanSettings, refuse_touching, scan
from cvqmpt_lab.sensing.virtual import (
    CameraSettings,
    arm_objects,
    camera_cloud,
    solids_of,
    views_of,
)
from cvqmpt_lab.vqmpt.edge_model import EdgeModel
from cvqmpt_lab.vqmpt.stages import POINTS, dictionary_roadmap
from experiments.bench.measurement import CpuTimes, Measurement

FIRST_SCENE = 3000  # numbers that no dataset uses; tables of suite sensor are among them
KITCHEN = "kitchen of the tasks"
AROUND = CameraSettings.like_training(POINTS)
TWO_NOISY = replace(
    AROUND,
    cameras=cameras_on_sphere(
        Intrinsics.from_fov(vertical_fov=70.0, near=0.1),
        (45.0, -135.0),
        (40.0,),
        centre=BallCrop().centre,
    ),
    noise=0.0,
    errors=DepthNoise(),
)
CAMERAS: Mapping[str, CameraSettings] = {"8 cameras": AROUND, "2 noisy cameras": TWO_NOISY}
OTHER = "another scene's cloud"

START = np.array([-0.9, 0.3, 0.0, -2.0, 0.0, 2.3, 0.8])
GOAL = START * (-1, 1, 1, 1, 1, 1, 1)
BENCH = (
    SceneObject("table", Box((0.8, 1.4, 0.04)), pose((0.65, 0.0, -0.05))),
    SceneObject("post", Box((0.08, 0.08, 0.6)), pose((0.6, 0.1, 0.27))),
)
LENS = Intrinsics.from_fov(width=640, height=576, vertical_fov=65.0, near=0.2)
CAMERA = Camera(LENS, look_at((-0.3, 0.5, 1.3), (0.55, 0.0, 0.0)))

GUESS = 0.1, 10.0  # [m], [deg] that guesses are wrong at most
PROMISED = 5.0, 0.5  # [mm], [deg]
CLUTTER = 12  # boxes on the floor
JOINT_ERROR = 0.3  # [rad] of one joint in a wrong configuration


def bench_edge_model(scenes: int) -> Iterator[Measurement]:
    """How well the edge validity model separates the Panda's free from blocked motions, by family
    and camera: area under the curve and calibration error, as medians over scenes.
    """
    robot = panda()
    edges = EdgeModel(robot)
    graph = roadmap_graph(robot, dictionary_roadmap("vq_mpt", robot))
    motions = np.ascontiguousarray(graph.nodes[graph.edges[graph.edge_possible]])
    other = camera_cloud(another_scene(), AROUND, np.random.default_rng(0))
    numbers = range(FIRST_SCENE, FIRST_SCENE + scenes)
    for family in (*FAMILIES, KITCHEN):
        seen: dict[str, list[tuple[float, float]]] = {name: [] for name in (*CAMERAS, OTHER)}
        for scene in (
            [kitchen()] if family == KITCHEN else [family_scene(family, k) for k in numbers]
        ):
            space = unconstrained_space(robot, scene)
            checked = verdicts(space, graph.nodes, graph.edges, graph.edge_possible)
            if checked is None or not checked[1].any():
                continue
            free, rng = checked[1][graph.edge_possible], np.random.default_rng(0)
            clouds = {
                name: camera_cloud(scene, settings, rng) for name, settings in CAMERAS.items()
            }
            for name, cloud in {**clouds, OTHER: other}.items():
                odds = edges.log_odds(cloud, motions)[1]
                seen[name].append((area(odds, free), calibration_error(odds, free)))
        for name, found in seen.items():
            columns = np.array(found).reshape(-1, 2).T
            for what, column in zip(("AUC", "calibration error"), columns, strict=True):
                yield Measurement(f"{family}, {name}: {what}", "", column)
    yield Measurement(
        "P(free) of a motion", "us", lambda: edges.log_odds(other, motions), len(motions)
    )
    yield Measurement(
        "distance field of a cloud", "ms", lambda: edges.arrays(other, use_cache=False)
    )


def bench_scan() -> Iterator[Measurement]:
    """What lies between a camera and a plan: a million points from a file;
    a depth image of a bench with an arm.
    """
    robot, rng = panda(), np.random.default_rng(0)
    points = rng.uniform(-1.2, 1.2, (1_000_000, 3))  # a room-size wave, half of it outside the crop
    points[:, 2] = 0.3 * np.sin(3.0 * points[:, 0])
    cropped, all_points, arm = (
        ScanSettings(crop=BoxCrop(), neighbours=0),
        ScanSettings(),
        Arm(robot, START),
    )
    with TemporaryDirectory() as name:
        million = Path(name) / "million.pcd"
        write_cloud(million, points)
        view = view_of(solids_of((*BENCH, *arm_objects(robot, START))), CAMERA)
        files = write_view(view, Path(name), "depth")
        capture = read_capture(*files)
        seen = scan([capture], all_points, rng).points

        def planned() -> None:
            scene = scan([read_capture(*files)], all_points, rng, arm).scene()
            refuse_touching(scene, arm)
            tilt = (upright(0.1, "-z"),)
            problem = PlanningProblem(
                "scan", robot, scene, start=START, goals=GOAL[None], constraint=tilt
            )
            solution = solve(problem, "birrt", Budget(seconds=10.0), seed=0)
            assert solution.solved, solution.plan.status

        for what, call in {
            "10^6 points of a PCD: load, crop, 1 cm voxels": lambda: scan(
                [read_capture(million)], cropped, rng
            ),
            "depth image 640 x 576: read, points": lambda: read_capture(*files),
            "supporting plane of it": lambda: supporting_plane(
                capture.points, CAMERA_UP, CAMERA_TILT, rng
            ),
            "points on the arm": lambda: near_robot(seen, robot, START, 0.05),
            "points without neighbours": lambda: outliers(seen, 0.03, 2),
            "map of 2 cm": lambda: scan([capture], ScanSettings(neighbours=0), rng).scene(),
            "from the image to a certified path, everything counted": planned,
        }.items():
            yield Measurement(what, "ms", call)


class ArmScan(NamedTuple):
    """What one noisy camera saw of an arm among boxes."""

    points: np.ndarray  # (m, 3) [m, camera frame]
    T_world_camera: np.ndarray  # (4, 4), the truth [m]
    T_world_guess: np.ndarray  # (4, 4), `GUESS` from it at most [m]
    arm: Arm


def arm_scan(robot: Robot, seed: int) -> ArmScan:
    """A scan with random boxes, configuration, camera, materials and noise."""
    rng = np.random.default_rng(seed)
    objects = [SceneObject("floor", Box((4.0, 4.0, 0.1)), pose((0.0, 0.0, -0.06)), obstacle=False)]
    for k in range(CLUTTER):
        azimuth, away = rng.uniform(-np.pi, np.pi), rng.uniform(0.35, 0.9)
        wide, deep, tall = rng.uniform((0.05, 0.05, 0.08), (0.2, 0.2, 0.4)).tolist()
        place = (away * np.cos(azimuth), away * np.sin(azimuth), 0.5 * tall)
        objects.append(
            SceneObject(f"box{k}", Box((wide, deep, tall)), pose(place, rng.uniform(0.0, 3.0)))
        )
    checker = CollisionChecker(robot, Scene("boxes", tuple(objects)))
    q = robot.random_configurations(rng, 1)[0]
    while checker.in_collision(q) or robot.pose(q)[2, 3] < 0.1:
        q = robot.random_configurations(rng, 1)[0]
    target = (0.0, 0.0, 0.4) + rng.normal(0.0, 0.1, 3)
    azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(np.radians(15.0), np.radians(60.0))
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    towards = np.cos(elevation) * level + (0.0, 0.0, np.sin(elevation))
    T = look_at(target + rng.uniform(1.2, 2.0) * towards, target)
    settings = CameraSettings(cameras=(Camera(KINECT, T),), errors=DepthNoise())
    (view,) = views_of(Scene("scan", (*objects, *arm_objects(robot, q))), settings, rng)
    wrong = np.concatenate([_in_ball(rng, np.radians(GUESS[1])), _in_ball(rng, GUESS[0])])
    points = (view.points - T[:3, 3]) @ T[:3, :3]
    return ArmScan(points, T, T @ small_motions(wrong[None])[0], Arm(robot, q))


def _in_ball(rng: np.random.Generator, radius: float) -> np.ndarray:
    """A vector (3,), uniform in a ball."""
    direction = rng.normal(size=3)
    return radius * rng.random() ** (1.0 / 3.0) * direction / np.linalg.norm(direction)


def pose_error(scan: ArmScan, found: Calibration) -> tuple[float, float]:
    """How wrong a calibration is [mm, deg]."""
    way = np.linalg.inv(scan.T_world_camera) @ found.T_world_camera
    turn = Rotation.from_matrix(way[:3, :3]).magnitude()
    return 1e3 * float(np.linalg.norm(way[:3, 3])), float(np.degrees(turn))


def bench_calibration(robot: Robot, scans: int) -> Iterator[Measurement]:
    """Calibrate from scans, with the right configuration and with ones that are not, which should
    be refused.
    """
    clock, errors, trusted = CpuTimes(), [], []
    refused: dict[str, list[bool]] = {
        "another configuration": [],
        f"one joint {JOINT_ERROR:g} rad off": [],
    }
    for seed in range(scans):
        one, rng = arm_scan(robot, seed), np.random.default_rng(seed)
        found = clock("time", calibrate, one.points, one.T_world_guess, one.arm, rng)
        errors.append(pose_error(one, found))
        trusted.append(not found.doubts)
        other = robot.random_configurations(rng, 1)[0]
        bent = one.arm.q + JOINT_ERROR * np.eye(robot.dof)[rng.integers(1, robot.dof - 1)]
        for name, q in zip(refused, (other, bent), strict=True):
            doubtful = calibrate(one.points, one.T_world_guess, Arm(robot, q), rng)
            refused[name].append(bool(doubtful.doubts))
    error, sure = np.array(errors), np.array(trusted)
    kept = (error <= PROMISED).all(axis=1)
    within = f"within {PROMISED[0]:g} mm and {PROMISED[1]:g} deg, of {scans} scans"
    yield Measurement(within, "%", [100.0 * kept.mean()])
    yield Measurement("trusted", "%", [100.0 * sure.mean()])
    yield Measurement("trusted, but not within", "scans", [(sure & ~kept).sum()])
    yield Measurement("camera's position, all", "mm", error[:, 0])
    yield Measurement("camera's position, trusted", "mm", error[sure, 0])
    for name, doubted in refused.items():
        yield Measurement(f"refused: {name}", "%", 100.0 * np.mean([doubted], axis=1))
    yield from clock.measurements()
