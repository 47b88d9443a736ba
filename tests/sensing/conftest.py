"""A table, a box and the arm, as a depth camera sees them: files that the tests write."""

from types import SimpleNamespace

import numpy as np
import pytest

from cvqmpt_lab.poses import pose
from cvqmpt_lab.robot.load import panda
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.sensing.camera import Camera, Intrinsics, look_at
from cvqmpt_lab.sensing.depth import write_view
from cvqmpt_lab.sensing.render import view_of
from cvqmpt_lab.sensing.virtual import arm_objects, solids_of

ARM_AT = np.array([0.0, -0.6, 0.0, -2.4, 0.0, 1.9, 0.8])
TABLE = SceneObject("table", Box((0.7, 1.2, 0.04)), pose((0.65, 0.0, -0.02)))
SCENE = Scene(
    "bench", (TABLE, SceneObject("crate", Box((0.12, 0.12, 0.2)), pose((0.6, 0.3, 0.1), 0.4)))
)
LENS = Intrinsics.from_fov(width=200, height=160, vertical_fov=55.0, near=0.2)
CAMERA = Camera(LENS, look_at((-0.5, -0.6, 1.1), (0.6, 0.0, 0.1)))


@pytest.fixture
def files(tmp_path):
    """Depth image, intrinsics and extrinsics of one camera; the scene and the arm that it saw."""
    robot = panda()
    view = view_of(solids_of((*SCENE.objects, *arm_objects(robot, ARM_AT))), CAMERA)
    depth, intrinsics, extrinsics = write_view(view, tmp_path, "depth")
    files = {"depth": depth, "intrinsics": intrinsics, "extrinsics": extrinsics, "folder": tmp_path}
    return SimpleNamespace(**files, view=view, robot=robot, q=ARM_AT)
