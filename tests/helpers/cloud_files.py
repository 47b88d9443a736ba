"""Small cloud files of every kind, written by hand."""

import io

import lzf
import numpy as np

POINTS = np.random.default_rng(0).uniform(-0.9, 0.9, (40, 3)).astype("f4").astype(float)


def pcd(points, form="binary", fields="x y z rgb", **changes):
    """A PCD file of points, each with a colour; changes replace lines of the header."""
    columns = np.c_[points, np.zeros(len(points))].astype("<f4")
    lines = {
        "VERSION": "0.7",
        "FIELDS": fields,
        "SIZE": "4 4 4 4",
        "TYPE": "F F F F",
        "COUNT": "1 1 1 1",
        "WIDTH": len(points),
        "HEIGHT": 1,
        "VIEWPOINT": None,
        "POINTS": len(points),
        "DATA": form,
    } | changes
    header = "".join(
        f"{key} {value}\n" for key, value in lines.items() if value is not None
    ).encode()
    raw = columns.T.tobytes()
    packed = (lzf.compress(raw) if raw else b"") or b""
    sizes = np.array([len(packed), len(raw)], "<u4").tobytes()
    bodies = {
        "ascii": "\n".join(" ".join(repr(float(x)) for x in row) for row in columns).encode(),
        "binary": columns.tobytes(),
        "binary_compressed": sizes + packed,
    }
    return b"# .PCD v0.7\n" + header + bodies.get(lines["DATA"], b"")


def ply(points, form="binary_little_endian", head="", tail="", kind="float"):
    """A PLY file of points, each with a shade before them."""
    count = head or f"element vertex {len(points)}"
    header = f"ply\nformat {form} 1.0\ncomment none\n{count}\nproperty uchar shade\n"
    header += "".join(f"property {kind} {axis}\n" for axis in "xyz") + f"{tail}end_header\n"
    if form == "ascii":
        return (
            header.encode()
            + "\n".join("7 " + " ".join(map(repr, map(float, row))) for row in points).encode()
        )
    order = "<" if form == "binary_little_endian" else ">"
    rows = np.zeros(len(points), [("shade", "u1"), *((axis, f"{order}f4") for axis in "xyz")])
    for axis, column in zip("xyz", points.T, strict=True):
        rows[axis] = column
    return header.encode() + rows.tobytes()


def npy(array):
    """A NPY file."""
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def xyz(points, separator=" "):
    """Lines of numbers with a comment and a colour."""
    rows = (separator.join([*(repr(float(x)) for x in row), "255"]) for row in points)
    return ("# x y z colour\n" + "\n".join(rows)).encode()


LINES = xyz(POINTS, ",").splitlines()[1:]
GOOD = {
    "a.pcd": pcd(POINTS, "ascii"),
    "b.pcd": pcd(POINTS, "binary"),
    "c.pcd": pcd(POINTS, "binary_compressed"),
    "padded.pcd": pcd(POINTS, "binary_compressed") + bytes(500),
    "organised.pcd": pcd(POINTS, "binary", WIDTH=8, HEIGHT=5),
    "old.pcd": pcd(POINTS, "ascii", COUNT=None, WIDTH=None, HEIGHT=None),
    "a.ply": ply(POINTS, "ascii"),
    "b.ply": ply(POINTS),
    "big.ply": ply(POINTS, "binary_big_endian"),
    "edges.ply": ply(POINTS, "ascii", tail="element edge 1\nproperty int vertex1\n") + b"\n3\n",
    "mesh.ply": ply(POINTS, tail="element face 1\nproperty list uchar int vertex_indices\n")
    + bytes([3])
    + bytes(12),
    "a.npy": npy(POINTS),
    "single.npy": npy(POINTS.astype("f4")),
    "image.npy": npy(POINTS.reshape(8, 5, 3)),
    "columns.npy": npy(np.asfortranarray(POINTS)),
    "named.npy": npy(
        np.rec.fromarrays([POINTS[:, 0], np.zeros(40), *POINTS[:, 1:].T], names="x,c,y,z")
    ),
    "a.xyz": xyz(POINTS),
    "a.csv": xyz(POINTS, ","),
    "remark.xyz": b"# x, y, z\n\n" + xyz(POINTS).replace(b"255\n", b"255 # dark, near\n"),
    "b.csv": xyz(POINTS, "; "),
    "mark.csv": b"\xef\xbb\xbf" + xyz(POINTS, ",").partition(b"\n")[2],
    "names.csv": b'"X","Y","Z","I"\n' + xyz(POINTS, ",").partition(b"\n")[2],
    "turned.csv": b"I;z;y;x\n" + b"\n".join(b";".join(line.split(b",")[::-1]) for line in LINES),
    "count.xyz": b"40\n" + xyz(POINTS),
    "blank.ply": ply(POINTS).replace(b"comment none\n", b"\n \r\n"),
    "views.ply": ply(POINTS, tail="element camera 1\nproperty list uchar uchar views\n") + b"\1\1",
}
