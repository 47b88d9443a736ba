"""Depth images and clouds become points at the right place; wrong files are refused by name."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image
from refusals import refused

from cvqmpt_lab.features.scan import depth
from cvqmpt_lab.features.scan.depth import deprojected, read_capture, read_depth, write_depth
from cvqmpt_lab.sensing.camera import Intrinsics


def test_a_depth_image_or_an_array_in_metres_gives_the_points_that_the_camera_saw(files):
    seen, array = np.isfinite(files.view.depth), files.folder / "depth.npy"
    np.save(array, np.where(seen, files.view.depth, np.nan).astype("f4"))
    for file, rounded in ((files.depth, 6e-4), (array, 1e-5)):  # the image is in millimetres
        capture = read_capture(file, files.intrinsics, files.extrinsics)
        assert len(capture.points) == seen.sum() == seen.size - capture.dropped
        np.testing.assert_allclose(capture.in_world, files.view.points, atol=rounded)


def test_the_scale_is_the_length_of_a_unit(files):
    write_depth(files.depth, files.view.depth, 0.0002)
    capture = read_capture(files.depth, files.intrinsics, scale=0.0002)
    deepest = files.view.depth[np.isfinite(files.view.depth)].max()
    assert capture.points[:, 2].max() == pytest.approx(deepest, abs=0.0002)


@pytest.mark.parametrize("kind", [np.int16, np.int32, np.uint16])
def test_whole_numbers_are_millimetres(kind, tmp_path):
    """Signed ones were taken as metres."""
    np.save(tmp_path / "a.npy", np.full((2, 3), 7, dtype=kind))
    found = read_depth(tmp_path / "a.npy", Intrinsics(3, 2, 100.0, 120.0, 1.0, 0.5))
    np.testing.assert_allclose(found, 0.007)


@pytest.mark.parametrize("name", ["a.png", "a.npy"])
def test_the_largest_value_of_16_bits_is_no_depth(name, tmp_path):
    """It was a point 65.5 m away, whose ray freed unknown space."""
    image = np.array([[7, 65535, 65534], [0, 65535, 9]], dtype=np.uint16)
    if name == "a.png":
        Image.fromarray(image).save(tmp_path / name)
    else:
        np.save(tmp_path / name, image)
    found = read_depth(tmp_path / name, Intrinsics(3, 2, 100.0, 120.0, 1.0, 0.5))
    np.testing.assert_allclose(found, [[0.007, np.nan, 65.534], [np.nan, np.nan, 0.009]])
    # 32 bits count further
    np.save(tmp_path / "b.npy", image.astype(np.int32))
    found = read_depth(tmp_path / "b.npy", Intrinsics(3, 2, 100.0, 120.0, 1.0, 0.5))
    assert found[0, 1] == pytest.approx(65.535)


def test_pixels_without_depth_stay_holes_of_the_organised_cloud():
    camera = Intrinsics(3, 2, 100.0, 120.0, 1.0, 0.5)
    cloud = deprojected(np.array([[1.0, np.nan, 2.0], [1.0, 1.0, 1.0]]), camera)
    assert cloud.shape == (2, 3, 3) and np.isnan(cloud[0, 1]).all()
    np.testing.assert_allclose(cloud[0, 2], [2.0 * (2 - 1) / 100, 2.0 * (0 - 0.5) / 120, 2.0])


def lying_png(path):
    """Write a header of a billion pixels and a few bytes of data."""
    body = struct.pack(">IIBBBBB", 32000, 32000, 16, 0, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n")
    with path.open("ab") as file:
        for content in (b"IHDR" + body, b"IDAT" + zlib.compress(bytes(100)), b"IEND"):
            file.write(struct.pack(">I", len(content) - 4) + content)
            file.write(struct.pack(">I", zlib.crc32(content)))


def test_an_image_of_more_pixels_than_the_bound_is_refused(files, monkeypatch):
    monkeypatch.setattr(depth, "MAX_PIXELS", 1000)
    told = "it has 200 x 160 pixels, at most 1000 are read"
    refused(told, read_capture, files.depth, files.intrinsics)


def cut(path):
    """Write half of an image."""
    write_depth(path, np.random.default_rng(0).uniform(0.5, 2.0, (160, 200)))
    path.write_bytes(path.read_bytes()[:30_000])


def twice(path):
    """Write two images into one file."""
    write_depth(path, np.ones((160, 200)))
    path.write_bytes(2 * path.read_bytes())


def picture(mode, size=(200, 160)):
    return lambda path: Image.new(mode, size).save(path, format="PNG")


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (picture("RGB"), "mode RGB"),
        (picture("L"), "mode L"),
        (picture("I;16", (100, 80)), "100 x 80 pixels"),
        (lying_png, "32000 x 32000 pixels|exceeds limit"),
        (cut, "truncated"),
        (twice, "continues after its image"),
        (lambda path: path.write_text("<!DOCTYPE html>"), "cannot identify"),
        (lambda path: write_depth(path, np.zeros((160, 200)), 0.001), "has no depth: every pixel"),
    ],
)
def test_a_file_that_is_not_a_depth_image_of_the_camera_is_refused(files, write, message):
    write(files.depth)
    assert str(files.depth) in refused(message, read_capture, files.depth, files.intrinsics)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"intrinsics": None}, "needs the intrinsics"),
        ({"scale": 1.0}, "m from the origin|more than 1000"),
        ({"scale": 1e-7}, "not in metres"),
    ],
)
def test_missing_intrinsics_and_impossible_units_are_named(files, options, message):
    refused(message, read_capture, files.depth, **{"intrinsics": files.intrinsics, **options})
