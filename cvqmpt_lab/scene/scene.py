"""A scene: named shapes with poses, and the hinges and sliders that move some of them.

Scenes of users are refused where they cannot be in metres, and reported out of the arm's reach.

Everything here is frozen data. Changing a scene (opening a door, adding a can) returns a new one.
Poses are 4x4 arrays `T_world_x` that map points of frame x into the world frame, which is the robot
base link frame. Lengths in [m], angles in [rad].

In files shapes may be named by path: `{"type": "cloud_file", "path": "scan.pcd", "radius": 0.01}`
becomes a PointCloud, `{"type": "map_file", "path": "scan.pcd"}` an OccupancyMap, `{"type":
"mesh_file", "path": "shelf.stl", "scale": 0.001}` a ConvexMesh; a mesh that is not convex becomes
several objects, "shelf/0", "shelf/1", ...
"""

from __future__ import annotations  # so `help` shows forms by their names

import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cvqmpt_lab.codec import Checked, from_plain
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError, at, located, unique
from cvqmpt_lab.files import read_json_object
from cvqmpt_lab.poses import Pose, pose
from cvqmpt_lab.robot.source import with_absolute_paths
from cvqmpt_lab.scene.cells import map_of_points
from cvqmpt_lab.scene.shapes import (
    SHAPES_BY_PATH,
    Box,
    CloudFile,
    ConvexMesh,
    MapFile,
    Measured,
    MeshFile,
    OccupancyMap,
    PointCloud,
    Shape,
    bounding_radius,
)
from cvqmpt_lab.values import FloatArray, Mass, Name


@dataclass(frozen=True, eq=False)
class SceneObject(Checked):
    """A named shape at a pose."""

    name: Name  # unique in its scene, e.g. "dagger_door_left/panel"
    shape: Shape  # the geometry, in the object frame
    T_world_object: Pose  # (4, 4), pose of the object frame in the world
    obstacle: bool = True  # False: cameras see it, planners ignore it (the floor)
    mass: Mass | None = None  # [kg], counts once a hand carries it; None: not known, taken as 0


@dataclass(frozen=True, eq=False)
class Articulation(Checked):
    """A hinge or a slider that moves some objects of a scene."""

    name: Name  # unique among the scene's articulations, e.g. "dagger_door_left"
    kind: Literal["hinge", "slider"]  # a hinge turns about the axis, a slider moves along it
    T_world_joint: Pose  # (4, 4), pose of the joint frame in the world, whose z is the axis
    lower: float  # of its range, [rad] for a hinge, [m] for a slider
    upper: float  # of its range [rad or m]
    value: float  # where it is now [rad or m]
    moves: tuple[Name, ...]  # names of moved objects; the scene has their poses at `value`

    def _check(self) -> None:
        if self.lower > self.upper:
            raise InvalidInputError(
                f"articulation {self.name!r}: lower {self.lower} is above upper {self.upper}"
            )
        self._check_range(self.value)

    def displacement(self, value: float) -> FloatArray:
        """Return the (4, 4) world motion of the objects from `self.value` to a `value` in range."""
        self._check_range(value)
        return (
            self.T_world_joint @ self.motion(value - self.value) @ np.linalg.inv(self.T_world_joint)
        )

    def motion(self, change: float) -> FloatArray:
        """Return the motion (4, 4) by a change of the value [rad or m], in the joint frame."""
        return pose((0.0, 0.0, 0.0), change) if self.kind == "hinge" else pose((0.0, 0.0, change))

    def _check_range(self, value: float) -> None:
        """Raise `InvalidInputError` unless `value` is in the range."""
        if not self.lower <= value <= self.upper:
            unit = "rad" if self.kind == "hinge" else "m"
            raise InvalidInputError(
                f"value {value!r} of {self.kind} {self.name!r} is outside its range "
                f"[{self.lower}, {self.upper}] {unit}"
            )


