"""Problems name clouds and meshes by paths relative to their folder."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from refusals import refused

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Articulation, Scene
from cvqmpt_lab.scene.scene_files import with_files_read
from cvqmpt_lab.scene.shapes import ConvexMesh, OccupancyMap, PointCloud

POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (30, 3))
FAR = np.array([[1.0, 0, 0, 0.5], [0, 1, 0, 0.9], [0, 0, 1, 0.2], [0, 0, 0, 1]]).tolist()


@pytest.fixture
def data(problem, tmp_path):
    """JSON of a problem that names files of a cloud, a ring of several pieces, a box and a map."""
    (tmp_path / "parts").mkdir()
    np.save(tmp_path / "parts" / "scan.npy", POINTS)
    trimesh.creation.annulus(40.0, 45.0, 100.0, sections=8).export(tmp_path / "parts" / "ring.stl")
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "parts" / "box.obj")
    plain = problem.to_dict()
    plain["scene"] = {
        "name": "mine",
        "objects": [
            item_of("scan", type="cloud_file", path="parts/scan.npy", radius=0.01),
            item_of("ring", type="mesh_file", path="parts/ring.stl", scale=0.001),
            item_of("crate", type="mesh_file", path="parts/box.obj"),
            item_of("room", type="map_file", path="parts/scan.npy", padding=0.01),
        ],
    }
    return plain


def item_of(name, **shape):
    return {"name": name, "shape": shape, "T_world_object": FAR}


def saved(data, tmp_path):
    (tmp_path / "problem.json").write_text(json.dumps(data))
    return tmp_path / "problem.json"


def test_files_become_objects(data, tmp_path):
    scene = PlanningProblem.load(saved(data, tmp_path)).scene
    assert scene["scan"].shape == PointCloud(POINTS, 0.01)
    cells = np.unique(np.floor(POINTS / 0.02), axis=0)
    assert scene["room"].shape == OccupancyMap(cells, padding=0.01)
    assert isinstance(scene["crate"].shape, ConvexMesh)
    ring = [item for item in scene if item.name.startswith("ring/")]
    assert len(ring) > 4 and all(isinstance(item.shape, ConvexMesh) for item in ring)
    assert all(np.array_equal(item.T_world_object, FAR) for item in ring)


def test_a_saved_problem_does_not_need_the_files(data, tmp_path):
    loaded = PlanningProblem.load(saved(data, tmp_path))
    loaded.save(tmp_path / "again.json")
    for path in (tmp_path / "parts").iterdir():
        path.unlink()
    assert PlanningProblem.load(tmp_path / "again.json").scene == loaded.scene


def test_a_joint_of_an_object_moves_all_its_pieces(data, tmp_path):
    joint = Articulation("lift", "slider", FAR, 0, 1, 0, ("ring", "crate"))
    data["scene"]["articulations"] = [to_plain(joint)]
    scene = PlanningProblem.load(saved(data, tmp_path)).scene
    pieces = tuple(name for name in scene.names if name.startswith("ring/"))
    assert scene.articulation("lift").moves == (*pieces, "crate")


def test_a_scene_may_be_a_file_and_its_paths_start_at_the_folder_of_that_file(data, tmp_path):
    whole = PlanningProblem.load(saved(data, tmp_path))
    shapes = data["scene"]["objects"]
    for item in shapes:
        item["shape"]["path"] = item["shape"]["path"].removeprefix("parts/")
    (tmp_path / "parts" / "scene.json").write_text(json.dumps(data["scene"]))
    named = data | {"scene": "parts/scene.json"}
    path = saved(named, tmp_path)
    assert PlanningProblem.load(path).scene == whole.scene
    refused(
        "scene is 'parts/scene.json', a file: load the object", PlanningProblem.from_dict, named
    )
    (tmp_path / "parts" / "scene.json").write_text("{}")
    refused(r"parts/scene.json: name is missing", PlanningProblem.load, path)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ({"type": "cloud_file", "path": "gone.pcd", "radius": 1}, "cannot read cloud .*gone.pcd"),
        ({"type": "cloud_file", "path": "parts/scan.npy"}, "radius is missing"),
        ({"type": "cloud_file", "path": "parts/scan.npy", "raduis": 1}, "did you mean 'radius'"),
        ({"type": "mesh_file", "path": "parts/ring.stl"}, "millimetres: 0.001"),
        ({"type": "mesh_file", "path": "parts/box.obj", "scale": -1}, "scale"),
    ],
)
def test_errors_name_the_problem_the_object_and_the_cure(data, tmp_path, shape, message):
    data["scene"]["objects"].append(item_of("bad", **shape))
    where = r"problem\.json: scene\.objects\[4\]\.shape: "
    refused(f"{where}.*{message}", PlanningProblem.load, saved(data, tmp_path))


def test_a_scene_that_is_not_read_from_a_file_cannot_name_files():
    scan = item_of("scan", type="cloud_file", path="a.npy", radius=0.01)
    refused("'cloud_file' names a file", from_plain, Scene, {"name": "s", "objects": [scan]})


def test_a_missing_file_of_a_shape_is_told_with_its_folder(tmp_path, monkeypatch):
    (tmp_path / "tool.stl").write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    tools = [{"shape": {"type": "mesh_file", "path": "tol.stl"}}]
    told = refused("cannot read mesh", with_files_read, {"attachments": tools}, Path())
    assert str(tmp_path) in told and "did you mean 'tool.stl'" in told
