"""A scene: named shapes with poses, and the hinges and sliders that move some of them.

All classes are frozen data: a change of a scene (a door is opened, a can is added) returns a new
scene. Poses are 4x4 arrays `T_world_x` that map points of frame x into the world frame, which is
the frame of the robot's base link. Lengths in [m], angles in [rad]. A scene whose lengths cannot be
metres is refused; one out of the arm's reach gives a warning.
"""

from __future__ import annotations  # `help` then shows types by their names

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np

from cvqmpt_lab.base.codec import Checked, digest_of, from_plain
from cvqmpt_lab.base.errors import InvalidInputError, at, require_choice, shown, unique
from cvqmpt_lab.base.poses import Pose, pose
from cvqmpt_lab.base.values import Condition, FloatArray, Mass, Name
from cvqmpt_lab.scene.shapes import ConvexMesh, Measured, OccupancyMap, PointCloud, Shape, Sphere


@dataclass(frozen=True, eq=False)
class SceneObject(Checked):
    """A named shape at a pose."""

    name: Name  # unique in its scene, e.g. "dagger_door_left/panel"
    shape: Shape  # the geometry, in the object frame
    T_world_object: Pose  # (4, 4) pose of the object frame in the world
    obstacle: bool = True  # False: cameras see it, planners ignore it (e.g. the floor)
    mass: Mass | None = None  # [kg], used only while a hand carries it; None: unknown, taken as 0


@dataclass(frozen=True, eq=False)
class Articulation(Checked):
    """A hinge or a slider that moves some objects of a scene."""

    name: Name  # unique among the scene's articulations, e.g. "dagger_door_left"
    kind: Literal["hinge", "slider"]  # a hinge turns about the axis, a slider moves along it
    T_world_joint: Pose  # (4, 4) pose of the joint frame in the world; its z is the axis
    lower: float  # end of the range, [rad] for a hinge, [m] for a slider
    upper: float  # other end of the range [rad or m]
    value: float  # present value [rad or m]
    moves: tuple[Name, ...]  # names of the objects that move; the scene has their poses at `value`

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
        """Return the motion (4, 4) in the joint frame for a change of the value [rad or m]."""
        return pose((0.0, 0.0, 0.0), change) if self.kind == "hinge" else pose((0.0, 0.0, change))

    def _check_range(self, value: float) -> None:
        """Refuse a value [rad or m] outside the range."""
        if not self.lower <= value <= self.upper:
            unit = "rad" if self.kind == "hinge" else "m"
            raise InvalidInputError(
                f"value {value!r} of {self.kind} {self.name!r} is outside its range "
                f"[{self.lower}, {self.upper}] {unit}"
            )


Share = Annotated[float, Condition(float, {"minimum": 0.0, "maximum": 1.0}, "a share from 0 to 1")]


@dataclass(frozen=True, eq=False)
class Scene(Checked):
    """Named objects and articulations; scenes with the same content are equal."""

    name: Name  # name in results
    objects: tuple[SceneObject, ...]
    """Everything that cameras see, in a fixed order that is part of the content."""
    articulations: tuple[Articulation, ...] = ()
    """Hinges and sliders; at most one of them moves an object."""
    unseen: Share | None = None
    """Share of the arm's reach that no camera saw and that counts as free; None: not a scan."""

    @property
    def notes(self) -> list[str]:
        """Lines on what planning takes as free although nobody has seen it."""
        if self.unseen is None:
            return []
        if self.unseen == 1.0:
            seen = "no camera's pose is known, so that all of the arm's reach"
        elif self.unseen >= 0.005:
            seen = f"{self.unseen:.0%} of the arm's reach"
        else:
            return []
        return [
            f"{self.name}: free only where a camera saw it: {seen} is unseen and counts as free; "
            "cvqmpt scan --unknown shadow --arm-at Q makes obstacles of what bodies hide, "
            "--unknown occupied of all"
        ]

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
                        f"articulation {articulation.name!r} moves {name!r}, which is not an "
                        f"object of {scene}: add the object or correct `moves`"
                    )

    def __repr__(self) -> str:
        few = ", ".join(self.names[:8]) + (", ..." if len(self.objects) > 8 else "")
        joints = f", {len(self.articulations)} hinges and sliders" if self.articulations else ""
        return (
            f"Scene {self.name!r}: {len(self.objects)} objects{joints}\nobjects     {few or 'none'}"
        )

    def __getitem__(self, name: str) -> SceneObject:
        found = {item.name: item for item in self.objects}
        return found[require_choice(f"object of scene {self.name!r}", name, found)]

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
        """Objects that planners must avoid, in order."""
        return tuple(item for item in self.objects if item.obstacle)

    def articulation(self, name: str) -> Articulation:
        """Return the articulation `name`; UnknownChoiceError if there is none."""
        found = {item.name: item for item in self.articulations}
        return found[require_choice(f"articulation of scene {self.name!r}", name, found)]

    def with_objects(self, *objects: SceneObject) -> Scene:
        """Return a scene with these objects added at the end."""
        return replace(self, objects=self.objects + objects)

    def without(self, *names: str) -> Scene:
        """Return a scene without these objects and without articulations that then move nothing."""
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
        """Return a scene with articulation `name` at `value` [rad or m] and its objects moved.

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

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Scene) and self.digest == other.digest)

    def __hash__(self) -> int:
        return int.from_bytes(self.digest[:8])

    @cached_property
    def digest(self) -> bytes:
        """SHA-256 digest (32 bytes) of the content."""
        return digest_of(self)  # made once: problems are compared by their scenes many times


class SceneForm:
    """Form of a scene; in a problem or task file also the path of a file, see `scene_files`."""

    def read(self, value: Any, where: str) -> Scene:
        """Return the scene of a JSON value."""
        if isinstance(value, str):
            raise InvalidInputError(
                f"{where} is {shown(value)}, a file: load the object that contains it from a "
                "file, too"
            )
        return from_plain(Scene, value, where)

    def schema(self, schema_of: Any) -> dict[str, Any]:
        """Return the JSON schema of a scene, or of a path."""
        path = {"type": "string", "description": "JSON file of a scene"}
        return {"anyOf": [schema_of(Scene), path]}


NamedScene = Annotated[Scene, SceneForm()]


@dataclass(frozen=True, eq=False)
class Attachment(Checked):
    """A shape fixed to the robot's end effector."""

    name: Name  # unique among the attachments
    shape: Shape  # the geometry, in the object frame
    # (4, 4) pose of the shape in the frame of the end effector (of its tool, if it has one) [m]
    T_hand_object: Pose
    mass: Mass | None = None  # [kg], for timing and execution; None: unknown, taken as 0
    # end effector that carries it, or the link that has the tool; None: the robot's first
    end_effector: Name | None = None
    # other end effectors that hold it, too: pieces fixed to them may touch it
    also_held_by: tuple[Name, ...] = ()

    @property
    def held_by(self) -> tuple[str | None, ...]:
        """All end effectors that hold it; None: the robot's first."""
        return self.end_effector, *self.also_held_by

    def _check(self) -> None:
        if isinstance(self.shape, OccupancyMap):
            raise InvalidInputError(
                f"attachment {self.name!r} is an occupancy map; give a solid or a point cloud"
            )


