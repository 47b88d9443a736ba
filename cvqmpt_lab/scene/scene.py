"""A scene: named shapes with poses, and the hinges and sliders that move some of them.

Everything here is frozen data. Changing a scene (opening a door, adding a can) returns a new one.
Poses are 4x4 arrays `T_world_x` that map points of frame x into the world frame, which is the robot
base link frame. Lengths in [m], angles in [rad].
"""

import hashlib
import json
import math
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.errors import CvqmptError, InvalidInputError, UnknownChoiceError
from cvqmpt_lab.scene.shapes import (
    SHAPE_TYPES,
    FloatArray,
    Shape,
    check_fields,
    finite_number,
    shape_from_dict,
    shape_to_dict,
)

ARTICULATION_KINDS = ("hinge", "slider")


def pose(xyz: Iterable[float], yaw: float = 0.0) -> FloatArray:
    """Return the (4, 4) pose at position `xyz` [m], turned by `yaw` [rad] about the vertical."""
    T = np.eye(4)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    T[:2, :2] = [[cosine, -sine], [sine, cosine]]
    T[:3, 3] = tuple(xyz)
    return T


class _EqualByContent:
    """Equality and hash by `to_dict`: the arrays inside make the dataclass's own comparison fail."""

    def to_dict(self) -> dict[str, Any]:
        raise NotImplementedError

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash(_canonical_json(self.to_dict()))


@dataclass(frozen=True, eq=False)
class SceneObject(_EqualByContent):
    """A named shape at a pose.

    Attributes
    ----------
    name : str
        Unique in its scene, e.g. "dagger_door_left/panel".
    shape : Shape
        The geometry, in the object frame.
    T_world_object : (4, 4) array
        Pose of the object frame in the world; read-only.
    obstacle : bool
        False: cameras see it, planners ignore it (the floor).
    """

    name: str
    shape: Shape
    T_world_object: FloatArray
    obstacle: bool = True

    def __post_init__(self) -> None:
        _check_name(self.name, "SceneObject")
        if type(self.shape) not in SHAPE_TYPES.values():
            choices = [shape_type.__name__ for shape_type in SHAPE_TYPES.values()]
            raise UnknownChoiceError(f"shape of object {self.name!r}", self.shape, choices)
        if not isinstance(self.obstacle, bool):
            raise InvalidInputError(
                f"obstacle of object {self.name!r} must be True or False, got {self.obstacle!r}"
            )
        T = _as_pose(self.T_world_object, f"T_world_object of object {self.name!r}")
        object.__setattr__(self, "T_world_object", T)

    def to_dict(self) -> dict[str, Any]:
        """Return the object as plain JSON values."""
        return {
            "name": self.name,
            "shape": shape_to_dict(self.shape),
            "T_world_object": self.T_world_object.tolist(),
            "obstacle": self.obstacle,
        }


@dataclass(frozen=True, eq=False)
class Articulation(_EqualByContent):
    """A hinge or a slider that moves some objects of a scene.

    Attributes
    ----------
    name : str
        Unique among the scene's articulations, e.g. "dagger_door_left".
    kind : str
        "hinge" (turns about the axis) or "slider" (moves along it).
    T_world_joint : (4, 4) array
        Pose of the joint frame in the world, whose z is the axis; read-only.
    lower, upper, value : float
        Range and present value, [rad] for a hinge, [m] for a slider.
    moves : tuple of str
        Names of the objects it moves; the scene stores their poses at `value`.
    """

    name: str
    kind: str
    T_world_joint: FloatArray
    lower: float
    upper: float
    value: float
    moves: tuple[str, ...]

    def __post_init__(self) -> None:
        _check_name(self.name, "Articulation")
        if self.kind not in ARTICULATION_KINDS:
            raise UnknownChoiceError(f"kind of articulation {self.name!r}", self.kind, ARTICULATION_KINDS)
        for field in ("lower", "upper", "value"):
            number = finite_number(getattr(self, field), f"{field} of articulation {self.name!r}")
            object.__setattr__(self, field, number)
        if self.lower > self.upper:
            raise InvalidInputError(
                f"articulation {self.name!r}: lower {self.lower} is above upper {self.upper}"
            )
        self._check_range(self.value)
        object.__setattr__(self, "moves", _as_names(self.moves, f"moves of articulation {self.name!r}"))
        T = _as_pose(self.T_world_joint, f"T_world_joint of articulation {self.name!r}")
        object.__setattr__(self, "T_world_joint", T)

    def displacement(self, value: float) -> FloatArray:
        """Return the (4, 4) world motion that carries the moved objects from `self.value` to `value`.

        Raises
        ------
        InvalidInputError
            If `value` is outside [lower, upper].
        """
        self._check_range(value)
        change = value - self.value
        motion = pose((0.0, 0.0, 0.0), change) if self.kind == "hinge" else pose((0.0, 0.0, change))
        return self.T_world_joint @ motion @ np.linalg.inv(self.T_world_joint)

    def to_dict(self) -> dict[str, Any]:
        """Return the articulation as plain JSON values."""
        return {
            "name": self.name,
            "kind": self.kind,
            "T_world_joint": self.T_world_joint.tolist(),
            "lower": self.lower,
            "upper": self.upper,
            "value": self.value,
            "moves": list(self.moves),
        }

    def _check_range(self, value: float) -> None:
        """Raise `InvalidInputError` unless `value` is in the range."""
        if not self.lower <= value <= self.upper:
            unit = "rad" if self.kind == "hinge" else "m"
            raise InvalidInputError(
                f"value {value!r} of {self.kind} {self.name!r} is outside its range "
                f"[{self.lower}, {self.upper}] {unit}"
            )


