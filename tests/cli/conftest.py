"""A problem file that may be spoiled; a scan of a table with an arm."""

import json

import numpy as np
import pytest
from command_line import SCAN_START

from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.cloud_files import write_cloud
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.sensing.camera import Camera, Intrinsics, look_at
from cvqmpt_lab.sensing.depth import write_view
from cvqmpt_lab.sensing.render import view_of
from cvqmpt_lab.sensing.virtual import arm_objects, solids_of

LENS = Intrinsics.from_fov(width=160, height=120, vertical_fov=60.0, near=0.2)
CAMERA = Camera(LENS, look_at((-0.4, 0.3, 1.2), (0.6, 0.0, 0.0)))


@pytest.fixture(scope="session")
def problem_data(problem):
    """The json form of a place problem with one goal."""
    return problem.changed(goals=problem.goals[:1]).to_dict()


@pytest.fixture
def data(problem_data):
    return json.loads(json.dumps(problem_data))


@pytest.fixture
def problem_file(tmp_path, data):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(data))
    return path


@pytest.fixture(scope="session")
def scan_folder(tmp_path_factory, panda):
    """A depth image of table, post and arm at the start, with its camera; the same as a cloud."""
    folder = tmp_path_factory.mktemp("scan")
    objects = (
        SceneObject("table", Box((0.8, 1.4, 0.04)), pose((0.7, 0.0, -0.02))),
        SceneObject("post", Box((0.08, 0.08, 0.5)), pose((0.62, 0.0, 0.25))),
    )
    arm = arm_objects(panda, np.fromstring(SCAN_START, sep=","))
    view = view_of(solids_of((*objects, *arm)), CAMERA)
    write_view(view, folder, "depth")
    T = CAMERA.T_world_camera
    write_cloud(folder / "cloud.ply", (view.points - T[:3, 3]) @ T[:3, :3])
    return folder
