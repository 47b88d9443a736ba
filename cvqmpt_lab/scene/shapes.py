"""Shapes as plain data: boxes, cylinders, spheres, convex meshes and inflated point clouds.

A shape lives in its own frame; `SceneObject` places it in the world. Every shape checks itself when
it is made and can be written to and read from plain JSON dictionaries. Lengths are in [m].
"""

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from numbers import Real
from typing import Any, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError

FloatArray: TypeAlias = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Box:
    """A box centred on its frame, edges along the axes.

    Attributes
    ----------
    size : (3,) tuple of float
        Full edge lengths along x, y, z [m].
    """

    size: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not isinstance(self.size, Iterable) or len(edges := tuple(self.size)) != 3:
            raise InvalidInputError(f"Box size must be three edge lengths [m], got {self.size!r}")
        object.__setattr__(self, "size", tuple(positive_length(edge, "Box size") for edge in edges))


@dataclass(frozen=True)
class Cylinder:
    """A cylinder centred on its frame, axis along z.

    Attributes
    ----------
    radius, height : float
        Radius and full height [m].
    """

    radius: float
    height: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", positive_length(self.radius, "Cylinder radius"))
        object.__setattr__(self, "height", positive_length(self.height, "Cylinder height"))


@dataclass(frozen=True)
class Sphere:
    """A sphere centred on its frame, of the given `radius` [m]."""

    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", positive_length(self.radius, "Sphere radius"))


@dataclass(frozen=True, eq=False)
class ConvexMesh:
    """The convex hull of some points.

    Attributes
    ----------
    vertices : (n, 3) array
        At least four points, not all in one plane [m]; read-only.
    """

    vertices: FloatArray

    def __post_init__(self) -> None:
        vertices = _read_only_points(self.vertices, "ConvexMesh vertices")
        if len(vertices) < 4 or np.linalg.matrix_rank(vertices - vertices.mean(axis=0)) < 3:
            raise InvalidInputError(
                f"ConvexMesh vertices must span a volume: give 4 or more points that are not in one plane, "
                f"got {len(vertices)} points"
            )
        object.__setattr__(self, "vertices", vertices)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ConvexMesh) and np.array_equal(self.vertices, other.vertices)

    def __hash__(self) -> int:
        return hash(self.vertices.tobytes())


@dataclass(frozen=True, eq=False)
class PointCloud:
    """An obstacle made of points, each inflated to a ball.

    Attributes
    ----------
    points : (n, 3) array
        Ball centres [m]; read-only.
    radius : float
        Radius of every ball [m].
    """

    points: FloatArray
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", _read_only_points(self.points, "PointCloud points"))
        object.__setattr__(self, "radius", positive_length(self.radius, "PointCloud radius"))

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, PointCloud)
            and self.radius == other.radius
            and np.array_equal(self.points, other.points)
        )

    def __hash__(self) -> int:
        return hash((self.points.tobytes(), self.radius))


Shape: TypeAlias = Box | Cylinder | Sphere | ConvexMesh | PointCloud

SHAPE_TYPES: Mapping[str, type[Shape]] = {
    "box": Box,
    "cylinder": Cylinder,
    "sphere": Sphere,
    "convex_mesh": ConvexMesh,
    "point_cloud": PointCloud,
}
"""The "type" name of each shape in JSON."""


def shape_vertices(shape: Box | ConvexMesh) -> FloatArray:
    """Return the (n, 3) corner points [m] whose convex hull the shape is, in the shape's frame.

    Raises
    ------
    InvalidInputError
        If the shape is round or a point cloud and therefore has no corners.
    """
    if isinstance(shape, Box):
        return 0.5 * np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * np.array(shape.size)
    if isinstance(shape, ConvexMesh):
        return shape.vertices
    raise InvalidInputError(f"{type(shape).__name__} has no corner points; valid shapes: Box, ConvexMesh")


def bounding_radius(shape: Shape) -> float:
    """Return the radius [m] of the smallest ball around the shape's frame origin that holds the shape."""
    match shape:
        case Box() | ConvexMesh():
            return float(np.linalg.norm(shape_vertices(shape), axis=1).max())
        case Cylinder(radius, height):
            return math.hypot(radius, 0.5 * height)
        case Sphere(radius):
            return radius
        case PointCloud(points, radius):
            return float(np.linalg.norm(points, axis=1).max()) + radius


