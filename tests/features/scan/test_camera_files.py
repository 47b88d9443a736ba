"""Intrinsics and extrinsics in the formats of calibration tools, and errors of wrong files."""

import json

import numpy as np
import pytest
from refusals import refused, table
from scipy.spatial.transform import Rotation

from cvqmpt_lab.features.scan.depth import read_extrinsics, read_intrinsics

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
OPENCV = """%YAML:1.0
---
calibration_time: "Tue Mar  3 10:00:00 2026"
image_width: 640
image_height: 480
flags: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.2500000000000000e+02, 0., 319.5, 0., 526., 239.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0., 0., 0., 0., 0. ]
avg_reprojection_error: 2.1e-01
"""
INTRINSICS = {
    "opencv.yml": OPENCV,
    "plain.json": json.dumps(PLAIN),
    "tabs.json": json.dumps(PLAIN, indent="\t"),
    "plain.yaml": "\n".join(f"{key}: {value}" for key, value in PLAIN.items()),
    "ros.yaml": ROS,
    "message.yml": json.dumps({**SIZE, "K": K, "D": [0.0] * 5}),
    "nested.json": json.dumps({**SIZE, "K": np.reshape(K, (3, 3)).tolist()}),
    "open3d.json": json.dumps({**SIZE, "intrinsic_matrix": BY_COLUMN}),
}


@pytest.mark.parametrize("name", INTRINSICS)
def test_intrinsics_are_read_in_the_formats_of_calibration_tools(name, tmp_path):
    (tmp_path / name).write_text(INTRINSICS[name])
    assert vars(read_intrinsics(tmp_path / name)).items() >= PLAIN.items()


def test_region_of_interest_and_binning_of_a_camera_info_are_applied(tmp_path):
    """Twice the pixels, and 100 by 50 pixels more around the image of `PLAIN`."""
    sensor = [1050.0, 0.0, 739.5, 0.0, 1052.0, 529.5, 0.0, 0.0, 1.0]
    region = {"x_offset": 100, "y_offset": 50, "width": 1280, "height": 960, "do_rectify": False}
    whole = {"width": 1480, "height": 1060, "k": sensor, "roi": region}
    path = tmp_path / "info.yaml"
    path.write_text(json.dumps({**whole, "binning_x": 2, "binning_y": 2}) + "\n---\n")
    assert vars(read_intrinsics(path)).items() >= PLAIN.items()
    path.write_text(json.dumps(whole))
    found = read_intrinsics(path)
    assert (found.width, found.height, found.fx, found.cx, found.cy) == (
        1280,
        960,
        1050,
        639.5,
        479.5,
    )
    path.write_text(json.dumps({**whole, "roi": {**region, "x_offset": 900, "width": 64}}))
    refused(r"with its roi and binning: .*principal point \(-160.5", read_intrinsics, path)
    path.write_text(json.dumps({**whole, "roi": {"x_offset": 100}}))
    refused("roi.x_offset is 100, but roi.width is 0; give both", read_intrinsics, path)


P = [525.0, 0.0, 319.5, 0.0, 0.0, 526.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"dist": [0.1, 0.2]}, "unknown key of intrinsics with K 'dist'; valid choices: width"),
        ({"fisheye_model": 1}, "it is a fisheye lens"),
        ({"fx": 500.0}, "unknown key of intrinsics with K 'fx'"),
        ({"depth_scale": 0.0001}, "depth_scale is 0.0001, which is not read: remove it, .*--scale"),
        ({"P": [400.0, *P[1:]]}, r"P is \[\[400.0, .*, but K is \[\[525.0, .* leave P out"),
    ],
)
def test_fields_that_would_be_left_out_are_refused(field, message, tmp_path):
    """They were left out without a word, and points were elsewhere."""
    path = tmp_path / "lens.json"
    path.write_text(json.dumps({**SIZE, "K": K, **field}))
    refused(message, read_intrinsics, path)


@pytest.mark.parametrize("field", [{"P": P}, {"P": [0.0] * 12}, {"depth_scale": 1000.0}])
def test_fields_that_change_nothing_are_no_error(field, tmp_path):
    (tmp_path / "lens.json").write_text(json.dumps({**SIZE, "K": K, "R": [0.0] * 9, **field}))
    assert vars(read_intrinsics(tmp_path / "lens.json")).items() >= PLAIN.items()


