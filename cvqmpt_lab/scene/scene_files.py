"""Read the files of clouds and meshes that a JSON file names, and replace them by shapes.

`{"type": "cloud_file", "path": "scan.pcd", "radius": 0.01}` becomes a PointCloud, `{"type":
"map_file", "path": "scan.pcd"}` an OccupancyMap, `{"type": "mesh_file", "path": "shelf.stl",
"scale": 0.001}` a ConvexMesh. A mesh that is not convex becomes several objects: "shelf/0",
"shelf/1", ...
"""

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError, located
from cvqmpt_lab.base.files import json_value, read_json_object, read_text
from cvqmpt_lab.robot.source import with_absolute_paths
from cvqmpt_lab.scene.cells import map_of_points
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import (
    SHAPES_BY_PATH,
    CloudFile,
    ConvexMesh,
    MapFile,
    MeshFile,
    OccupancyMap,
    PointCloud,
)

log = logging.getLogger(__name__)


def with_files_read(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return JSON of a problem or task with shapes in place of files, and absolute robot paths.

    Args:
        data: JSON; it is not changed. Its scene may be the path of a JSON file. Files of shapes in
            the scene and attachments are read; malformed parts are returned unchanged.
        folder: folder of the JSON file; relative paths start here.
    """
    read = dict(data)
    if isinstance(data.get("scene"), str):
        read["scene"] = read_scene(folder / data["scene"])
    if isinstance(data.get("scene"), dict):
        read["scene"] = _scene(data["scene"], folder)
    if "attachments" in data:
        read["attachments"] = _expanded(data["attachments"], folder, "attachments")[0]
    if "robot" in data:
        read["robot"] = with_absolute_paths(folder, data["robot"])
    return read


def read_scene(path: Path | str) -> Scene:
    """Read the JSON file of a scene; errors name the file."""
    path = Path(path)
    data = _scene(read_json_object(path, "scene"), path.parent)
    with located(f"scene {path}"):
        return from_plain(Scene, data)


def read_attachments(path: Path | str) -> tuple[Attachment, ...]:
    """Read what a hand carries: a list in a JSON file, or its field "attachments"."""
    path = Path(path)
    data = json_value(read_text(path, "attachments"), f"attachments {path}")
    items = data.get("attachments") if isinstance(data, Mapping) else data
    if not isinstance(items, list) or not items:
        raise InvalidInputError(
            f"attachments {path}: it has no list of attachments; write "
            '[{"name", "shape", "T_hand_object"}]'
        )
    with located(f"attachments {path}"):
        items, _ = _expanded(items, path.parent, "attachments")
        return from_plain(tuple[Attachment, ...], items)


def named_files(data: Mapping[str, Any], folder: Path) -> Iterator[Path]:
    """Yield the files that `with_files_read` reads for well-formed JSON."""
    scene = data.get("scene")
    if isinstance(scene, str):
        path = folder / scene
        yield path
        yield from named_files({"scene": read_json_object(path, "scene")}, path.parent)
    items = [
        *(scene["objects"] if isinstance(scene, Mapping) else ()),
        *data.get("attachments", ()),
    ]
    shapes = [item["shape"] for item in items]
    yield from (folder / shape["path"] for shape in shapes if shape["type"] in SHAPES_BY_PATH)


def _scene(scene: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return JSON of a scene with shapes in place of files; joints move all pieces of an object."""
    objects, pieces = _expanded(scene.get("objects"), folder, "scene.objects")
    joints = scene.get("articulations")
    if pieces and isinstance(joints, list):
        joints = [
            {
                **joint,
                "moves": [
                    piece for name in joint["moves"] for piece in pieces.get(str(name), [name])
                ],
            }
            if isinstance(joint, dict) and isinstance(joint.get("moves"), list)
            else joint
            for joint in joints
        ]
        scene = {**scene, "articulations": joints}
    return {**scene, "objects": objects} if pieces else scene


def _expanded(items: Any, folder: Path, where: str) -> tuple[Any, dict[str, list[str]]]:
    """Return JSON of objects with shapes in place of files, and pieces' names by object."""
    if not isinstance(items, list):
        return items, {}
    found: list[Any] = []
    pieces: dict[str, list[str]] = {}
    for k, item in enumerate(items):
        shape = item.get("shape") if isinstance(item, dict) else None
        kind = shape.get("type") if isinstance(shape, dict) else None
        if not isinstance(shape, dict) or not isinstance(kind, str) or kind not in SHAPES_BY_PATH:
            found.append(item)
            continue
        with located(f"{where}[{k}].shape"):
            fields = {key: value for key, value in shape.items() if key != "type"}
            shapes = list(_shapes(from_plain(SHAPES_BY_PATH[kind], fields), folder))
        name = item.get("name")
        names = [name] if len(shapes) == 1 else [f"{name}/{piece}" for piece in range(len(shapes))]
        pieces[str(name)] = names
        parts = [
            {**item, "name": name, "shape": shape}
            for name, shape in zip(names, shapes, strict=True)
        ]
        mass = item.get("mass")
        if len(parts) > 1 and type(mass) in (float, int):  # of all pieces together
            from cvqmpt_lab.scene.coal_shapes import coal_shape  # needed here alone

            volumes = [coal_shape(shape).computeVolume() for shape in shapes]
            for part, volume in zip(parts, volumes, strict=True):
                part["mass"] = mass * volume / sum(volumes)
        found.extend(parts)
    return found, pieces


def _shapes(
    named: CloudFile | MapFile | MeshFile, folder: Path
) -> Iterator[PointCloud | OccupancyMap | ConvexMesh]:
    """Yield the shapes of one file."""
    path = folder / named.path
    if not path.exists():
        path = path.absolute()  # the error says in which folder it looked
    if not isinstance(named, MeshFile):
        from cvqmpt_lab.scene.cloud_files import read_cloud

        cloud = read_cloud(path, named.scale)
        log.info(f"{path}: {len(cloud.points)} finite points, {cloud.dropped} others left out")
        if isinstance(named, MapFile):
            yield map_of_points(cloud.points, named.resolution, named.padding)
        else:
            yield PointCloud(cloud.points, named.radius)
        return
    from cvqmpt_lab.scene.mesh_files import read_mesh  # takes 0.3 s to import

    vertices = read_mesh(path, named.scale)
    log.info(f"{path}: {len(vertices)} convex pieces")
    yield from map(ConvexMesh, vertices)
