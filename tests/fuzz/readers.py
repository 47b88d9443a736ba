"""Every reader of external files: a good file, how it is made hostile, and how it is used."""

import hashlib
import io
import json
import os
import pickle
import shutil
import tempfile
from collections.abc import Callable
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.stats  # noqa: F401  # tables import it late, which would count as time of the first file
import torch
import trimesh
from cloud_files import GOOD, npy
from fuzz.mutation import damaged, hostile_json, hostile_xml, rarely
from hypothesis import strategies as st
from made_rows import a_row
from PIL import Image
from random_arms import random_urdf
from refusals import DATA
from training_data import write_dataset

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.results.provenance import PROVENANCE_FILE, provenance
from cvqmpt_lab.benchmarks.results.row import RUNS_FILE, csv_text, read_rows
from cvqmpt_lab.features.motion.motion_check import dry_run
from cvqmpt_lab.features.motion.timing import time_path
from cvqmpt_lab.features.motion.trajectory import read_motion, save_trajectory
from cvqmpt_lab.features.scan.depth import read_capture, read_extrinsics, read_intrinsics
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.paper_tables.rendering import render_directory
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import load_robot, panda, robot_from_source
from cvqmpt_lab.scene.cloud_files import read_cloud
from cvqmpt_lab.scene.mesh_files import read_mesh, read_triangles
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Sphere
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.training.dataset import open_dataset
from cvqmpt_lab.training.mpnet_stage import MPNet
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint, read_tensors, save_checkpoint
from cvqmpt_lab.vqmpt.config import MPNetConfig
from cvqmpt_lab.vqmpt.weights import read_model, robot_signature

EVERY = "hostile files of every kind end in a result or one line"
LATER = (
    "hostile joint limits, joint states, OpenCV calibrations and tables end in a result or one line"
)
SIDE = 24  # of depth images
SHARD = "shards/000000.npz"  # of training data


class Reader(NamedTuple):
    kind: str  # of file, as docs/guarantees.md names it
    file: str  # name that a file is given
    good: Callable[[], bytes]  # a file as it should be
    mutated: Callable[[bytes], st.SearchStrategy]  # hostile files made of it
    use: Callable[[Path], object]  # reads a file and uses what it says
    long: int = 100_000  # files of the long form
    seconds: float = 1.0  # of processor time that a file may take
    promise: str = EVERY


@cache
def problem():
    """Return a problem with every kind of shape, a load, and regions of both forms."""
    cloud = PointCloud(np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3)), 0.01)
    solid = Box((0.1, 0.2, 0.3)), Cylinder(0.1, 0.2), Sphere(0.1), ConvexMesh(0.1 * np.eye(4, 3))
    placed = ((f"s{k}", it, pose((2.0, k, 0.5))) for k, it in enumerate((*solid, cloud)))
    scene = Scene("room", tuple(SceneObject(*each) for each in placed))
    plain = json.loads((DATA / "problem-1.json").read_text()) | {"scene": to_plain(scene)}
    plain["constraint"].insert(0, {"upright": 0.1})
    return json.dumps(plain).encode()


def plan(path):
    solve(PlanningProblem.load(path), "birrt", Budget(iterations=20), seed=0)


@cache
def motion(ending):
    ends = np.array([[0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8], [0.1, -0.7, 0.0, -2.2, 0.0, 1.6, 0.8]])
    return saved(f"motion{ending}", partial(save_trajectory, time_path(ends, panda().joint_limits)))


