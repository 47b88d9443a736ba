"""Read planning scenes of MoveIt: `.scene` text, and CollisionObject YAML as in MotionBenchMaker.

Boxes, spheres, cylinders and meshes become objects of a `Scene`. Other shapes, octomaps, attached
objects and objects in several frames are refused by name: a scene without them would not be the
same.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.convex_pieces import convex_pieces
from cvqmpt_lab.base.errors import (
    InvalidInputError,
    UnknownChoiceError,
    known_fields,
    located,
    mapping,
    require_choice,
    shown,
)
from cvqmpt_lab.base.files import yaml_value
from cvqmpt_lab.base.poses import ros_vector
from cvqmpt_lab.base.readers import field_of, listed, read_by_suffix
from cvqmpt_lab.base.values import FloatArray, numbers
from cvqmpt_lab.robot.joint_states import joint_state_values
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.robot.source import mesh_path
from cvqmpt_lab.scene.mesh_files import MAX_TRIANGLES, read_mesh
from cvqmpt_lab.scene.moveit_frames import (
    FixedTransform,
    fixed_transforms,
    frame_name,
    matrix_of,
    placed_frames,
)
from cvqmpt_lab.scene.scene import Scene, SceneObject, log
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Shape, Sphere

MOVEIT_SOLIDS: Mapping[str, tuple[int, Callable[..., Shape]]] = {
    "box": (3, lambda *size: Box(size)),
    "sphere": (1, Sphere),
    "cylinder": (2, Cylinder),
}
"""Number of sizes of a solid, (x, y, z) or (radius, height) [m], and function from them to it."""
MOVEIT_SHAPES = (*MOVEIT_SOLIDS, "mesh")


def read_moveit_scene(
    path: Path | str, robot: Robot | None = None, fingers: Mapping[str, float] = {}
) -> tuple[Scene, str]:
    """Return the scene of a file, and the frame of its poses ("": the file has none).

    An object of several convex pieces becomes "ID/0", "ID/1", ... InvalidInputError names the file
    and the object, or a joint that a RobotState has elsewhere than the robot holds it.

    Args:
        path: the file.
        robot: its frames place the objects in the world; None: their frame is the world.
        fingers: values of joints that the robot holds elsewhere [rad or m].
    """
    held = {joint.name: joint.value for joint in robot.held_joints} if robot else {}
    read_yaml = partial(_scene, yaml_value, held={**held, **fingers}, robot=robot)
    read_text = partial(_scene, _from_text, robot=robot)
    readers = {".scene": read_text, ".yaml": read_yaml, ".yml": read_yaml}
    return read_by_suffix(readers, path, "MoveIt scene", Path(path), most=2**24)


def scene_of_yaml(text: str, path: Path) -> Scene:
    """Return the objects of a YAML text as a scene; settings of the robot's links are ignored.

    `path` is for errors and relative paths of meshes.
    """
    with located(str(path)):
        return _scene(yaml_value, text.encode(), path)[0]


def _scene(
    parse: Callable,
    data: bytes,
    path: Path,
    held: Mapping[str, float] | None = None,
    robot: Robot | None = None,
) -> tuple[Scene, str]:
    """Return the scene and frame of a PlanningScene, its world or a list of CollisionObjects.

    Args:
        parse: function from a text to the message.
        data: content of the file.
        path: path of the file.
        held: values of joints that a RobotState must have [rad or m]; None: it and settings of the
            robot's links are not looked at.
        robot: its frames place the objects; None: all must be in one frame.
    """
    message = parse(data.decode("utf-8"))
    if isinstance(message, list):
        message = {"world": {"collision_objects": message}}
    whole = mapping(message, "", "world")
    world = mapping(whole.get("world", whole), "world")
    if "collision_objects" not in world:
        raise InvalidInputError("it has no 'collision_objects', neither in 'world' nor at the top")
    _refuse_other_content(whole, world)
    # others, such as a scale, are refused: they would be left out
    known = (
        *("id", "pose", "primitives", "primitive_poses", "meshes", "mesh_poses", "planes"),
        *("plane_poses", "header", "type", "operation", "subframe_names", "subframe_poses"),
    )
    objects, frames = list[SceneObject](), list[str]()  # the frame of each object
    for k, item in enumerate(listed(world["collision_objects"], "collision_objects")):
        fields = mapping(
            item, f"collision_objects[{k}]", "id, primitives, primitive_poses, meshes, mesh_poses"
        )
        of = str(fields.get("id", "")).strip()
        with located(f"object {shown(of)}"):
            known_fields(fields, "an object", known)
            pieces = list(_pieces_of(fields, path))
            if not pieces:
                raise InvalidInputError("it has no shape; give 'primitives' or 'meshes'")
        names = [of] if len(pieces) == 1 else [f"{of}/{piece}" for piece in range(len(pieces))]
        placed = zip(names, pieces, strict=True)
        objects += [SceneObject(name, shape, T) for name, (shape, T) in placed]
        frames += [frame_name(field_of(fields.get("header"), "frame_id"))] * len(pieces)
    objects, frame = _placed(objects, frames, fixed_transforms(whole), robot)
    if held is not None:
        _refuse_other_values(whole.get("robot_state"), held)
        _refuse_link_settings(whole, [str(item.get("id")) for item in world["collision_objects"]])
    name = str(whole.get("name") or path.stem)
    return Scene(name, tuple(objects)), frame


def _placed(
    objects: Sequence[SceneObject],
    frames: Sequence[str],
    transforms: Sequence[FixedTransform],
    robot: Robot | None,
) -> tuple[list[SceneObject], str]:
    """Return objects, each in its frame, in the world, and a frame that stands there.

    Without a robot, all must be in one frame.
    """
    names = list(dict.fromkeys(frames))
    if robot is None and len(names) > 1:
        raise InvalidInputError(
            f"objects are in frames {', '.join(sorted(names))}; give --robot, which has these "
            "frames, or write all in one frame"
        )
    T = placed_frames(names, transforms, robot)
    placed = [
        replace(item, T_world_object=T[frame] @ item.T_world_object)
        for item, frame in zip(objects, frames, strict=True)
    ]
    at_world = [name for name in names if np.array_equal(T[name], np.eye(4))]
    return placed, at_world[0] if at_world else ""


def _pieces(vertices: FloatArray, triangles: FloatArray) -> Iterator[ConvexMesh]:
    """Yield convex pieces of a mesh: vertices (k, 3) [m], and their indices (f, 3) by triangle."""
    if len(triangles) > MAX_TRIANGLES:
        raise InvalidInputError(
            f"mesh of {len(triangles)} triangles, more than {MAX_TRIANGLES}: simplify it"
        )
    corners = triangles.astype(int)
    if corners.size == 0 or corners.min() < 0 or corners.max() >= len(vertices):
        raise InvalidInputError(
            f"a triangle has a corner that is none of the mesh's {len(vertices)} vertices"
        )
    yield from map(ConvexMesh, convex_pieces(vertices[corners]))


class _Lines:
    """Remaining lines of a `.scene` text; errors name the expected item `what`."""

    def __init__(self, text: str) -> None:
        self.left = [line.strip() for line in text.splitlines() if line.strip()][::-1]

    def next(self, what: str) -> str:
        """Return the next line."""
        if not self.left:
            raise InvalidInputError(f"it ends where {what} is expected: cut short?")
        return self.left.pop()

    def count(self, what: str) -> int:
        """Return the whole number of the next line."""
        line = self.next(what)
        if not line.isdecimal():
            raise InvalidInputError(f"{shown(line)} where {what} is expected")
        return int(line)

    def floats(self, count: int, what: str) -> list[float]:
        """Return `count` numbers of the next line."""
        line = self.next(what)
        try:
            found = [float(word) for word in line.split()]
        except ValueError:
            found = []
        if len(found) != count or not np.isfinite(found).all():
            raise InvalidInputError(f"{shown(line)} where {what} ({count} numbers) is expected")
        return found

    def pose(self, what: str) -> dict[str, list[float]]:
        """Return the pose in the next two lines, position and quaternion."""
        position = self.floats(3, f"the position of {what}")
        return {"position": position, "orientation": self.floats(4, f"the quaternion of {what}")}


def _from_text(text: str) -> dict[str, Any]:
    """Return the message of a `.scene` text.

    Format: name of the scene, objects, ".". An object is "* ID", in newer files its pose, the
    number of shapes, the shapes (kind, sizes, position, quaternion, colour), and in newer files
    subframes.
    """
    lines = _Lines(text)
    found = list[dict[str, Any]]()
    name = lines.next("the scene's name")
    while (line := lines.next("'* ID' of an object, or '.'")) != ".":
        if not line.startswith("*"):
            raise InvalidInputError(f"{shown(line)} where '* ID' of an object, or '.', is expected")
        with located(f"object {shown(line[1:].strip())}"):
            found.append({"id": line[1:], **_object(lines)})
    if lines.left:
        raise InvalidInputError(
            f"{shown(lines.next('an object'))} follows '.', the end of the scene"
        )
    return {"name": name, "collision_objects": found}


def _object(lines: _Lines) -> dict[str, Any]:
    """Return the message of one object from the lines after its "* ID"."""
    kinds = ("primitives", "primitive_poses", "meshes", "mesh_poses")
    found: dict[str, Any] = {kind: [] for kind in kinds}
    newer = bool(lines.left) and len(lines.left[-1].split()) == 3
    if newer:
        found["pose"] = lines.pose("the object")
    for _ in range(lines.count("the number of shapes")):
        kind = require_choice("shape", lines.next("a shape"), MOVEIT_SHAPES)
        if kind == "mesh":
            corners, faces = map(int, lines.floats(2, "the numbers of vertices and triangles"))
            vertices = [lines.floats(3, "a vertex") for _ in range(corners)]
            triangles = [lines.floats(3, "a triangle") for _ in range(faces)]
            found["meshes"].append({"vertices": vertices, "triangles": triangles})
            found["mesh_poses"].append(lines.pose("a shape"))
        else:
            sizes = lines.floats(MOVEIT_SOLIDS[kind][0], f"the size of a {kind}")
            # messages have the height before the radius
            sizes = sizes[::-1] if kind == "cylinder" else sizes
            found["primitives"].append({"type": kind, "dimensions": sizes})
            found["primitive_poses"].append(lines.pose("a shape"))
        lines.floats(4, "a colour")
    for _ in range(lines.count("the number of subframes") if newer else 0):
        lines.next("the name of a subframe")
        lines.pose("a subframe")
    return found


def _refuse_other_content(whole: Mapping[str, Any], world: Mapping[str, Any]) -> None:
    """Refuse diffs, octomaps and attached objects, which a scene cannot have."""
    if whole.get("is_diff"):
        raise InvalidInputError(
            "it has is_diff: true, so that it holds only what changed, not the whole scene; give "
            "the scene that MoveIt's service /get_planning_scene answers, or write is_diff: false "
            "if this is all of it"
        )
    if field_of(field_of(world.get("octomap"), "octomap"), "data"):
        raise InvalidInputError(
            "it has an octomap; write it as a cloud, and give that as a map_file"
        )
    state = whole.get("robot_state")
    refuse_attached(state)
    if field_of(state, "is_diff"):
        log.warning(
            "robot_state has is_diff: true: joints that it does not name are taken where the robot "
            "holds them, and the robot is taken to carry nothing"
        )


def refuse_attached(state: Any) -> None:
    """Refuse the objects that the robot carries in a RobotState."""
    carried = listed(field_of(state, "attached_collision_objects"), "attached objects")
    if carried:
        names = [str(field_of(field_of(item, "object"), "id")) for item in carried]
        raise InvalidInputError(
            f"the robot carries {', '.join(names)}; remove it and write it as 'attachments' of "
            "the problem"
        )


def _refuse_other_values(state: Any, held: Mapping[str, float], most: float = 1e-3) -> None:
    """Refuse joints that a RobotState has more than `most` [rad or m] from where they are held."""
    values = joint_state_values(field_of(state, "joint_state"), "robot_state.joint_state")
    for name, value in values.items():
        if name in held and abs(value - held[name]) > most:
            raise InvalidInputError(
                f"robot_state has {name} at {value:.9g}, the robot holds it at {held[name]:.9g}: "
                f"give --lock {name}={value:.9g}"
            )


def _refuse_link_settings(whole: Mapping[str, Any], objects: Sequence[str]) -> None:
    """Refuse paddings and scales of links, and contacts with `objects` that are allowed."""
    for setting, field, neutral, cure in (
        ("link_padding", "padding", 0.0, "keep that distance by --clearance"),
        ("link_scale", "scale", 1.0, "keep a distance by --clearance"),
    ):
        for item in listed(whole.get(setting), setting):
            value = field_of(item, field)
            if value != neutral:
                link = shown(field_of(item, "link_name"))
                raise InvalidInputError(
                    f"{setting} of {link} is {shown(value)}, which is not read; remove it and "
                    f"{cure}"
                )
    allowed = mapping(whole.get("allowed_collision_matrix") or {}, "allowed_collision_matrix")
    names = listed(allowed.get("entry_names"), "entry_names")
    rows = [field_of(row, "enabled") or [] for row in listed(allowed.get("entry_values"), "values")]
    pairs = [
        (str(first), str(second))
        for first, row in zip(names, rows, strict=False)
        for second, is_allowed in zip(names, row, strict=False)
        if is_allowed is True
    ]
    general = zip(
        listed(allowed.get("default_entry_names"), "default_entry_names"),
        listed(allowed.get("default_entry_values"), "default_entry_values"),
        strict=False,
    )
    pairs += [(str(name), "everything") for name, is_allowed in general if is_allowed is True]
    for first, second in pairs:
        if first in objects or second in objects:
            raise InvalidInputError(
                f"allowed_collision_matrix allows contact of {first!r} and {second!r}, which is "
                "not read; remove that entry (contact with an object is a collision), or the object"
            )
    if pairs:
        log.warning(
            f"allowed_collision_matrix: {len(pairs)} entries for links are not taken over; the "
            "robot's SRDF says which links may touch each other (--srdf)"
        )


def _pieces_of(fields: Mapping[str, Any], path: Path) -> Iterator[tuple[Shape, FloatArray]]:
    """Yield the convex shapes of an object with their poses (4, 4)."""
    # ROS 2 prints the byte 0, which means to add the object, as text or binary
    if fields.get("operation", 0) not in (0, "add", "ADD", "\0", b"\0"):
        raise InvalidInputError(
            f"operation {shown(fields['operation'])}; only objects that are added are read"
        )
    if fields.get("planes"):
        raise UnknownChoiceError("shape", "plane", MOVEIT_SHAPES)
    T_object = read_pose(fields["pose"]) if fields.get("pose") else np.eye(4)
    for kind, plural in (("primitive", "primitives"), ("mesh", "meshes")):
        shapes = listed(fields.get(plural), plural)
        poses = listed(fields.get(f"{kind}_poses"), f"{kind}_poses")
        if not poses and len(shapes) == 1 and fields.get("pose"):
            poses = [None]  # newer messages may have only the pose of the object
        if len(poses) != len(shapes):
            raise InvalidInputError(
                f"{len(shapes)} {plural} and {len(poses)} {kind}_poses; give one pose for each"
            )
        for item, there in zip(shapes, poses, strict=True):
            T = T_object if there is None else T_object @ read_pose(there)
            made = [read_primitive(item)] if kind == "primitive" else _mesh(item, path)
            yield from ((shape, T) for shape in made)


def read_primitive(item: Any) -> Shape:
    """Return the shape of a SolidPrimitive message."""
    fields = known_fields(item, "primitive", ("type", "dimensions", "polygon"))
    given = fields.get("type")
    kind = str(given).lower()
    if isinstance(given, int):
        # numbers of shape_msgs/SolidPrimitive
        names = {1: "box", 2: "sphere", 3: "cylinder", 4: "cone", 5: "prism"}
        kind = names.get(given, str(given))
    if kind not in MOVEIT_SOLIDS:
        raise UnknownChoiceError("shape", kind, MOVEIT_SHAPES)
    sizes = numbers(fields.get("dimensions"), "dimensions", "numbers [m]").ravel().tolist()
    count, make = MOVEIT_SOLIDS[kind]
    if len(sizes) != count:
        raise InvalidInputError(f"{kind} has {len(sizes)} dimensions; {count} are needed")
    # messages have the height before the radius
    return make(*(sizes[::-1] if kind == "cylinder" else sizes))


def _mesh(item: Any, path: Path) -> Iterator[Shape]:
    fields = mapping(item, "mesh", "vertices, triangles, or resource")
    if "resource" not in fields:
        known_fields(fields, "mesh", ("vertices", "triangles"))
        faces = listed(fields.get("triangles"), "triangles")
        corners = [field_of(one, "vertex_indices") or one for one in faces]
        vertices = [ros_vector(one) for one in listed(fields.get("vertices"), "vertices")]
        yield from _pieces(
            numbers(vertices, "vertices", "x, y, z [m]").reshape(-1, 3),
            numbers(corners, "triangles", "3 numbers of vertices").reshape(-1, 3),
        )
        return
    known_fields(fields, "mesh", ("resource", "dimensions"))
    name = str(fields["resource"])
    scales = set(numbers(fields.get("dimensions", 1.0), "dimensions", "scales").ravel().tolist())
    if len(scales) != 1:
        raise InvalidInputError(
            f"mesh {name!r} is scaled differently along its axes; scale the file itself"
        )
    yield from map(ConvexMesh, read_mesh(mesh_path(name, path), scales.pop()))


def read_pose(value: Any) -> FloatArray:
    """Return the matrix (4, 4) of a Pose message."""
    fields = known_fields(value, "pose", ("position", "orientation"))
    turn = fields.get("orientation", [0, 0, 0, 1])
    return matrix_of(ros_vector(fields.get("position")), ros_vector(turn))
