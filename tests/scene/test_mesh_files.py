"""Meshes become convex pieces that contain surface and inside, with little free space."""

import io
import zipfile

import numpy as np
import pytest
import trimesh
from judged_bodies import Body
from refusals import refused
from scipy.spatial import ConvexHull

from cvqmpt_lab.base.convex_pieces import MAX_MESH_PIECES, convex_pieces, spread_points
from cvqmpt_lab.scene.mesh_files import read_mesh, read_triangles
from cvqmpt_lab.scene.shapes import ConvexMesh


def box(size, at=(0.0, 0.0, 0.0)):
    return trimesh.creation.box(size, transform=trimesh.transformations.translation_matrix(at))


def table():
    legs = [box((0.04, 0.04, 0.7), (x, y, 0.35)) for x in (-0.45, 0.45) for y in (-0.25, 0.25)]
    return trimesh.util.concatenate([box((1.0, 0.6, 0.03), (0.0, 0.0, 0.715)), *legs])


MESHES = {
    "box": (box((0.2, 0.3, 0.4)), 1, 1.001),
    "cylinder": (trimesh.creation.cylinder(0.1, 0.3), 1, 1.001),
    "table": (table(), 20, 1.5),
    "ring": (trimesh.creation.annulus(0.04, 0.045, 0.1), 40, 1.3),
    "plate": (trimesh.creation.annulus(0.2, 0.5, 0.01), MAX_MESH_PIECES, 1.15),
    "torus": (trimesh.creation.torus(0.3, 0.05, 24, 12), MAX_MESH_PIECES, 1.3),
}


@pytest.mark.parametrize("name", MESHES)
def test_pieces_contain_the_mesh_and_little_free_space(name):
    mesh, most, ratio = MESHES[name]
    triangles = np.array(mesh.triangles)
    hulls = [ConvexHull(ConvexMesh(piece).vertices) for piece in convex_pieces(triangles)]
    probes = np.random.default_rng(0).uniform(*mesh.bounds, (3000, 3))
    inside = probes[Body(name, 0, triangles).holds(probes)]
    surface = np.concatenate([mesh.vertices, spread_points(triangles, 4000)])
    assert len(inside) > 100 and farthest_outside(np.concatenate([inside, surface]), hulls) < 1e-7
    assert len(hulls) <= most
    assert sum(hull.volume for hull in hulls) < ratio * abs(mesh.volume)


@pytest.mark.parametrize("share", [1.0, 0.95], ids=["closed", "open"])
def test_large_meshes_are_covered_by_few_pieces(share):
    ball = trimesh.creation.icosphere(5)
    triangles = np.array(ball.triangles)[ball.triangles_center[:, 2] < 2.0 * share - 1.0]
    triangles[:, :, 0] *= 1.0 + 0.5 * np.cos(9.0 * triangles[:, :, 1])
    pieces = convex_pieces(triangles)
    hulls = [ConvexHull(piece) for piece in pieces]
    assert len(hulls) > 20 and farthest_outside(spread_points(triangles, 4000), hulls) < 1e-7


def test_a_bracket_is_cut_although_a_cut_can_leave_nothing_on_one_side():
    """The bracket is a prism with an outline in x and y, from z = 0 to 0.29108 m."""
    outline = [(0.16093, 0.02), (0.16093, 0), (0, 0), (0.02, 0.02), (0.02, 0.17268), (0, 0.17268)]
    corners = np.array([(*at, z) for z in (0.0, 0.29108) for at in outline])
    bottom = np.array([(0, 1, 2), (3, 0, 2), (4, 3, 2), (5, 4, 2)])
    k, after = np.arange(6), np.array([1, 2, 5, 0, 3, 4])  # around the outline
    sides = np.concatenate([np.stack([k, after + 6, after], 1), np.stack([k, k + 6, after + 6], 1)])
    triangles = corners[np.concatenate([bottom, bottom[:, ::-1] + 6, sides])]
    hulls = [ConvexHull(piece) for piece in convex_pieces(triangles)]
    assert farthest_outside(spread_points(triangles, 2000), hulls) < 1e-7


@pytest.mark.parametrize(
    "corners", [(0, 0, 0), (0, 1, 1), (0, 1, 2)], ids=["point", "edge", "line"]
)
@pytest.mark.parametrize("mesh", [box((0.2, 0.3, 0.4)), table()], ids=["box", "table"])
def test_triangles_without_area_change_nothing(mesh, corners):
    rng, triangles = np.random.default_rng(1), np.array(mesh.triangles)
    ends = rng.uniform(-0.6, 0.6, (40, 2, 3))
    flat = np.stack([*np.moveaxis(ends, 1, 0), ends.mean(axis=1)], axis=1)[:, list(corners)]
    expected, found = convex_pieces(triangles), convex_pieces(np.concatenate([triangles, flat]))
    assert len(found) == len(expected) and all(map(np.array_equal, found, expected))
    refused("the mesh of 0 points is 0 m thick", convex_pieces, flat)


def farthest_outside(points, hulls):
    """Return the largest distance [m] of a point from all hulls; negative if all are inside."""
    planes = [hull.equations for hull in hulls]
    depths = [(points @ each[:, :3].T + each[:, 3]).max(axis=1) for each in planes]
    return np.min(depths, axis=0).max()