log = logging.getLogger("cvqmpt")


def refuse_far_poses(poses: dict[str, np.ndarray], farthest: float = 100.0) -> None:
    """Refuse poses (4, 4), by place in the file, farther than `farthest` [m] from the origin."""
    for where, T in poses.items():
        _refuse_above(farthest, float(np.abs(T[:3, 3]).max()), f"{where} is", "away")


def _refuse_above(most: float, length: float, what: str, how: str) -> None:
    if length > most:
        raise InvalidInputError(
            f"{what} {length:.4g} m {how}, more than {most:g}: not in metres? Give metres; it may "
            "be in mm or cm"
        )


def check_extent(
    scene: Scene,
    reach: float,
    where: str = "scene",
    farthest: float = 100.0,
    largest: float = 250.0,
    thickest: float = 25.0,
) -> None:
    """Refuse obstacles that are too large or too far away; warn if none is in the arm's reach.

    Args:
        scene: the scene.
        reach: radius of a ball around the origin that contains the arm [m].
        where: place of the scene, for errors.
        farthest: largest distance of an obstacle from the origin [m].
        largest: largest length of an obstacle [m]; floors of 200 m occur.
        thickest: largest length of an obstacle in its thinnest direction [m].
    """
    gaps = {item.name: distance(item) for item in scene.obstacles}
    for k, item in enumerate(scene.objects):
        if not item.obstacle:
            continue
        lengths: tuple[float, ...] = ()
        if not isinstance(item.shape, ConvexMesh | Measured):
            lengths = tuple(np.ravel([*vars(item.shape).values()]).tolist())
        name = f"{at(where, f'objects[{k}], {item.name!r},')} is"
        _refuse_above(largest, max(lengths, default=0.0), name, "large")
        _refuse_above(thickest, min(lengths, default=0.0), name, "thick")
        _refuse_above(farthest, gaps[item.name], name, "away")
    nearest = min(gaps, key=lambda name: gaps[name], default="")
    if gaps and gaps[nearest] > reach:
        log.warning(
            f"scene {scene.name!r}: no obstacle is in the arm's reach of {reach:.3g} m: the "
            f"nearest, {nearest!r}, is {gaps[nearest]:.3g} m away; not in metres, or not in the "
            "frame of the robot's base?"
        )


def distance(item: SceneObject) -> float:
    """Return an obstacle's distance [m] from the origin: exact for boxes, else a lower bound."""
    shape, T = item.shape, item.T_world_object
    if isinstance(shape, PointCloud):
        return _nearest(shape.points, T, shape.radius)
    if isinstance(shape, OccupancyMap):
        around = 0.5 * math.sqrt(3.0) * shape.resolution + shape.padding
        return _nearest(shape.centres, T, around)
    if isinstance(shape, Sphere):
        return max(math.dist(T[:3, 3], (0.0, 0.0, 0.0)) - shape.radius, 0.0)
    if isinstance(shape, ConvexMesh):
        low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
    else:
        low, high = -shape.half, shape.half
    # the origin in the shape's frame, relative to the box of its corners
    beyond = np.abs(-T[:3, 3] @ T[:3, :3] - 0.5 * (low + high)) - 0.5 * (high - low)
    return float(np.linalg.norm(np.maximum(beyond, 0.0)))


def _nearest(points: np.ndarray, T: np.ndarray, around: float) -> float:
    """Return the least distance [m] of balls of a radius `around` points (m, 3) of frame T."""
    away = np.linalg.norm(points @ T[:3, :3].T + T[:3, 3], axis=1)
    return max(float(away.min()) - around, 0.0)
