"""What a scan costs: a million points from a file, a depth image, its filters, from that image to a certified path."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from cvqmpt_lab.constraints.task_space_region import upright
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.scene.cloud_files import write_cloud
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.sensing.camera import DepthCamera, Lens
from cvqmpt_lab.sensing.depth import read_capture
from cvqmpt_lab.sensing.filters import BoxCrop, lonely, near_robot
from cvqmpt_lab.sensing.plane import CAMERA_TILT, CAMERA_UP, supporting_plane
from cvqmpt_lab.sensing.render import view_of
from cvqmpt_lab.sensing.scan import Arm, ScanSettings, refuse_touching, scan
from cvqmpt_lab.sensing.virtual import arm_objects, solids_of, write_view
from experiments.bench.timing import Figure, calibration, timed

START = np.array([-0.9, 0.3, 0.0, -2.0, 0.0, 2.3, 0.8])
GOAL = START * (-1, 1, 1, 1, 1, 1, 1)
BENCH = (
    SceneObject("table", Box((0.8, 1.4, 0.04)), pose((0.65, 0.0, -0.05))),
    SceneObject("post", Box((0.08, 0.08, 0.6)), pose((0.6, 0.1, 0.27))),
)
LENS = Lens(width=640, height=576, vertical_fov=65.0, near=0.2)
EYE = DepthCamera((-0.3, 0.5, 1.3), (0.55, 0.0, 0.0))


def bench_scan() -> list[Figure]:
    """Times of what lies between a camera and a plan."""
    with TemporaryDirectory() as folder:
        return [calibration(), _million(Path(folder)), *_image(Path(folder))]


def _million(folder: Path) -> Figure:
    """A million points of a room-size wave, half of them outside the crop."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.2, 1.2, (1_000_000, 3))
    points[:, 2] = 0.3 * np.sin(3.0 * points[:, 0])
    write_cloud(folder / "million.pcd", points)
    settings = ScanSettings(crop=BoxCrop(), neighbours=0)
    return timed(
        "10^6 points of a PCD: load, crop, 1 cm voxels",
        lambda: scan([read_capture(folder / "million.pcd")], settings, rng),
        1,
        "ms",
    )


def _image(folder: Path) -> list[Figure]:
    """A depth image of a bench with an arm in it."""
    robot, rng = panda(), np.random.default_rng(0)
    arm = Arm(robot, START)
    view = view_of(solids_of((*BENCH, *arm_objects(robot, START))), EYE, LENS)
    files = write_view(view, folder, "depth")
    capture = read_capture(*files)
    points = scan([capture], ScanSettings(), rng).points

    def planned() -> None:
        scene = scan([read_capture(*files)], ScanSettings(), rng, arm).scene()
        refuse_touching(scene, arm)
        tilt = (upright(0.1, "-z"),)
        problem = PlanningProblem("scan", robot, scene, start=START, goals=GOAL[None], constraint=tilt)
        solution = solve(problem, "birrt", Budget(seconds=10.0), seed=0)
        assert solution.solved, solution.plan.status

    return [
        timed("depth image 640 x 576: read, points", lambda: read_capture(*files), 1, "ms"),
        timed(
            "supporting plane of it",
            lambda: supporting_plane(capture.points, CAMERA_UP, CAMERA_TILT, rng),
            1,
            "ms",
        ),
        timed("points on the arm", lambda: near_robot(points, robot, START, 0.05), 1, "ms"),
        timed("points without neighbours", lambda: lonely(points, 0.03, 2), 1, "ms"),
        timed("map of 2 cm", lambda: scan([capture], ScanSettings(neighbours=0), rng).scene(), 1, "ms"),
        timed("from the image to a certified path, everything counted", planned, 1, "ms"),
    ]