@dataclass(frozen=True, eq=False)
class Scene(_EqualByContent):
    """Named objects and articulations; scenes with the same content are equal.

    Attributes
    ----------
    name : str
        What the scene is called in results.
    objects : tuple of SceneObject
        Everything that cameras see, in a fixed order that is part of the content.
    articulations : tuple of Articulation
        Hinges and sliders; each object is moved by one of them at most.
    """

    name: str
    objects: tuple[SceneObject, ...]
    articulations: tuple[Articulation, ...] = ()

    def __post_init__(self) -> None:
        _check_name(self.name, "Scene")
        object.__setattr__(self, "objects", tuple(self.objects))
        object.__setattr__(self, "articulations", tuple(self.articulations))
        names = [item.name for item in self.objects]
        _check_unique(names, f"object in scene {self.name!r}")
        _check_unique([item.name for item in self.articulations], f"articulation in scene {self.name!r}")
        moved = [name for item in self.articulations for name in item.moves]
        _check_unique(moved, f"moved object in the articulations of scene {self.name!r}")
        known = set(names)
        for articulation in self.articulations:
            for name in articulation.moves:
                if name not in known:
                    raise InvalidInputError(
                        f"articulation {articulation.name!r} moves {name!r}, which is no object of "
                        f"scene {self.name!r}: add the object or correct `moves`"
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

    def with_objects(self, *objects: SceneObject) -> "Scene":
        """Return a scene with these objects added at the end."""
        return replace(self, objects=self.objects + objects)

    def without(self, *names: str) -> "Scene":
        """Return a scene without these objects; articulations that then move nothing go too.

        Raises
        ------
        UnknownChoiceError
            If a name is not an object of the scene.
        """
        gone = {self[name].name for name in names}
        kept = (
            replace(item, moves=tuple(name for name in item.moves if name not in gone))
            for item in self.articulations
        )
        return replace(
            self,
            objects=tuple(item for item in self.objects if item.name not in gone),
            articulations=tuple(item for item in kept if item.moves),
        )

    def moved(self, name: str, T_world_object: FloatArray) -> "Scene":
        """Return a scene in which the object called `name` has the (4, 4) pose `T_world_object`."""
        target = self[name]
        return self._with_replaced({target.name: replace(target, T_world_object=T_world_object)})

    def with_joint(self, name: str, value: float) -> "Scene":
        """Return a scene with the articulation `name` at `value` [rad] or [m], its objects re-posed.

        Raises
        ------
        UnknownChoiceError
            If there is no such articulation.
        InvalidInputError
            If `value` is outside its range.
        """
        joint = self.articulation(name)
        motion = joint.displacement(value)
        parts = [self[part] for part in joint.moves]
        scene = self._with_replaced(
            {part.name: replace(part, T_world_object=motion @ part.T_world_object) for part in parts}
        )
        joints = tuple(replace(item, value=value) if item is joint else item for item in self.articulations)
        return replace(scene, articulations=joints)

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return super().__hash__()  # 6 ms for the kitchen, asked for with every problem

    def content_hash(self) -> str:
        """Return the sha256 (64 hex digits) of the scene's JSON with sorted keys."""
        return hashlib.sha256(_canonical_json(self.to_dict()).encode()).hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """Return the scene as plain JSON values; floats survive the round trip exactly."""
        return {
            "name": self.name,
            "objects": [item.to_dict() for item in self.objects],
            "articulations": [item.to_dict() for item in self.articulations],
        }

    @classmethod
    def from_dict(cls, data: Any) -> "Scene":
        """Build a scene from what `to_dict` returned.

        Raises
        ------
        InvalidInputError
            If a field is missing, unknown or unusable; the message names it.
        UnknownChoiceError
            If a shape or articulation kind is unknown.
        """
        check_fields(data, ("name", "objects"), "scene", optional=("articulations",))
        objects = _list_field(data, "objects")
        articulations = _list_field(data, "articulations") if "articulations" in data else []
        return cls(
            name=data["name"],
            objects=tuple(_object_from_dict(item, f"objects[{i}]") for i, item in enumerate(objects)),
            articulations=tuple(
                _articulation_from_dict(item, f"articulations[{i}]") for i, item in enumerate(articulations)
            ),
        )

    def save(self, path: str | Path) -> None:
        """Write the scene as JSON; the file is complete or not there at all."""
        path = Path(path)
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            temporary.write_text(json.dumps(self.to_dict(), allow_nan=False), encoding="utf-8")
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: str | Path) -> "Scene":
        """Read a scene written by `save`.

        Raises
        ------
        InvalidInputError
            If the file cannot be read, is not JSON or has an unusable field; names file and field.
        """
        try:
            return cls.from_dict(json.loads(Path(path).read_text(encoding="utf-8")))
        except (OSError, ValueError, CvqmptError) as error:
            raise InvalidInputError(f"scene file {str(path)!r}: {error}") from error
        except RecursionError as error:
            raise InvalidInputError(f"scene file {str(path)!r}: its json is nested too deeply") from error

    def _with_replaced(self, changed: dict[str, SceneObject]) -> "Scene":
        """Return a scene in which the named objects are exchanged, order kept."""
        return replace(self, objects=tuple(changed.get(item.name, item) for item in self.objects))