TURN = Rotation.from_euler("xyz", (-2.0, 0.1, 0.3))
T = np.eye(4)
T[:3, :3], T[:3, 3] = TURN.as_matrix(), (0.1, -0.5, 0.9)
XYZW = TURN.as_quat().tolist()
ROTATION = dict(zip("xyzw", XYZW, strict=True))
EXTRINSICS = {
    "opencv.yml": "%YAML:1.0\nT_world_camera: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n"
    f"   data: {T.ravel().tolist()}\n",
    "matrix.json": json.dumps(T.tolist()),
    "named.yaml": json.dumps({"T_world_camera": T.tolist()}),
    "rounded.json": json.dumps(T.round(4).tolist()),
    "quaternion.json": json.dumps({"xyz": [0.1, -0.5, 0.9], "quaternion": XYZW}),
    "angles.yaml": "xyz: [0.1, -0.5, 9e-1]\nrpy: [-2.0, 0.1, 0.3]\n",
    "ros.yaml": f"translation: {{x: 0.1, y: -0.5, z: 0.9}}\nrotation: {ROTATION}\n",
    "echo.yaml": f"translation: {{x: 0.1, y: -0.5, z: 0.9}}\nrotation: {ROTATION}\n---\n",
    "pose.yaml": json.dumps(
        {"position": dict(zip("xyz", T[:3, 3], strict=True)), "orientation": ROTATION}
    ),
    "stamped.yaml": json.dumps(
        {
            "header": {"frame_id": "base"},
            "child_frame_id": "camera",
            "transform": {"translation": {"x": 0.1, "y": -0.5, "z": 0.9}, "rotation": ROTATION},
        }
    ),
    "pose_stamped.yaml": json.dumps(
        {"header": {}, "pose": {"position": [0.1, -0.5, 0.9], "orientation": ROTATION}}
    ),
    "hand_eye.yaml": json.dumps(
        {
            "parameters": {"eye_on_hand": False},
            "transformation": {
                "x": 0.1,
                "y": -0.5,
                "z": 0.9,
                **{f"q{k}": ROTATION[k] for k in "xyzw"},
            },
        }
    ),
    "lists.json": json.dumps({"translation": [0.1, -0.5, 0.9], "rotation": XYZW}),
}


@pytest.mark.parametrize("name", EXTRINSICS)
def test_extrinsics_are_read_in_every_form_of_a_pose(name, tmp_path):
    (tmp_path / name).write_text(EXTRINSICS[name])
    found = read_extrinsics(tmp_path / name)
    np.testing.assert_allclose(found, T, atol=1e-4)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-9)


def test_a_camera_beyond_100_m_is_refused_or_is_in_the_unit_of_the_points(tmp_path, caplog):
    """Camera and points of some cameras are in millimetres; only the points were scaled."""
    path = tmp_path / "hand_eye.yaml"
    path.write_text("xyz: [450, 0, 1500]\nrpy: [-2.0, 0.1, 0.3]\n")
    refused("its camera is 1500 m away, more than 100: not in metres", read_extrinsics, path)
    assert not caplog.text
    found = read_extrinsics(path, 0.001)
    np.testing.assert_allclose(found[:3, 3], (0.45, 0.0, 1.5))
    np.testing.assert_allclose(found[:3, :3], T[:3, :3], atol=1e-9)
    assert caplog.text.count("taken in the unit of the scale, 0.001 m: 1.5 m away") == 1
    path.write_text("xyz: [0.45, 0, 1.5]\n")
    np.testing.assert_allclose(read_extrinsics(path, 0.001)[:3, 3], (0.45, 0.0, 1.5))
    path.write_text("xyz: [450000, 0, 1500]\n")
    refused("more than 100", read_extrinsics, path, 0.001)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rpy": [3.14, 0.0, 0.0]}, "unknown key of the pose 'rpy'; valid choices: tra"),
        ({"rotation": ROTATION, "unit": "mm"}, "unknown key of the pose 'unit'"),
        ({"rotation": {"roll": 3.14}}, "unknown key of a vector or quaternion 'roll'"),
        ({}, "it has 'translation' without 'rotation'; give the quaternion"),
    ],
)
def test_a_rotation_that_is_not_read_is_refused(change, message, tmp_path):
    """The camera was read as one that is not rotated, so that all points were elsewhere."""
    path = tmp_path / "pose.json"
    path.write_text(json.dumps({"translation": [0.1, -0.5, 0.9], **change}))
    refused(message, read_extrinsics, path)


@pytest.mark.parametrize("row", table("wrong_cameras"), ids=lambda row: row["pattern"])
def test_bad_files_are_refused_by_field_in_one_line(row, tmp_path):
    read = {"intrinsics": read_intrinsics, "extrinsics": read_extrinsics}[row["kind"]]
    (tmp_path / row["name"]).write_text(row["text"])
    line = refused(row["pattern"], read, tmp_path / row["name"])
    assert str(tmp_path / row["name"]) in line and len(line) < 400


@pytest.mark.parametrize(
    ("text", "message"),
    [("[" * 20_000, "nested too deeply|end"), ("# " + "x" * 70_000, "more than 65536 bytes")],
)
def test_files_too_deep_or_too_long_are_refused(text, message, tmp_path):
    (tmp_path / "bad.yaml").write_text(text)
    refused(message, read_extrinsics, tmp_path / "bad.yaml")


def test_another_suffix_is_refused(tmp_path):
    refused(r"suffix '\.xml'", read_intrinsics, tmp_path / "cam.xml")


def test_angles_of_extrinsics_take_the_tag_of_their_unit(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text("xyz: [0.5, 0.0, 1.2]\nrpy: [!degrees 180, 0, 0]\n")
    np.testing.assert_allclose(read_extrinsics(path)[:3, :3], np.diag([1, -1, -1]), atol=1e-12)
    path.write_text("xyz: [0.5, 0.0, 1.2]\nrpy: [!grad 200, 0, 0]\n")
    refused("line 2, column 7: the tag !grad is not read", read_extrinsics, path)
