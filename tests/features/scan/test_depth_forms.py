"""Depth buffers of renderers are asked about; depth in metres is read, also of near scenes."""

import json

import numpy as np
import pytest
from command_line import refused as command_refused
from command_line import run_here
from refusals import refused

from cvqmpt_lab.features.scan.depth import read_capture, read_depth, write_depth
from cvqmpt_lab.sensing.camera import Intrinsics

LENS = Intrinsics(160, 120, 110.0, 110.0, 80.0, 60.0)
POSE = {"xyz": [0.5, 0.0, 1.2], "rpy": [np.pi, 0.0, 0.0]}


def depth_of(height, down):
    """Depth [m] of a floor with a block, which a camera at a height [m] sees at an angle [deg]."""
    x, y = LENS.axes()
    x, y = np.meshgrid(x, y)
    falling = y * np.cos(np.radians(down)) + np.sin(np.radians(down))
    depth = np.where(falling > 0.0, height / np.maximum(falling, 1e-9), np.inf)
    block = (np.abs(x) < 0.15) & (np.abs(y) < 0.1)
    return np.where(block, 0.8 * depth, depth)


def buffer_of(depth, near, far):
    """The buffer of OpenGL for a depth [m]: 1 at the far plane."""
    inside = np.minimum(depth, far)
    return (far * (inside - near) / (inside * (far - near))).astype("f4")


@pytest.fixture
def saved(tmp_path):
    def save(image):
        np.save(tmp_path / "a.npy", image)
        return tmp_path / "a.npy"

    return save


@pytest.mark.parametrize(
    ("near", "far", "height", "down"),
    [(0.01, 10.0, 1.2, 90), (0.1, 3.1, 1.2, 90), (0.01, 1000.0, 0.4, 90)]
    + [(0.05, 5.0, 0.6, 35), (0.2, 3.0, 0.7, 50), (0.1, 100.0, 0.5, 65), (0.1, 3.0, 0.6, 15)],
)
def test_a_depth_buffer_is_no_depth_in_metres(saved, near, far, height, down):
    """It was read as metres: a floor at a height of 0.2 m, without a word."""
    depth = depth_of(height, down)
    path = saved(buffer_of(depth, near, far))
    told = refused("z = near\\*far/", read_depth, path, LENS)
    assert str(path) in told and "give --scale 1" in told
    np.testing.assert_array_equal(read_depth(path, LENS, 1.0), np.load(path))
    d = np.load(path).astype(float)
    found = read_depth(saved(near * far / (far - d * (far - near))), LENS)
    np.testing.assert_allclose(found, np.minimum(depth, far), rtol=2e-3)


@pytest.mark.parametrize("form", ["exact", "noise", "millimetres", "half"])
@pytest.mark.parametrize(("height", "down"), [(0.3, 90), (0.55, 90), (0.4, 35), (0.6, 60)])
def test_depth_in_metres_of_a_near_scene_is_read(saved, form, height, down):
    """Its values are from 0 to 1, too; what is farther than 1 m was cut."""
    depth = depth_of(height, down)
    depth[depth > 1.0] = np.nan
    if form == "noise":
        depth += np.random.default_rng(0).normal(0.0, 1e-3, depth.shape)
    depth = depth.round(3) if form == "millimetres" else depth
    image = depth.astype("f2" if form == "half" else "f4")
    np.testing.assert_array_equal(read_depth(saved(image), LENS), image.astype(float))


@pytest.mark.parametrize("form", ["noise", "millimetres"])
def test_depth_of_a_camera_at_one_metre_is_read(saved, form):
    depth = depth_of(1.0, 90)
    depth += np.random.default_rng(0).normal(0.0, 1e-3, depth.shape)
    depth[depth > 1.0] = 1.0 if form == "millimetres" else np.nan
    image = (depth.round(3) if form == "millimetres" else depth).astype("f4")
    np.testing.assert_array_equal(read_depth(saved(image), LENS), image.astype(float))


@pytest.fixture
def camera(tmp_path):
    (tmp_path / "lens.json").write_text(json.dumps(vars(LENS)))
    (tmp_path / "pose.json").write_text(json.dumps(POSE))
    return ["--intrinsics", tmp_path / "lens.json", "--extrinsics", tmp_path / "pose.json"]


def test_a_scan_in_units_of_a_tenth_of_a_millimetre_names_the_scale(
    tmp_path, camera, capsys, caplog
):
    write_depth(tmp_path / "a.png", depth_of(1.2, 90), 0.0001)
    words = ["scan", tmp_path / "a.png", *camera]
    told = command_refused(capsys, *words)
    assert "nothing of the scan is left after outliers" in told
    assert "a.png is 12 m deep if its units are 1 mm; else give --scale 0.0001 (units of" in told
    assert "--scale 0.0001" not in caplog.text
    run_here([*words, "--neighbours", 0, "--voxel", 0.1])
    assert "else give --scale 0.0001" in caplog.text, "no point in the arm's reach"
    caplog.clear()
    run_here([*words, "--scale", 0.0001])
    assert not caplog.text


def test_a_depth_buffer_or_finer_unit_in_16_bits_does_not_name_millimetres(tmp_path, camera):
    """The cure was --scale 0.001, which such images have by default."""
    write_depth(tmp_path / "a.png", buffer_of(depth_of(1.2, 90), 0.01, 10.0), 1.0 / 60_000)
    lens, pose = camera[1::2]
    told = refused(
        "m deep if its units are 1 mm; give --scale", read_capture, tmp_path / "a.png", lens, pose
    )
    assert "a.png is 59.6 m deep" in told and "buffer, convert it" in told


@pytest.mark.parametrize("form", ["reversed buffer", "metres as whole numbers"])
def test_depth_that_no_camera_measures_is_asked_about(tmp_path, camera, form):
    """It was read as planes 1 to 12 mm in front of the camera."""
    depth = depth_of(1.2, 90)
    near, far = 0.01, 10.0
    reversed_buffer = (near * (far - depth) / (depth * (far - near))).astype("f4")
    np.save(
        tmp_path / "a.npy", reversed_buffer if form == "reversed buffer" else depth.astype("u2")
    )
    lens, pose = camera[1::2]
    given = tmp_path / "a.npy", lens, pose
    refused("which no depth camera measures; give --scale", read_capture, *given)
    assert len(read_capture(*given, scale=1.0).points)
