"""Files as they should be, from which hostile ones are made; each is made once."""

import hashlib
import io
import json
import pickle
import tempfile
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import PROVENANCE_FILE, provenance
from cvqmpt_lab.results.row import RUNS_FILE, ResultRow, RunKey, csv_text
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Sphere
from cvqmpt_lab.trajectory.export import save_trajectory
from cvqmpt_lab.trajectory.timing import time_path
from cvqmpt_lab.vqmpt.codebook import robot_signature
from experiments.suites.multi_sequence import multi_sequence_task
from experiments.suites.place_task import place_problem

CORNERS = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]])


def _panda() -> Robot:
    return robot_from_source({"name": "panda"})


@lru_cache(maxsize=1)
def problem() -> bytes:
    """A problem with every kind of shape, something carried, and regions of both forms."""
    given = place_problem(0)
    assert isinstance(given, PlanningProblem)
    cloud = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    shapes: tuple[Box | Cylinder | Sphere | ConvexMesh | PointCloud, ...] = (
        Box((0.1, 0.2, 0.3)),
        Cylinder(0.1, 0.2),
        Sphere(0.1),
        ConvexMesh(CORNERS),
        PointCloud(cloud, 0.01),
    )
    objects = (SceneObject(f"s{k}", shape, pose((2.0, k, 0.5))) for k, shape in enumerate(shapes))
    scene = Scene("room", tuple(objects))
    made = PlanningProblem(
        "good",
        given.robot,
        scene,
        given.start,
        constraint=given.constraint,
        goal_region=given.goal_region,
        attachments=(Attachment("can", Cylinder(0.03, 0.1), pose((0.0, 0.0, 0.1))),),
    )
    plain = made.to_dict()
    return json.dumps(plain | {"constraint": [{"upright": 0.1}, *plain["constraint"]]}).encode()


@lru_cache(maxsize=2)
def motion(ending: str) -> bytes:
    """A short trajectory of the Panda, as .csv or .json."""
    ends = np.array([[0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8], [0.1, -0.7, 0.0, -2.2, 0.0, 1.6, 0.8]])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"motion{ending}"
        save_trajectory(time_path(ends, _panda().joint_limits), path)
        return path.read_bytes()


@lru_cache(maxsize=1)
def task() -> bytes:
    """A task of several phases, in a scene with a door."""
    return json.dumps(multi_sequence_task(0).to_dict()).encode()


@lru_cache(maxsize=3)
def mesh(kind: str) -> bytes:
    """A ring."""
    import trimesh

    data = trimesh.creation.annulus(0.4, 0.5, 1.0, sections=8).export(file_type=kind)
    return data.encode() if isinstance(data, str) else data


@lru_cache(maxsize=1)
def depth() -> bytes:
    """A depth image (9, 12)."""
    from cvqmpt_lab.sensing.depth import write_depth

    with tempfile.TemporaryDirectory() as folder:
        write_depth(Path(folder) / "depth.png", np.arange(500, 608).reshape(9, 12) / 1000.0)
        return (Path(folder) / "depth.png").read_bytes()


def lens() -> bytes:
    """A camera as ROS writes it."""
    K = {"rows": 3, "cols": 3, "data": [10.0, 0.0, 5.5, 0.0, 10.0, 4.0, 0.0, 0.0, 1.0]}
    return json.dumps({"image_width": 12, "image_height": 9, "camera_matrix": K}).encode()


