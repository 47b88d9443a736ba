"""Hostile files: an answer within a second, in one line, bounded memory, nothing run and nothing written elsewhere."""

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import scipy.stats  # noqa: F401  # tables import it late; here nobody shall wait for it

from cvqmpt_lab.dry_run import dry_run
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import PROVENANCE_FILE
from cvqmpt_lab.results.row import RUNS_FILE, read_rows
from cvqmpt_lab.robot.loading import load_robot
from cvqmpt_lab.scene.cloud_files import WRITERS, read_cloud
from cvqmpt_lab.scene.mesh_files import KINDS, read_mesh, read_triangles
from cvqmpt_lab.sensing.camera_files import Pinhole, read_extrinsics, read_intrinsics
from cvqmpt_lab.sensing.depth import read_depth
from cvqmpt_lab.tasks.task import Task
from cvqmpt_lab.trajectory.reading import read_motion
from cvqmpt_lab.vqmpt.weights import read_model
from cvqmpt_lab.warm_up import compile_kernels
from experiments.trust import good_files
from experiments.trust.check import Check, Trial
from experiments.trust.contained import Hostile, attacked
from experiments.trust.mutation import Rng, damaged, hostile_json, hostile_xml
from experiments.trust.random_robots import TOOL, random_urdf

FEW = Budget(iterations=20)
CAMERA = Pinhole(12, 9, 10.0, 10.0, 5.5, 4.0)


def _planned(path: Path) -> None:
    problem = PlanningProblem.load(path)
    solve(problem, "birrt", FEW, seed=0)


def _dry_run(path: Path) -> None:
    problem = PlanningProblem.from_dict(json.loads(good_files.problem()))
    dry_run(problem, read_motion(path))


def _moved(path: Path) -> None:
    robot = load_robot(path, TOOL)
    robot.poses(robot.random_configurations(np.random.default_rng(0), 3))


def _rendered(path: Path) -> None:
    from paper_tables.render import render_directory

    for name, content in good_files.results().items():
        if name != path.name:
            (path.parent / name).write_bytes(content)
    render_directory(path.parent)


def _weights(path: Path) -> None:
    for name, content in good_files.weights(path).items():
        (path.parent / name).write_bytes(content)
    read_model(path.parent)


def _tensors(path: Path) -> None:
    from cvqmpt_lab.vqmpt.import_published import read_tensors

    read_tensors(path)


def _dataset(path: Path) -> None:
    from cvqmpt_lab.training.dataset import open_dataset

    folder = path.parent.parent if path.suffix == ".npz" else path.parent
    for name, content in good_files.dataset().items():
        if folder / name != path:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)
    open_dataset(folder, verify=False)


def _random_cloud(suffix: str) -> bytes:
    return WRITERS[suffix](np.random.default_rng(0).uniform(-1, 1, (50, 3)).astype("<f4"))


def _bytes_of(make: Callable[[], bytes], rng: Rng) -> bytes:
    return damaged(make(), rng)


def _json_of(make: Callable[[], bytes], rng: Rng) -> bytes:
    return hostile_json(make(), rng)


def _urdf(rng: Rng) -> bytes:
    return hostile_xml(random_urdf(rng).encode(), rng)


def _mix(make: Callable[[], bytes], rng: Rng) -> bytes:
    """Damaged bytes, or bytes that mean harm as a whole."""
    if rng.random() < 0.1:
        return good_files.MALICE[rng.integers(len(good_files.MALICE))]
    return damaged(make(), rng)


HOSTILE: Mapping[str, tuple[Hostile, ...]] = {
    "problems": (Hostile("problem.json", partial(_json_of, good_files.problem), _planned),),
    "paths and trajectories": tuple(
        Hostile(f"motion{ending}", partial(how, partial(good_files.motion, ending)), _dry_run)
        for ending, how in ((".csv", _bytes_of), (".json", _json_of))
    ),
    "tasks": (Hostile("task.json", partial(_json_of, good_files.task), Task.load),),
    "robots": (Hostile("arm.urdf", _urdf, _moved),),
    "clouds": tuple(
        Hostile(f"cloud{suffix}", partial(_bytes_of, partial(_random_cloud, suffix)), read_cloud)
        for suffix in WRITERS
    ),
    "meshes": tuple(
        Hostile(f"mesh{suffix}", partial(_bytes_of, partial(good_files.mesh, kind)), read_triangles)
        for suffix, kind in KINDS.items()
    ),
    "meshes, cut into convex pieces": (
        Hostile("mesh.obj", partial(_bytes_of, partial(good_files.mesh, "obj")), read_mesh, seconds=5.0),
    ),
    "depth images and cameras": (
        Hostile("depth.png", partial(_bytes_of, good_files.depth), lambda path: read_depth(path, CAMERA)),
        Hostile("lens.json", partial(_json_of, good_files.lens), read_intrinsics),
        Hostile("place.json", partial(_json_of, good_files.place), read_extrinsics),
    ),
    "rows and provenance": (
        Hostile(RUNS_FILE, partial(_bytes_of, good_files.rows), read_rows),
        Hostile(PROVENANCE_FILE, partial(_json_of, good_files.provenance_record), _rendered),
    ),
    "weights": (
        Hostile("config.json", partial(_json_of, good_files.config), _weights),
        Hostile("mpnet.safetensors", partial(_bytes_of, good_files.tensors), _weights),
    ),
    "checkpoints of others": (
        Hostile("best_model.pkl", partial(_mix, good_files.pickle_of_tensors), _tensors),
    ),
    "training data": (
        Hostile("dataset.json", partial(_json_of, good_files.dataset_description), _dataset),
        Hostile("shards.csv", partial(_bytes_of, good_files.dataset_index), _dataset),
        Hostile("shards/000000.npz", partial(_bytes_of, good_files.dataset_shard), _dataset),
    ),
}
"""By what they are."""

LONG: Mapping[str, int] = {
    "problems": 20_000,
    "tasks": 20_000,
    "paths and trajectories": 20_000,
    "robots": 20_000,
    "weights": 20_000,
    "training data": 20_000,
    "meshes, cut into convex pieces": 500,
}
"""Files of the long form, where reading one takes milliseconds; 100 000 of the others."""


def _attack(kinds: tuple[Hostile, ...], count: int) -> Trial:
    compile_kernels(lambda text: None)  # here, not in every process that is begun anew
    trials = [attacked(hostile, -(-count // len(kinds))) for hostile in kinds]
    return Trial(sum(trial.tried for trial in trials), [fault for trial in trials for fault in trial.faults])


CHECKS = tuple(
    Check(
        f"hostile {what}",
        "files",
        20 if "pieces" in what else 100,
        LONG.get(what, 100_000),
        partial(_attack, kinds),
    )
    for what, kinds in HOSTILE.items()
)