@dataclass(frozen=True, eq=False)
class Scene(Checked):
    """Named objects and articulations; scenes with the same content are equal."""

    name: Name  # what the scene is called in results
    objects: tuple[SceneObject, ...]
    """Everything that cameras see, in a fixed order that is part of the content."""
    articulations: tuple[Articulation, ...] = ()
    """Hinges and sliders; each object is moved by one of them at most."""

    def _check(self) -> None:
        scene = f"scene {self.name!r}"
        unique(self.names, f"objects of {scene}")
        unique((item.name for item in self.articulations), f"articulations of {scene}")
        unique(
            (name for item in self.articulations for name in item.moves),
            f"objects that {scene} moves",
        )
        known = set(self.names)
        for articulation in self.articulations:
            for name in articulation.moves:
                if name not in known:
                    raise InvalidInputError(
                        f"articulation {articulation.name!r} moves {name!r}, which is no object "
                        f"of {scene}: add the object or correct `moves`"
                    )

    def __repr__(self) -> str:
        few = ", ".join(self.names[:8]) + (", ..." if len(self.objects) > 8 else "")
        joints = f", {len(self.articulations)} hinges and sliders" if self.articulations else ""
        return (
            f"Scene {self.name!r}: {len(self.objects)} objects{joints}\nobjects     {few or 'none'}"
        )

    def __getitem__(self, name: str) -> SceneObject:
        for item in self.objects:
            if item.name == name:
                return item
        raise UnknownChoiceError(f"object of scene {self.name!r}", name, self.names)

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[SceneObject]:
        return iter(self.objects)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all objects, in order."""
        return tuple(item.name for item in self.objects)

    @property
    def obstacles(self) -> tuple[SceneObject, ...]:
        """The objects that planners must avoid, in order."""
        return tuple(item for item in self.objects if item.obstacle)

    def articulation(self, name: str) -> Articulation:
        """Return the articulation called `name`; raises `UnknownChoiceError` if there is none."""
        for item in self.articulations:
            if item.name == name:
                return item
        choices = [item.name for item in self.articulations]
        raise UnknownChoiceError(f"articulation of scene {self.name!r}", name, choices)

    def with_objects(self, *objects: SceneObject) -> Scene:
        """Return a scene with these objects added at the end."""
        return replace(self, objects=self.objects + objects)

    def without(self, *names: str) -> Scene:
        """Return a scene without these objects; articulations that then move nothing go too."""
        gone = {self[name].name for name in names}
        moves = (
            (item, tuple(name for name in item.moves if name not in gone))
            for item in self.articulations
        )
        joints = (item.changed(moves=left) for item, left in moves)
        return self.changed(
            objects=tuple(item for item in self.objects if item.name not in gone),
            articulations=tuple(item for item in joints if item.moves),
        )

    def with_joint(self, name: str, value: float) -> Scene:
        """Return a scene with articulation `name` at `value` [rad or m], its objects moved along.

        Raises:
            UnknownChoiceError: there is no such articulation.
            InvalidInputError: `value` is outside its range.
        """
        joint = self.articulation(name)
        motion = joint.displacement(value)
        parts = [self[part] for part in joint.moves]
        moved = {
            part.name: replace(part, T_world_object=motion @ part.T_world_object) for part in parts
        }
        return self.changed(
            objects=tuple(moved.get(item.name, item) for item in self.objects),
            articulations=tuple(
                item.changed(value=float(value)) if item is joint else item
                for item in self.articulations
            ),
        )

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return super().__hash__()  # 6 ms for the kitchen, asked for with every problem


@dataclass(frozen=True, eq=False)
class Attachment(Checked):
    """A shape fixed to the robot's end effector."""

    name: Name  # unique among what the hand carries
    shape: Shape  # the geometry, in the object frame
    T_hand_object: Pose  # (4, 4), pose of the shape in the end-effector frame [m]
    mass: Mass | None = None  # [kg], for timing and execution; None: not known, taken as 0
    end_effector: Name | None = None  # that carries it; None: the robot's first
    # other end effectors that hold it, too: what is fixed to them may touch it
    also_held_by: tuple[Name, ...] = ()

    @property
    def held_by(self) -> tuple[str | None, ...]:
        """All end effectors that hold it; None: the robot's first."""
        return self.end_effector, *self.also_held_by

    def _check(self) -> None:
        if isinstance(self.shape, OccupancyMap):
            raise InvalidInputError(
                f"attachment {self.name!r} is an occupancy map; what is carried is a solid or a "
                "point cloud"
            )


log = logging.getLogger("cvqmpt")