def place() -> bytes:
    """Where a camera stands."""
    at = {"translation": {"x": 1.0, "y": 0.0, "z": 0.5}, "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    return json.dumps({"T_world_camera": at}).encode()


@lru_cache(maxsize=1)
def rows() -> bytes:
    """Rows of a run."""
    made = [
        ResultRow(
            **RunKey("place-task", str(k), planner, 0, "compiled")._asdict(),
            solved=True,
            certified=True,
            t_total_s=0.1,
            path_length_rad=3.0,
            vertices=7,
        )
        for k in range(3)
        for planner in ("birrt", "cvq-mpt")
    ]
    return csv_text(made).encode()


@lru_cache(maxsize=1)
def provenance_record() -> bytes:
    """What a run says of its origin."""
    session = provenance(["cvqmpt", "reproduce"], [0], {"vq_mpt": "0" * 64}, 2)
    settings = {"suite": "place-task", "cutoff_s": 10.0, "iterations": 300, "backend": "compiled"}
    return json.dumps({**session, "configuration": settings, "continued": [session]}).encode()


def results() -> Mapping[str, bytes]:
    """A folder of results."""
    return {RUNS_FILE: rows(), PROVENANCE_FILE: provenance_record()}


@lru_cache(maxsize=1)
def _mpnet() -> tuple[bytes, bytes]:
    """The description and the tensors of a small MPNet."""
    import torch

    from cvqmpt_lab.vqmpt.checkpoint import MPNetCheckpoint, save_checkpoint
    from cvqmpt_lab.vqmpt.mpnet_network import MPNet, MPNetConfig

    sizes = MPNetConfig(n_points=20, encoder_widths=(8,), code_dim=4, planner_widths=(8, 6))
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "weights"
        save_checkpoint(folder, MPNetCheckpoint(robot_signature(_panda()), MPNet(sizes)))
        return (folder / "config.json").read_bytes(), (folder / "mpnet.safetensors").read_bytes()


def config() -> bytes:
    """The description of weights."""
    return _mpnet()[0]


def tensors() -> bytes:
    """Tensors of weights."""
    return _mpnet()[1]


def weights(hostile: Path) -> Mapping[str, bytes]:
    """What must lie beside one of the files of weights; a description tells the digest of the tensors there are."""
    if hostile.name == "config.json":
        return {"mpnet.safetensors": tensors()}
    description = json.loads(config())
    description["sha256"]["mpnet"] = hashlib.sha256(hostile.read_bytes()).hexdigest()
    return {"config.json": json.dumps(description).encode()}


@lru_cache(maxsize=1)
def pickle_of_tensors() -> bytes:
    """A checkpoint as torch writes it."""
    import torch

    stream = io.BytesIO()
    state = {f"layer.{k}": torch.arange(12.0).reshape(3, 4) for k in range(4)}
    torch.save({"encoder_state": state, "epoch": 3, "optimizer": {"lr": 0.1}}, stream)
    return stream.getvalue()


class _Runs:
    """Pickles to a call."""

    def __init__(self, call: Any, *arguments: Any) -> None:
        self._call = call, arguments

    def __reduce__(self) -> Any:
        return self._call


def _malice() -> tuple[bytes, ...]:
    import os
    import shutil

    calls = (
        _Runs(os.system, "touch /tmp/owned"),
        _Runs(eval, "__import__('os').system('id')"),
        _Runs(shutil.rmtree, "/nowhere"),
        _Runs(open, "/tmp/owned", "w"),
        _Runs(bytearray, 2**40),
    )
    return tuple(pickle.dumps({"state": call}, protocol=p) for call in calls for p in (2, 4))


MALICE = _malice()
"""Pickles that run something when they are read carelessly."""


@lru_cache(maxsize=1)
def dataset() -> Mapping[str, bytes]:
    """The files of a small folder of training data."""
    from cvqmpt_lab.planning.near_shortest import NearShortestSettings
    from experiments.labels.training_data import Recipe, generate

    labels = NearShortestSettings(restarts=1, first=200, later=50, finish=16)
    with tempfile.TemporaryDirectory() as parent:
        generate(Recipe(2, 2, ("table",), labels=labels), Path(parent), 1, ["test"], lambda done, total: None)
        return {
            name: (Path(parent) / name).read_bytes()
            for name in ("dataset.json", "shards.csv", "shards/000000.npz")
        }


def dataset_description() -> bytes:
    """Its description."""
    return dataset()["dataset.json"]


def dataset_index() -> bytes:
    """Its index."""
    return dataset()["shards.csv"]


def dataset_shard() -> bytes:
    """Its only shard."""
    return dataset()["shards/000000.npz"]
