"""Intrinsics and extrinsics in the formats of calibration tools, and errors of wrong files."""

import json

import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation

from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.sensing.camera_files import read_extrinsics, read_intrinsics

PLAIN = {"width": 640, "height": 480, "fx": 525.0, "fy": 526.0, "cx": 319.5, "cy": 239.5}
SIZE = {"width": 640, "height": 480}
K = [525.0, 0.0, 319.5, 0.0, 526.0, 239.5, 0.0, 0.0, 1.0]
BY_COLUMN = np.reshape(K, (3, 3)).T.ravel().tolist()
ROS = """
image_width: 640
image_height: 480
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [525, 0.0, 319.5, 0.0, 5.26e2, 239.5, 0, 0, 1.]
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0e-5, 0, 0]}
"""
INTRINSICS = {
    "plain.json": json.dumps(PLAIN),
    "tabs.json": json.dumps(PLAIN, indent="\t"),
    "plain.yaml": "\n".join(f"{key}: {value}" for key, value in PLAIN.items()),
    "ros.yaml": ROS,
    "message.yml": json.dumps({**SIZE, "K": K, "D": [0.0] * 5}),
    "nested.json": json.dumps({**SIZE, "K": np.reshape(K, (3, 3)).tolist()}),
    "open3d.json": json.dumps({**SIZE, "intrinsic_matrix": BY_COLUMN}),
}


@pytest.mark.parametrize("name", INTRINSICS)
def test_intrinsics_are_read_as_calibrations_write_them(name, tmp_path):
    (tmp_path / name).write_text(INTRINSICS[name])
    assert vars(read_intrinsics(tmp_path / name)).items() >= PLAIN.items()


BAD_INTRINSICS = {
    "missing": ({**PLAIN, "fx": None}, "fx is None"),
    "focal": ({**PLAIN, "fx": -525.0}, "fx is -525"),
    "principal": ({**PLAIN, "cx": 900.0}, r"principal point \(900, 239.5\) is outside"),
    "unknown": ({**PLAIN, "focal": 1.0}, "focal is unknown"),
    "list": ([1, 2], "must be an object"),
    "distorted": ({**SIZE, "K": K, "D": [0.1, 0, 0, 0]}, "the lens distorts"),
    "skewed": ({**SIZE, "K": [*K[:1], 3.0, *K[2:]]}, r"it must be \[\[fx, 0, cx\]"),
    "short": ({**SIZE, "K": K[:8]}, r"K has shape \(8,\)"),
    "words": ({**SIZE, "K": "none"}, "K"),
    "no size": ({"K": K}, "width is None"),
    "huge": ({**PLAIN, "width": 10**400}, "width"),
}


TURN = Rotation.from_euler("xyz", (-2.0, 0.1, 0.3))
T = np.eye(4)
T[:3, :3], T[:3, 3] = TURN.as_matrix(), (0.1, -0.5, 0.9)
XYZW = TURN.as_quat().tolist()
EXTRINSICS = {
    "matrix.json": json.dumps(T.tolist()),
    "named.yaml": json.dumps({"T_world_camera": T.tolist()}),
    "rounded.json": json.dumps(T.round(4).tolist()),
    "quaternion.json": json.dumps({"xyz": [0.1, -0.5, 0.9], "quaternion": XYZW}),
    "angles.yaml": "xyz: [0.1, -0.5, 9e-1]\nrpy: [-2.0, 0.1, 0.3]\n",
    "ros.yaml": f"translation: {{x: 0.1, y: -0.5, z: 0.9}}\nrotation: "
    f"{dict(zip('xyzw', XYZW, strict=True))}\n",
    "lists.json": json.dumps({"translation": [0.1, -0.5, 0.9], "rotation": XYZW}),
}


@pytest.mark.parametrize("name", EXTRINSICS)
def test_extrinsics_are_read_in_every_form_of_a_pose(name, tmp_path):
    (tmp_path / name).write_text(EXTRINSICS[name])
    found = read_extrinsics(tmp_path / name)
    np.testing.assert_allclose(found, T, atol=1e-4)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-9)


BAD_EXTRINSICS = {
    "no rotation": ((1.5 * T).tolist(), "last row"),
    "scaled": ((np.diag([1.1, 1.1, 1.1, 1.0]) @ T).tolist(), "not orthonormal"),
    "mirrored": ((T * [1, 1, -1, 1]).tolist(), "mirrored"),
    "three rows": (T[:3].tolist(), r"shape \(3, 4\)"),
    "long quaternion": ({"xyz": [0, 0, 0], "quaternion": [1, 1, 0, 0]}, "length 1.414; it must"),
    "no w": ({"translation": [0, 0, 0], "rotation": {"x": 0, "y": 0, "z": 1}}, "quaternion"),
    "words": ({"xyz": "here"}, "xyz"),
    "number": (3, "T_world_camera"),
}


BAD_YAML = {
    "aliases": ("a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n", "has an alias"),
    "tag": ("!!python/object/apply:os.system [echo]\n", "could not determine a constructor"),
    "twice": ("xyz: [0, 0, 0]\nxyz: [1, 0, 0]\n", "key 'xyz' occurs twice"),
    "deep": ("[" * 20_000, "recursion|end"),
    "long": ("# " + "x" * 70_000, "more than 65536 bytes"),
    "two documents": ("a: 1\n---\nb: 2\n", "single document"),
    "a list as key": ("? [1, 2]\n: 3\n", "unhashable|key"),
}


BAD = [(read_extrinsics, "bad.yaml", text, message) for text, message in BAD_YAML.values()]
for read, wrong in ((read_intrinsics, BAD_INTRINSICS), (read_extrinsics, BAD_EXTRINSICS)):
    BAD += [(read, "bad.json", json.dumps(data), message) for data, message in wrong.values()]


@pytest.mark.parametrize(
    ("read", "name", "text", "message"), BAD, ids=[*BAD_YAML, *BAD_INTRINSICS, *BAD_EXTRINSICS]
)
def test_bad_files_are_refused_by_field_in_one_line(read, name, text, message, tmp_path):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(CvqmptError, match=message) as caught:
        read(path)
    assert str(path) in str(caught.value) and str(caught.value).isprintable()
    assert len(str(caught.value)) < 400


def test_another_suffix_is_refused(tmp_path):
    refused(r"suffix '\.xml'", read_intrinsics, tmp_path / "cam.xml", error=CvqmptError)