def _object_from_dict(data: Any, where: str) -> SceneObject:
    """Build a `SceneObject` from JSON values; errors start with `where`."""
    check_fields(data, ("name", "shape", "T_world_object"), where, optional=("obstacle",))
    values = {**data, "shape": shape_from_dict(data["shape"], f"{where}.shape")}
    with _errors_named(where):
        return SceneObject(**values)


def _articulation_from_dict(data: Any, where: str) -> Articulation:
    """Build an `Articulation` from JSON values; errors start with `where`."""
    check_fields(data, ("name", "kind", "T_world_joint", "lower", "upper", "value", "moves"), where)
    with _errors_named(where):
        return Articulation(**data)


@contextmanager
def _errors_named(where: str) -> Iterator[None]:
    """Put `where` in front of the message of an `InvalidInputError` raised inside."""
    try:
        yield
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from error


def _canonical_json(data: dict[str, Any]) -> str:
    """Return the one JSON text of `data`: sorted keys, no spaces, finite numbers only."""
    return json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _list_field(data: Any, field: str) -> list[Any]:
    """Return the list in `data[field]`."""
    if not isinstance(data[field], list):
        raise InvalidInputError(f"scene: field {field!r} must be a list, got {type(data[field]).__name__}")
    return data[field]


def _check_name(name: Any, what: str) -> None:
    """Raise `InvalidInputError` unless `name` is a non-empty string."""
    if not isinstance(name, str) or not name:
        raise InvalidInputError(f"{what} name must be a non-empty string, got {name!r}")


def _as_names(values: Any, what: str) -> tuple[str, ...]:
    """Return `values` as a tuple if they are several strings."""
    if not isinstance(values, list | tuple) or not all(isinstance(value, str) for value in values):
        raise InvalidInputError(f"{what} must be a list of object names, got {values!r}")
    return tuple(values)


def _check_unique(names: Iterable[str], what: str) -> None:
    """Raise `InvalidInputError` if a name occurs twice."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InvalidInputError(f"{what} {name!r} occurs twice: names must be unique")
        seen.add(name)


def _as_pose(values: Any, what: str) -> FloatArray:
    """Return a read-only (4, 4) copy of a rigid transformation."""
    try:
        T = np.array(values, dtype=np.float64) + 0.0  # + 0.0 turns -0.0 into 0.0: one form per value
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{what} must be a 4x4 array of numbers") from error
    if T.shape != (4, 4):
        raise InvalidInputError(f"{what} must be a 4x4 array, got shape {T.shape}")
    rotation = T[:3, :3]
    if not (
        np.isfinite(T).all()
        and np.array_equal(T[3], (0.0, 0.0, 0.0, 1.0))
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        and np.linalg.det(rotation) > 0.0
    ):
        raise InvalidInputError(
            f"{what} must be a rigid pose (finite, rotation part orthonormal, last row 0 0 0 1), "
            f"got {T.tolist()}"
        )
    T.setflags(write=False)
    return T