def saved(name, save):
    """Return the content that `save` writes to a file of this name."""
    with tempfile.TemporaryDirectory() as folder:
        save(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def table(separator, decimal="."):
    """Return the motion as a table with another separator, and decimal points or commas."""
    text = motion(".csv").decode().replace(".", decimal)
    return (text if separator == "," else text.replace(",", separator)).encode()


def execute(path):
    dry_run(PlanningProblem.from_dict(json.loads(problem())), read_motion(path))


def hostile_robot(urdf):
    return st.integers(0, 99).map(random_urdf).flatmap(hostile_xml)


def move(path):
    robot = load_robot(path, "tool")
    robot.poses(robot.random_configurations(np.random.default_rng(0), 3))


def cloud(path):
    points = read_cloud(path).points
    assert points.ndim == 2 and points.shape[1] == 3 and len(points) and np.isfinite(points).all()


def ring(kind):
    data = trimesh.creation.annulus(0.4, 0.5, 1.0, sections=8).export(file_type=kind)
    return data.encode() if isinstance(data, str) else data


def triangles(path):
    corners = read_triangles(path)
    assert corners.shape[1:] == (3, 3) and np.isfinite(corners).all()


def depth(ending):
    image = np.random.default_rng(0).integers(0, 3000, (SIDE, SIDE))
    if ending == ".npy":
        return npy(0.001 * image)
    stream = io.BytesIO()
    Image.fromarray(image.astype(np.uint16)).save(stream, format="PNG")
    return stream.getvalue()


def lens():
    data = {"width": SIDE, "height": SIDE, "fx": 20.0, "fy": 20.0, "cx": 11.5, "cy": 11.5}
    return json.dumps(data).encode()


def capture(path):
    path.with_name("lens.json").write_bytes(lens())
    points = read_capture(path, path.with_name("lens.json")).points
    assert points.shape[1:] == (3,) and len(points) <= SIDE**2
    assert np.isfinite(points).all() and (points[:, 2] > 0.0).all()


def intrinsics(path):
    found = read_intrinsics(path)
    assert 0 <= found.cx < found.width and 0 <= found.cy < found.height
    assert found.fx > 0.0 and found.fy > 0.0


def extrinsics(path):
    T = read_extrinsics(path)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
    assert np.isfinite(T).all() and np.linalg.det(T[:3, :3]) > 0.0


LENS_OF_ROS = b"""image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [525, 0.0, 319.5, 0.0, 5.26e2, 239.5, 0, 0, 1.]}
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""
LENS_OF_OPENCV = b"""%YAML:1.0
---
image_width: 512
image_height: 424
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 365., 0., 256., 0., 3.65e+02, 212., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0., 0., 0., 0., 0. ]
"""
POSE = {
    "translation": {"x": 0.1, "y": -0.5, "z": 1.2},
    "rotation": {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8},
}


LIMITS = b"""/**:
  ros__parameters:
    robot_description_planning:
      joint_limits:
        panda_joint1: {has_position_limits: false, has_velocity_limits: true, max_velocity: 2.1,
          has_acceleration_limits: true, max_acceleration: 3.75, has_jerk_limits: false}
        panda_joint4:
          has_position_limits: true
          min_position: !degrees -170.0
          max_position: !radians -0.1
"""


def limits_in_json():
    rates = {"velocity": 2.1, "acceleration": 3.75, "jerk": 1e3, "effort": 80}
    one = {f"max_{kind}": value for kind, value in rates.items()}
    one |= {f"has_{kind}_limits": True for kind in rates}
    one |= {"has_position_limits": True, "min_position": -0.5, "max_position": 1.0}
    return json.dumps({"joint_limits": {f"panda_joint{k}": one for k in (1, 2, 3)}}).encode()


def limited(path):
    """Load an arm with the limits of a file, which only narrow those of the URDF."""
    robot = robot_from_source({"name": "panda", "joint_limits": str(path)})
    assert (robot.lower < robot.upper).all() and (robot.velocity_limits > 0.0).all()
    assert (robot.lower >= panda().lower).all() and (robot.upper <= panda().upper).all()
    assert np.isfinite(robot.velocity_limits).all()


def joint_state():
    names = [*panda().joint_names, "panda_finger_joint1", "wheel"]
    values = [0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8, 0.02, 31.4]
    stamp = {"stamp": {"sec": 3, "nanosec": 12}, "frame_id": ""}
    state = {"header": stamp, "name": names, "position": values, "velocity": [], "effort": []}
    return json.dumps({"joint_state": state, "is_diff": False}).encode()


def standing(path):
    """Begin a problem where a JointState message says."""
    around = json.loads((DATA / "problem-1.json").read_text()) | {"start": "HERE"}
    begun = path.with_name("problem.json")
    begun.write_bytes(json.dumps(around).encode().replace(b'"HERE"', path.read_bytes()))
    problem = PlanningProblem.load(begun)
    assert problem.start.shape == (7,) and np.isfinite(problem.start).all()


def rows():
    runs = product(range(3), ("birrt", "cvq-mpt"))
    return csv_text([a_row(str(k), name, t_total_s=0.1, vertices=7) for k, name in runs]).encode()


@cache
def record():
    session = provenance(["cvqmpt", "reproduce"], [0], {"vq_mpt": "0" * 64}, 2)
    settings = {"suite": "place-task", "cutoff_s": 10.0, "iterations": 300, "backend": "compiled"}
    return json.dumps({**session, "configuration": settings, "continued": [session]}).encode()


def render(path):
    (path.parent / RUNS_FILE).write_bytes(rows())
    render_directory(path.parent)


@cache
def network():
    """Description and tensors of a small MPNet."""
    sizes = MPNetConfig(n_points=20, encoder_widths=(8,), code_dim=4, planner_widths=(8, 6))
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "weights"
        modules = {"mpnet": MPNet(sizes)}
        save_checkpoint(folder, Checkpoint(sizes, robot_signature(panda()), modules))
        return (folder / "config.json").read_bytes(), (folder / "mpnet.safetensors").read_bytes()


def weights(path):
    """Read weights with one hostile file; the description has the sha256 of the given tensors."""
    beside, content = "mpnet.safetensors", network()[1]
    if path.name == beside:
        stated = json.loads(network()[0])
        stated["sha256"]["mpnet"] = hashlib.sha256(path.read_bytes()).hexdigest()
        beside, content = "config.json", json.dumps(stated).encode()
    (path.parent / beside).write_bytes(content)
    read_model(path.parent)


class Runs:
    """Object whose pickle contains a call, which an unsafe reader executes."""

    def __init__(self, call, *arguments):
        self.call = call, arguments

    def __reduce__(self):
        return self.call


def checkpoint():
    """Return a checkpoint as torch writes it."""
    state = {f"layer.{k}": torch.arange(12.0).reshape(3, 4) for k in range(4)}
    kept = {"encoder_state": state, "epoch": 3, "optimizer": {"lr": 0.1}}
    return saved("a.pkl", partial(torch.save, kept))


def damaged_or_running(content):
    calls = (
        Runs(os.system, "touch /tmp/owned"),
        Runs(eval, "__import__('os').system('id')"),
        Runs(shutil.rmtree, "/nowhere"),
        Runs(open, "/tmp/owned", "w"),
        Runs(bytearray, 2**40),
    )
    running = [pickle.dumps({"state": call}, protocol) for call, protocol in product(calls, (2, 4))]
    return rarely(damaged(content), st.sampled_from(running), 10)


@cache
def dataset():
    """Return the files of a small folder of training data: content by name."""
    with tempfile.TemporaryDirectory() as folder:
        write_dataset(Path(folder), shards=((20, 1),), paths_per_scene=2)
        files = [path for path in Path(folder).rglob("*") if path.is_file()]
        return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def training_data(path):
    """Open a dataset with one hostile file."""
    folder = path.parent.parent if path.suffix == ".npz" else path.parent
    for name, content in dataset().items():
        if folder / name != path:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)
    open_dataset(folder)


FEW = 20_000
READERS = (
    Reader("problems", "problem.json", problem, hostile_json, plan, FEW),
    Reader("paths and trajectories", "motion.csv", partial(motion, ".csv"),
           damaged, execute, FEW // 2),
    *(
        Reader("paths and trajectories", "motion.csv", partial(table, *signs),
               damaged, execute, FEW // 2, promise=LATER)
        for signs in ((" ",), (";", ","), ("\t",))
    ),
    Reader("paths and trajectories", "motion.json", partial(motion, ".json"),
           hostile_json, execute, FEW // 2),
    Reader("tasks", "task.json", (DATA / "task-1.json").read_bytes, hostile_json, Task.load, FEW),
    Reader("robots", "arm.urdf", partial(random_urdf, 3), hostile_robot, move, FEW),
    Reader("joint limits", "limits.yaml", partial(bytes, LIMITS), damaged, limited, FEW // 2,
           promise=LATER),
    Reader("joint limits", "limits.json.yaml", limits_in_json, hostile_json, limited, FEW // 2,
           promise=LATER),
    Reader("joint states", "state.json", joint_state, hostile_json, standing, FEW // 2,
           promise=LATER),
    *(
        Reader("clouds", name, partial(bytes, GOOD[name]), damaged, cloud, 14_000)
        for name in ("a.pcd", "b.pcd", "c.pcd", "a.ply", "b.ply", "a.npy", "a.xyz")
    ),
    *(
        Reader("meshes", f"mesh.{kind}", partial(ring, kind), damaged, triangles, 33_000)
        for kind in ("stl", "obj", "dae")
    ),
    Reader("meshes, cut into convex pieces", "mesh.obj", partial(ring, "obj"),
           damaged, read_mesh, 500, 5.0),
    Reader("depth images and cameras", "depth.png", partial(depth, ".png"), damaged, capture, FEW),
    Reader("depth images and cameras", "depth.npy", partial(depth, ".npy"), damaged, capture, FEW),
    Reader("depth images and cameras", "lens.json", lens, hostile_json, intrinsics, FEW),
    Reader("depth images and cameras", "lens.yaml", partial(bytes, LENS_OF_ROS),
           damaged, intrinsics, FEW),
    Reader("depth images and cameras", "opencv.yaml", partial(bytes, LENS_OF_OPENCV),
           damaged, intrinsics, FEW, promise=LATER),
    Reader("depth images and cameras", "pose.json", json.dumps({"T_world_camera": POSE}).encode,
           hostile_json, extrinsics, FEW),
    Reader("rows and provenance", RUNS_FILE, rows, damaged, read_rows),
    Reader("rows and provenance", PROVENANCE_FILE, record, hostile_json, render),
    Reader("weights", "config.json", lambda: network()[0], hostile_json, weights, FEW // 2),
    Reader("weights", "mpnet.safetensors", lambda: network()[1], damaged, weights, FEW // 2),
    Reader("checkpoints of others", "best_model.pkl", checkpoint, damaged_or_running, read_tensors),
    *(
        Reader("training data", name, partial(lambda name: dataset()[name], name),
               mutated, training_data, FEW // 2)
        for name, mutated in (
            ("dataset.json", hostile_json), (SHARD, damaged)
        )
    ),
)  # fmt: skip
