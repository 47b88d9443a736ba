"""Files of virtual cameras are those that labs have: what is read back is what was seen."""

import numpy as np

from cvqmpt_lab.cameras.camera import KINECT, DepthCamera
from cvqmpt_lab.cameras.view import view_of
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.cameras import solids_of
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.sensing.captures import read_capture
from cvqmpt_lab.sensing.virtual import write_view


def test_a_written_view_is_read_back_to_half_a_millimetre(tmp_path):
    box = SceneObject("box", Box((0.6, 0.8, 0.4)), pose((0.3, -0.1, 0.2), 0.4))
    view = view_of(solids_of([box]), DepthCamera((-0.9, 0.7, 1.1), (0.2, 0.0, 0.3)), KINECT)
    files = write_view(view, tmp_path, "front")
    assert {path.name for path in files} == {path.name for path in tmp_path.iterdir()}
    capture = read_capture(*files)
    T = capture.T_world_camera
    points = capture.points @ T[:3, :3].T + T[:3, 3]
    assert len(points) == len(view.points) and capture.unseen == KINECT.width * KINECT.height - len(points)
    assert np.linalg.norm(points - view.points, axis=1).max() < 0.0005 * 1.3  # rays lean from the axis