@pytest.mark.parametrize("suffix", ["stl", "obj", "dae"])
def test_a_file_is_read_in_its_unit(suffix, tmp_path):
    mesh = box((200.0, 300.0, 400.0), (0.0, 0.0, 100.0))
    data = mesh.export(file_type=suffix)
    data = data.encode() if isinstance(data, str) else data
    (tmp_path / f"a.{suffix}").write_bytes(data)
    (piece,) = read_mesh(tmp_path / f"a.{suffix}", 0.001)
    np.testing.assert_allclose(piece.min(axis=0), (-0.1, -0.15, -0.1), atol=1e-6)
    np.testing.assert_allclose(piece.max(axis=0), (0.1, 0.15, 0.3), atol=1e-6)
    refused(r"millimetres: 0\.001", read_mesh, tmp_path / f"a.{suffix}")


def in_unit(metres):
    """COLLADA data of a box of 20 x 30 x 40 units."""
    data = box((20.0, 30.0, 40.0)).export(file_type="dae")
    return data.replace(b"<up_axis>", f'<unit meter="{metres}"/><up_axis>'.encode())


def test_the_unit_of_a_collada_file_is_used(tmp_path):
    (tmp_path / "a.dae").write_bytes(in_unit("0.01"))
    (piece,) = read_mesh(tmp_path / "a.dae")
    np.testing.assert_allclose(np.ptp(piece, axis=0), (0.2, 0.3, 0.4))


def test_a_unit_in_a_comment_of_a_collada_file_is_none(tmp_path):
    stated = in_unit("0.01").replace(b"<unit ", b'<!-- <unit meter="1"/> --><unit ')
    (tmp_path / "a.dae").write_bytes(stated)
    np.testing.assert_allclose(np.ptp(read_mesh(tmp_path / "a.dae")[0], axis=0), (0.2, 0.3, 0.4))


def zipped(content):
    """A zip archive with a COLLADA file, which its reader would unpack."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a.dae", content)
    return file.getvalue()


FLAT = b"v 0 0 0\nv .1 0 0\nv 0 .1 0\nv .03 .03 1e-9\nf 1 2 3\nf 1 2 4\n"
CUBE = box((1, 1, 1)).export(file_type="stl_ascii").encode()
LOOSE = b"\nfacet normal 0 0 1\nouter loop\n" + 3 * b"vertex 9 9 9\n" + b"endloop\nendfacet\n"
CUBE_OBJ = box((1, 1, 1)).export(file_type="obj").encode()
BAD = {
    # content that was left out without a word
    "lost.dae": (in_unit("0.01").replace(b'url="#', b'url="#no-'), "'#no-.*', which"),
    "holes.dae": (
        in_unit("0.01").replace(b"</mesh>", b"<polygons><ph><p>0</p></ph></polygons></mesh>"),
        "polygons with holes .<ph>., which is not read; export it again as plain triangles",
    ),
    "skin.dae": (
        in_unit("0.01").replace(b"</node>", b"</node><node><instance_controller/></node>"),
        "skinned or morphed geometry .<instance_controller>.",
    ),
    "entity.dae": (
        in_unit("0.01").replace(b"<COLLADA", b'<!DOCTYPE a [<!ENTITY b "c">]><COLLADA', 1),
        "declares entities",
    ),
    "archive.dae": (zipped(in_unit("0.01")), "an archive"),
    "old.obj": (CUBE_OBJ.replace(b"\nf ", b"\nfo ", 1), "its line 'fo .*' has faces and surfaces"),
    "surface.obj": (CUBE_OBJ + b"\nsurf 0 1 0 1 1 2 3 4\n", "its line 'surf 0 1 .*plain triangles"),
    "weight.obj": (CUBE_OBJ.replace(b"\nv ", b"\nv 1 1 1 0.5\nv ", 1), "'v 1 1 1 0.5' has a wei"),
    "flat.obj": (FLAT, "m thick, less than 0.0001"),
    "far.obj": (FLAT.replace(b".03 .03 1e-9", b"0 0 1e300"), "m from the origin"),
    "nan.obj": (b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "finite|parse|could not"),
    "index.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "obj"),
    "points.obj": (b"v 0 0 0\nv 1 0 0\n", "obj"),
    "empty.stl": (b"", "cut short"),
    "billion.stl": (bytes(80) + (10**9).to_bytes(4, "little") + bytes(50), "cut short"),
    "cut.stl": (box((1, 1, 1)).export(file_type="stl")[:-70], "cut short"),
    "more.stl": (CUBE + LOOSE, "12 of its 13 triangles belong to a solid"),
    "unit.dae": (in_unit("-1"), "its unit is .*-1"),
    "page.dae": (b"<!DOCTYPE html><html></html>", "dae"),
    "none.dae": (b"<?xml version='1.0'?><COLLADA version='1.4.1'/>", "dae"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_meshes_are_refused_by_name_in_one_line(name, tmp_path):
    data, message = BAD[name]
    (tmp_path / name).write_bytes(data)
    assert name in refused(message, read_mesh, tmp_path / name)


def test_no_triangle_is_skipped_because_of_blanks(tmp_path):
    data = box((0.1, 0.2, 0.3)).export(file_type="obj").encode()
    indented = data.replace(b"\nf ", b"\n  f\t", 6)
    (tmp_path / "a.obj").write_bytes(data)
    (tmp_path / "b.obj").write_bytes(indented)
    expected, found = (read_triangles(tmp_path / f"{name}.obj") for name in "ab")
    assert indented != data
    np.testing.assert_array_equal(found, expected)


def test_names_in_another_encoding_do_not_matter(tmp_path):
    data = box((0.1, 0.2, 0.3)).export(file_type="obj").encode()
    (tmp_path / "a.obj").write_bytes("# Größe in Metern\n".encode("latin-1") + data)
    assert len(read_mesh(tmp_path / "a.obj")) == 1
    refused(r"'\.fbx'; valid choices: \.stl, \.obj, \.dae", read_mesh, tmp_path / "a.fbx")