def shape_to_dict(shape: Shape) -> dict[str, Any]:
    """Return the shape as a dictionary of plain JSON values, with its name under "type"."""
    for name, shape_type in SHAPE_TYPES.items():
        if type(shape) is shape_type:
            values = {field.name: getattr(shape, field.name) for field in fields(shape)}
            return {"type": name} | {
                key: value if isinstance(value, float) else np.asarray(value).tolist()
                for key, value in values.items()
            }
    raise UnknownChoiceError("shape", shape, [choice.__name__ for choice in get_args(Shape)])


def shape_from_dict(data: Any, where: str = "shape") -> Shape:
    """Build a shape from what `shape_to_dict` returned.

    Parameters
    ----------
    data : mapping
        Plain JSON values.
    where : str
        What to call this dictionary in error messages, e.g. "objects[3].shape".

    Raises
    ------
    InvalidInputError
        If a field is missing, unknown or holds an unusable value; the message names it.
    UnknownChoiceError
        If "type" is not a name in `SHAPE_TYPES`.
    """
    if not isinstance(data, Mapping) or "type" not in data:
        raise InvalidInputError(f"{where}: missing field 'type'; valid types: {', '.join(SHAPE_TYPES)}")
    if not isinstance(data["type"], str) or data["type"] not in SHAPE_TYPES:
        raise UnknownChoiceError(f"type in {where}", data["type"], SHAPE_TYPES)
    shape_type = SHAPE_TYPES[data["type"]]
    names = [field.name for field in fields(shape_type)]
    check_fields(data, ["type", *names], where)
    try:
        return shape_type(**{name: data[name] for name in names})
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from error


def check_fields(
    data: Any, required: Iterable[str], where: str, optional: Iterable[str] = ()
) -> Mapping[str, Any]:
    """Return `data` if it is a mapping with all the required fields and no unknown one.

    Raises
    ------
    InvalidInputError
        Naming `where`, the offending field and the valid ones.
    """
    required, optional = list(required), list(optional)
    if not isinstance(data, Mapping):
        raise InvalidInputError(
            f"{where}: expected fields {', '.join(required)}, got a {type(data).__name__} instead"
        )
    for problem, names in (
        ("missing", [name for name in required if name not in data]),
        ("unknown", [name for name in data if name not in (*required, *optional)]),
    ):
        if names:
            valid = ", ".join([*required, *optional])
            raise InvalidInputError(f"{where}: {problem} field {names[0]!r}; valid fields: {valid}")
    return data


def positive_length(value: Any, what: str) -> float:
    """Return `value` as a float if it is a positive finite number; raise `InvalidInputError` otherwise."""
    if finite_number(value, what) <= 0.0:
        raise InvalidInputError(f"{what} must be a positive finite length [m], got {value!r}")
    return float(value)


def finite_number(value: Any, what: str) -> float:
    """Return `value` as a float if it is a finite number; raise `InvalidInputError` otherwise."""
    if not isinstance(value, Real) or isinstance(value, bool) or not math.isfinite(value):
        raise InvalidInputError(f"{what} must be a finite number, got {value!r}")
    return float(value) + 0.0  # + 0.0 turns -0.0 into 0.0


def _read_only_points(values: Any, what: str) -> FloatArray:
    """Return a read-only (n, 3) copy with at least one row, all values finite."""
    try:
        points = np.array(values, dtype=np.float64) + 0.0  # + 0.0 turns -0.0 into 0.0: one form per value
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{what} must be an (n, 3) array of numbers [m]") from error
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InvalidInputError(f"{what} must be an (n, 3) array with n >= 1, got shape {points.shape}")
    if not np.isfinite(points).all():
        raise InvalidInputError(f"{what} must be finite, row {_first_bad_row(points)} is not")
    points.setflags(write=False)
    return points


def _first_bad_row(points: FloatArray) -> int:
    """Return the index of the first row that is not finite."""
    return int(np.argmin(np.isfinite(points).all(axis=1)))
