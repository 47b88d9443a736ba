"""COLLADA (DAE) meshes: their unit, and content that readers of meshes leave out without a word."""

import math
import re

from cvqmpt_lab.base.errors import InvalidInputError, shown


def collada_unit(data: bytes) -> float:
    """Return the unit [m] that a COLLADA file states, 1 without one; refuse one that is not > 0.

    Files with content that coal's or trimesh's readers leave out are refused, too: the body would
    be smaller than it is.
    """
    data = re.sub(rb"(?s)<!--.*?-->", b"", data)
    known = set(re.findall(rb"<geometry\b[^>]*?\bid\s*=\s*[\"']([^\"']*)", data))
    for name in re.findall(rb"<instance_geometry\b[^>]*?\burl\s*=\s*[\"']([^\"']*)", data):
        if name[:1] != b"#" or name[1:] not in known:
            raise InvalidInputError(
                f"its scene has the geometry {shown(name.decode(errors='replace'))}, which the "
                "file does not contain; export it again with all geometry in one file"
            )
    left_out = {
        "instance_controller": "skinned or morphed geometry",
        "ph": "polygons with holes",
        "skew": "a skewed node",
    }
    for tag, what in left_out.items():
        if re.search(rf"<{tag}\b".encode(), data):
            raise InvalidInputError(
                f"it has {what} (<{tag}>), which is not read; export it again as plain triangles"
            )
    stated = re.search(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([^\"']*)", data)
    if stated is None:
        return 1.0
    try:
        unit = float(stated[1])
    except ValueError:
        unit = math.nan
    if not 0.0 < unit < math.inf:
        text = stated[1].decode(errors="replace")
        raise InvalidInputError(f"its unit is {shown(text)} m; give a positive number")
    return unit