def refuse_far_poses(poses: dict[str, np.ndarray], farthest: float = 100.0) -> None:
    """Refuse a pose (4, 4) over `farthest` [m] from the world's origin, by its place in a file."""
    for where, T in poses.items():
        _refuse_above(farthest, float(np.abs(T[:3, 3]).max()), f"{where} is", "off")


def _refuse_above(most: float, length: float, what: str, how: str) -> None:
    if length > most:
        raise InvalidInputError(
            f"{what} {length:.4g} m {how}, more than {most:g}: no metres? Give metres"
        )


def check_lengths(
    scene: Scene,
    reach: float,
    where: str = "scene",
    farthest: float = 100.0,
    largest: float = 250.0,
) -> None:
    """Refuse an obstacle larger than `largest`, or more than `farthest` off the origin [m].

    Floors of 200 m are drawn. Logs a warning if an arm of that reach [m] can touch no obstacle.
    """
    gaps = {item.name: distance(item) for item in scene.obstacles}
    for k, item in enumerate(scene.objects):
        if not item.obstacle or isinstance(item.shape, Measured):
            continue
        lengths: tuple[float, ...] = ()
        if not isinstance(item.shape, ConvexMesh):
            lengths = tuple(np.ravel([*vars(item.shape).values()]).tolist())
        name = f"{at(where, f'objects[{k}], {item.name!r},')} is"
        _refuse_above(largest, max(lengths, default=0.0), name, "large")
        _refuse_above(farthest, gaps[item.name], name, "off")
    nearest = min(gaps, key=lambda name: gaps[name], default="")
    if gaps and gaps[nearest] > reach:
        log.warning(
            f"scene {scene.name!r}: the arm can touch nothing of it: {nearest!r} is nearest, "
            f"{gaps[nearest]:.3g} m off, and the arm reaches {reach:.3g} m; no metres, or in "
            "another frame than the robot's base?"
        )


def distance(item: SceneObject) -> float:
    """Distance [m] of an obstacle from the world's origin; exact for a box, else a lower bound."""
    if isinstance(item.shape, Box):
        T = item.T_world_object
        # of the world's origin, mirrored, in the box's frame
        beyond = np.abs(T[:3, 3] @ T[:3, :3]) - 0.5 * np.array(item.shape.size)
        return float(np.linalg.norm(np.maximum(beyond, 0.0)))
    return max(
        math.dist(item.T_world_object[:3, 3], (0.0, 0.0, 0.0)) - bounding_radius(item.shape), 0.0
    )


def with_files_read(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Json of a problem or task with its files read and the paths of its robot's files absolute.

    Args:
        data: not changed; its scene may be the path of a json file. Read are files that the scene
            and attachments name; anything that is no object with a shape by path stays as it is.
        folder: of the json file; relative paths start here.
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
    """The scene of a json file of its own; errors name the file."""
    path = Path(path)
    data = _scene(read_json_object(path, "scene"), path.parent)
    with located(f"scene {path}"):
        return from_plain(Scene, data)


def named_files(data: Mapping[str, Any], folder: Path) -> Iterator[Path]:
    """The files that `with_files_read` reads for json that is well-formed."""
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
    """Json of a scene; what moves an object moves all its pieces."""
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
    """Json of objects with their shapes, and the pieces' names by that of their object."""
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
        parts = zip(names, shapes, strict=True)
        found.extend({**item, "name": name, "shape": shape} for name, shape in parts)
    return found, pieces


def _shapes(
    named: CloudFile | MapFile | MeshFile, folder: Path
) -> Iterator[PointCloud | OccupancyMap | ConvexMesh]:
    """The shapes of one file."""
    path = folder / named.path
    if not isinstance(named, MeshFile):
        from cvqmpt_lab.scene.cloud_files import read_cloud

        cloud = read_cloud(path, named.scale)
        log.info(f"{path}: {len(cloud.points)} points, {cloud.dropped} left out, not finite")
        if isinstance(named, MapFile):
            yield map_of_points(cloud.points, named.resolution, named.padding)
        else:
            yield PointCloud(cloud.points, named.radius)
        return
    from cvqmpt_lab.scene.mesh_files import read_mesh  # its parser takes 0.3 s to import

    vertices = read_mesh(path, named.scale)
    log.info(f"{path}: {len(vertices)} convex pieces")
    yield from map(ConvexMesh, vertices)
