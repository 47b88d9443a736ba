"""Clouds are read as they were written; contradictory files are refused in one line."""

import os

import numpy as np
import pytest
from cloud_files import GOOD, POINTS, npy, pcd, ply, xyz
from refusals import refused

from cvqmpt_lab.scene.cloud_files import CLOUD_HEADERS, read_cloud, write_cloud


@pytest.mark.parametrize("name", GOOD)
def test_points_are_read_as_they_were_written(name, tmp_path):
    (tmp_path / name).write_bytes(GOOD[name])
    cloud = read_cloud(tmp_path / name)
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-12)
    assert cloud.dropped == 0


@pytest.mark.parametrize("write", [pcd, ply, npy, xyz])
def test_points_that_are_not_finite_are_counted(write, tmp_path):
    holes = POINTS.copy()
    holes[3, 1], holes[7, 2], holes[8] = np.nan, np.inf, -np.inf
    path = tmp_path / f"holes.{write.__name__}"
    path.write_bytes(write(holes))
    cloud = read_cloud(path)
    assert cloud.dropped == 3
    np.testing.assert_allclose(cloud.points, np.delete(POINTS, [3, 7, 8], axis=0))


@pytest.mark.parametrize("top", ["# x y z r", "// X Y Z R", "# points x, y, z [m] of a scan"])
def test_comments_that_name_no_other_columns_change_nothing(top, tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text(f"{top}\n" + "".join(f"{x!r} {y!r} {z!r} 7\n" for x, y, z in POINTS.tolist()))
    np.testing.assert_allclose(read_cloud(path).points, POINTS)


def test_a_scale_converts_a_cloud_to_metres(tmp_path):
    (tmp_path / "mm.npy").write_bytes(npy(1000.0 * POINTS))
    refused(r"half of it is more .* from .*millimetres: 0\.001", read_cloud, tmp_path / "mm.npy")
    np.testing.assert_allclose(read_cloud(tmp_path / "mm.npy", 0.001).points, POINTS)
    (tmp_path / "km.npy").write_bytes(npy(0.0005 * POINTS))
    refused(r"all of it is within 0\.\d+ mm: not in metres\?", read_cloud, tmp_path / "km.npy")


FAR = POINTS.copy()
FAR[5, 2] = -1e300
# the lengths of the lists add up to forty times the first one: 40 wrong points were once read
LISTS = ply(POINTS[:0], head="element vertex 40", tail="property list uchar uchar views\n")
LISTS += b"".join(
    b"s" + point.astype("<f4").tobytes() + bytes([length, *[9] * length])
    for point, length in zip(POINTS, [2, 3, 1] * 13 + [2], strict=True)
)
MANY, PACKED = 10**9, "binary_compressed"
BAD = {
    "many.pcd": (pcd(POINTS[:0], WIDTH=MANY, POINTS=MANY), "1000000000 points, the file holds 0"),
    "many_text.pcd": (pcd(POINTS[:0], "ascii", WIDTH=MANY, POINTS=MANY), "1000000000 points"),
    "many_packed.pcd": (pcd(POINTS, PACKED, WIDTH=MANY, POINTS=MANY), "1000000000 points of 16"),
    "cut.pcd": (pcd(POINTS)[:-600], "40 points, the file holds 2: cut short"),
    "cut_text.pcd": (pcd(POINTS, "ascii")[:-600], "40 points, the file holds|columns changed"),
    "counts_text.pcd": (pcd(POINTS, "ascii", COUNT="1 1 1 2"), "than 1; write it as binary"),
    "fewer_text.pcd": (pcd(POINTS, "ascii", WIDTH=3, POINTS=3), "says 3 points, the file holds 40"),
    "fewer_packed.pcd": (pcd(POINTS, PACKED, WIDTH=3, POINTS=3), "3 points of 16 bytes"),
    "more_packed.pcd": (pcd(POINTS, PACKED) + b"1", "the file holds more"),
    "page.pcd": (pcd(POINTS) + bytes(4096), "the file holds more"),
    "columns.pcd": (pcd(POINTS, "ascii", "x y z", SIZE="4 4 4", TYPE="F F F", COUNT=None), "4 num"),
    "cut_packed.pcd": (pcd(POINTS, PACKED)[:-30], "its compressed part"),
    "cut_header.pcd": (pcd(POINTS)[:60], "no line DATA"),
    "more.pcd": (pcd(POINTS, WIDTH=3, POINTS=3), "the file holds more"),
    "shape.pcd": (pcd(POINTS, WIDTH=7, HEIGHT=7), "7 x 7"),
    "negative.pcd": (pcd(POINTS, WIDTH=-40, POINTS=-40), "says -40 points"),
    "colour.pcd": (pcd(POINTS, fields="a b c rgb"), "no single column 'x'"),
    "twice.pcd": (pcd(POINTS, fields="x x y z"), "no single column 'x'"),
    "type.pcd": (pcd(POINTS, TYPE="F F F Q"), "TYPE.*q4"),
    "count.pcd": (pcd(POINTS, COUNT="1 1 1 1000000000"), "COUNT of its header"),
    "lengths.pcd": (pcd(POINTS, SIZE="4 4 4"), "differ in length"),
    "form.pcd": (pcd(POINTS, "zip"), "DATA is 'zip'"),
    "no_points.pcd": (pcd(POINTS, POINTS=None), "no POINTS"),
    "nothing.pcd": (pcd(POINTS[:0]), "none of its 0 points"),
    "many.ply": (ply(POINTS, head="element vertex 1000000000"), "cannot be read .*cut short"),
    "many_text.ply": (ply(POINTS, "ascii", head=f"element vertex {MANY}"), "the file holds 40"),
    "fewer.ply": (ply(POINTS, head="element vertex 3"), "cannot be read"),
    "fewer_text.ply": (ply(POINTS, "ascii", "element vertex 3"), "3 vertex, .* holds 40 lines"),
    "faces.ply": (ply(POINTS, "ascii", tail="element face 2\n"), "2 face, .* holds 40 lines"),
    "twice.ply": (ply(POINTS, "ascii", tail="element vertex 2\n"), "binary vertices"),
    "list_text.ply": (
        ply(POINTS, "ascii", kind="list uchar float"),
        "'x' of its element 'vertex' is a l",
    ),
    "commas.ply": (ply(POINTS, "ascii").replace(b"0.", b"0,"), "could not convert"),
    "wide.ply": (ply(POINTS, "ascii").replace(b"\n7 ", b"\n7 8 "), "5 numbers a line"),
    "cut.ply": (ply(POINTS)[:-20], "cannot be read .*cut short"),
    "list.ply": (ply(POINTS, kind="list uchar float"), "no plain numbers"),
    "views.ply": (LISTS, "property 'views' of its element 'vertex' is a list"),
    "names.xyz": (b"a b c\n1 2 3\n", "no single column 'x'; columns: a, b, c"),
    "count.xyz": (b"3\n1 2 3\n4 5 6\n", "says 3 points, the file holds 2; remove that line"),
    "property.ply": (ply(POINTS, kind="quaternion"), "'quaternion'.*no plain numbers"),
    "face.ply": (ply(POINTS, head="element face 3"), "binary vertices"),
    "format.ply": (ply(POINTS).replace(b"little", b"middle"), "header of ascii or binary"),
    "page.ply": (b"<!DOCTYPE html>", "begin with a PLY header"),
    "huge.npy": (npy(POINTS).replace(b"(40, 3)", b"(99999999, 3)")[:200], "another size|header"),
    "pickle.npy": (npy(np.array([{"a": 1}], dtype=object)), "Python objects"),
    "turned.npy": (npy(POINTS.T), r"\(3, 40\) .* \(m, 3\): transposed\?"),
    "flat.npy": (npy(np.zeros(30)), "numbers of shape"),
    "words.npy": (npy(np.array([["a", "b", "c"]])), "numbers of shape"),
    "page.npy": (b"<!DOCTYPE html>", "magic"),
    "nan.npy": (npy(np.full((4, 3), np.nan)), "none of its 4 points"),
    "far.npy": (npy(FAR), "point 5 is"),
    # the first three columns were read
    "time.xyz": (b"# t x y z\n0.1 1 2 3\n0.2 1 2 3.5\n", "'# t x y z' names columns .* without #"),
    "turned.csv": (b"// z,y,x\n0.1,1,2\n0.2,1,2\n", "names columns of which x, y, z are not the"),
    "colmap.txt": (
        b"# points\n# POINT3D_ID, X, Y, Z, R, G, B, TRACK[]\n1 1 2 3 0 0 0 7 8 9 9\n",
        "'# POINT3D_ID, X, Y, Z, R, G, B, TRACK..' names columns",
    ),
    "two.xyz": (b"1 2\n3 4\n", "invalid column index"),
    "commas.xyz": (b"0,1 0,2 0,3\n", "'1 0'.*write decimal points"),
    "semicolons.csv": (b"0,1;0,2;0,3\n", "'0,1'.*write decimal points"),
    "some_commas.xyz": (b"0.1 0.2 0.3\n0.1 0.2 0,3\n", "'0,3'.*write decimal points"),
    "gap.csv": (b"0.1,,0.2,0.3\n", "''.*write decimal points"),
    "words.xyz": (b"1 2 three\n", "three"),
    "empty.xyz": (b"# nothing\n", "none of its 0 points"),
    "binary.xyz": (bytes(range(128, 256)), "utf-8"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_by_name_in_one_line(name, tmp_path):
    data, message = BAD[name]
    (tmp_path / name).write_bytes(data)
    said = refused(message, read_cloud, tmp_path / name)
    assert name in said and len(said) < 400


def test_a_pose_of_the_sensor_in_a_pcd_file_is_read_only_with_extrinsics(tmp_path):
    """The points were read as if the sensor stood at the origin."""
    for number, form in enumerate(("ascii", "binary", "binary_compressed")):
        path = tmp_path / f"{number}.pcd"
        path.write_bytes(pcd(POINTS, form, VIEWPOINT="0.4 0 1.5 0.6 0 0.8 0"))
        told = r"a sensor, xyz \[0.4, 0.0, 1.5\], quaternion .* \[0.0, 0.8, 0.0, 0.6\]: .*--extr"
        refused(told, read_cloud, path)
        np.testing.assert_allclose(read_cloud(path, posed=True).points, POINTS)
        path.write_bytes(pcd(POINTS, form, VIEWPOINT="0 0 0 1 0 0 0"))
        np.testing.assert_allclose(read_cloud(path).points, POINTS)
    path.write_bytes(pcd(POINTS, VIEWPOINT="0 0 1 1 0 0 zero"))
    refused("could not convert string", read_cloud, path)
    path.write_bytes(pcd(POINTS, VIEWPOINT="0 0 0"))
    refused("its VIEWPOINT has 3 numbers; it has seven", read_cloud, path)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_a_pose_of_the_sensor_in_a_ply_file_is_read_only_with_extrinsics(form, tmp_path):
    """PCL writes it; the points were read as if the sensor stood at the origin."""
    names = [f"view_p{k}" for k in "xyz"] + [f"{axis}_axis{k}" for axis in "xyz" for k in "xyz"]
    tail = "element camera 1\n" + "".join(f"property float {name}\n" for name in names)
    path = tmp_path / "a.ply"

    def write(position, axes):
        numbers = [*position, *np.ravel(axes)]
        order = ">f4" if form == "binary_big_endian" else "<f4"
        line = "\n" + " ".join(map(str, numbers)) + "\n"
        row = line.encode() if form == "ascii" else np.array(numbers, order).tobytes()
        path.write_bytes(ply(POINTS, form, tail=tail) + row)

    write((0, 0, 0), np.eye(3))
    np.testing.assert_allclose(read_cloud(path).points, POINTS)
    for position, axes in (((0, 0, 1.5), np.eye(3)), ((0, 0, 0), np.diag((1, -1, -1)))):
        write(position, axes)
        told = r"element camera is the pose of a sensor, xyz \[0.0, .*--extr.* remove that element$"
        refused(told, read_cloud, path)
        np.testing.assert_allclose(read_cloud(path, posed=True).points, POINTS)


def test_a_file_that_is_not_a_cloud_is_refused(tmp_path):
    (tmp_path / "folder.pcd").mkdir()
    os.mkfifo(tmp_path / "pipe.xyz")  # a reader would wait for it
    for name in ("missing.pcd", "folder.pcd", "pipe.xyz"):
        refused(f"cannot read cloud .*{name}", read_cloud, tmp_path / name)
    refused(r"'\.e57'; valid choices: \.npy, \.pcd, \.ply", read_cloud, tmp_path / "a.e57")
    refused(r"'.obj'; valid choices: .pcd, .ply, .npy", write_cloud, tmp_path / "cloud.obj", POINTS)


@pytest.mark.parametrize("suffix", CLOUD_HEADERS)
def test_a_written_cloud_is_read_back(suffix, tmp_path):
    write_cloud(tmp_path / f"cloud{suffix}", POINTS)
    np.testing.assert_array_equal(read_cloud(tmp_path / f"cloud{suffix}").points, POINTS)
