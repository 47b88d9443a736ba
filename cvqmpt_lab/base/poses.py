"""Turns of angles, and rigid poses: 4x4 arrays `T_a_b` map points of frame b to a; [m], [rad]."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError, known_fields
from cvqmpt_lab.base.values import FULL_TURN_RAD, MAX_LENGTH_M, Array, FloatArray


def pose(xyz: Iterable[float], yaw: float = 0.0) -> FloatArray:
    """Return the (4, 4) pose at position `xyz` [m], turned by `yaw` [rad] about the vertical."""
    T = np.eye(4)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    T[:2, :2] = [[cosine, -sine], [sine, cosine]]
    T[:3, 3] = tuple(xyz)
    return T


def rigid(R: np.ndarray | list[list[float]], xyz: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
    """Return the (4, 4) pose of a rotation R (3, 3) at position `xyz` [m]."""
    T = pose(xyz)
    T[:3, :3] = R
    return T


def rotation_matrices(vectors: FloatArray) -> FloatArray:
    """Return rotations (k, 3, 3) of rotation vectors (k, 3) [rad], bit for bit as scipy."""
    a, b, c = np.asarray(vectors, dtype=float).reshape(-1, 3).T
    angle = np.sqrt(a * a + b * b + c * c)
    square = angle * angle
    half = 0.5 - square / 48 + square * square / 3840
    # numpy's sine may have another last digit
    sine, cosine = (
        np.array([[math.sin(x), math.cos(x)] for x in (angle / 2).tolist()]).reshape(-1, 2).T
    )
    np.divide(sine, angle, out=half, where=angle > 1e-3)
    R = np.array(_of_quaternion(half * a, half * b, half * c, cosine))
    return np.ascontiguousarray(np.moveaxis(R, -1, 0))


def _of_quaternion(x: Any, y: Any, z: Any, w: Any) -> list[list[Any]]:
    """Return the rotation of a quaternion of length 1, of numbers or arrays."""
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    return [
        [xx - yy - zz + ww, 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), -xx + yy - zz + ww, 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), -xx - yy + zz + ww],
    ]


def rotation_of_rpy(roll: float, pitch: float, yaw: float) -> list[list[float]]:
    """Return Rz(yaw) Ry(pitch) Rx(roll), bit for bit as scipy, whose import takes 0.3 s."""
    a, b, c = (math.sin(angle / 2) for angle in (roll, pitch, yaw))
    p, q, r = (math.cos(angle / 2) for angle in (roll, pitch, yaw))
    # first the quaternion of Ry Rx, then of Rz Ry Rx
    x, y, z, w = q * a, b * p, -b * a, q * p
    return _of_quaternion(r * x - c * y, r * y + c * x, r * z + c * w, r * w - c * z)


def ros_vector(value: Any) -> Any:
    """Return ROS's {x, y, z} or {x, y, z, w} as a list; a value that is no mapping unchanged.

    Other keys, such as angles in place of a quaternion, are refused by name.
    """
    if not isinstance(value, Mapping):
        return value
    known_fields(value, "a vector or quaternion", ("x", "y", "z", "w"))
    return [value[axis] for axis in "xyzw" if axis in value]


@dataclass(frozen=True)
class Placement:
    """A pose given by a position and angles or a quaternion."""

    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)  # position [m]
    # roll, pitch, yaw about fixed x, y, z [rad], as in a URDF
    rpy: tuple[float, float, float] | None = None
    quaternion: tuple[float, float, float, float] | None = None  # x, y, z, w, of length 1

    def __post_init__(self) -> None:
        if self.rpy is not None and self.quaternion is not None:
            raise InvalidInputError("give 'rpy' or 'quaternion', one of the two")
        if (most := max(map(abs, self.rpy or (0.0,)))) > FULL_TURN_RAD:
            raise InvalidInputError(
                f"'rpy' holds {most:g}, more than 2 pi: degrees? Give radians, 90 degrees are "
                "1.5708"
            )
        length = math.hypot(*self.quaternion or (1.0,))
        if abs(length - 1.0) > 1e-3:
            raise InvalidInputError(
                f"quaternion [x, y, z, w] has length {length:.4g}; it must be 1"
            )

    @property
    def matrix(self) -> FloatArray:
        """The pose as a (4, 4) array."""
        T = pose(self.xyz)
        if self.rpy is not None:
            T[:3, :3] = rotation_of_rpy(*self.rpy)
        if self.quaternion is not None:
            x, y, z, w = self.quaternion
            length = math.sqrt(x * x + y * y + z * z + w * w)
            T[:3, :3] = _of_quaternion(x / length, y / length, z / length, w / length)
        return T


def _not_rigid(T: FloatArray) -> str | None:
    """Return why a finite matrix (4, 4) is not a rigid pose (R R^T = 1, det R > 0), or None."""
    # numbers in place of arrays: five times as fast
    *rows, last = T.tolist()
    a, b, c = (row[:3] for row in rows)
    distance = max(abs(row[3]) for row in rows)
    if last != [0.0, 0.0, 0.0, 1.0]:
        return f"last row is {last}, not 0 0 0 1"
    lengths = _dot(a, a), _dot(b, b), _dot(c, c)
    products = _dot(a, b), _dot(b, c), _dot(c, a)
    if not (max(map(abs, products)) <= 1e-6 and all(abs(x - 1.0) <= 1.1e-5 for x in lengths)):
        return "rotation part is not orthonormal"
    if distance > MAX_LENGTH_M:
        return f"position is {distance:.3g} m away, more than {MAX_LENGTH_M:g}; give metres"
    cross = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
    return "rotation part is mirrored" if _dot(a, cross) < 0.0 else None


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the dot product of two vectors of three numbers."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


class PoseForm:
    """Form of a pose: a matrix, or a position with angles or a quaternion."""

    matrix = Array((4, 4), "numbers, or {xyz, rpy} or {xyz, quaternion}")

    def read(self, value: Any, where: str) -> FloatArray:
        """Return a read-only rigid pose (4, 4)."""
        if isinstance(value, Mapping):
            value = from_plain(Placement, value, where).matrix
        T = self.matrix.read(value, where)
        fault = _not_rigid(T)
        if fault is not None:
            raise InvalidInputError(f"{where} is not a rigid pose: its {fault}")
        return T

    def write(self, value: FloatArray) -> Any:
        """Return the position if the rotation is the identity, else the matrix, which is exact."""
        return (
            {"xyz": value[:3, 3].tolist()}
            if np.array_equal(value[:3, :3], np.eye(3))
            else value.tolist()
        )

    def schema(self, schema_of: Any) -> dict[str, Any]:
        """Return the JSON schema of both."""
        return {"anyOf": [schema_of(Placement), self.matrix.schema(schema_of)]}


Pose = Annotated[FloatArray, PoseForm()]


def tilts(matrices: np.ndarray) -> np.ndarray:
    """Return angles (k,) [rad] between z and R z of rotations (k, 3, 3), accurate near 0 and pi.

    The angle of unit vectors a, b is 2 atan2(|a - b|, |a + b|).
    """
    z = np.array([0.0, 0.0, 1.0])
    turned = np.asarray(matrices)[:, :, 2]
    return 2.0 * np.arctan2(np.linalg.norm(z - turned, axis=1), np.linalg.norm(z + turned, axis=1))


def rotation_vectors(matrices: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (k, 3) [rad] of rotations (k, 3, 3); angles are at most pi.

    R gives the matrix 4 q q^T of the unit quaternion q, and the row with the largest diagonal entry
    gives q.
    """
    m = np.asarray(matrices).reshape(-1, 3, 3)
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    square = np.empty((len(m), 4, 4))
    square[:, :3, :3] = m + m.transpose(0, 2, 1)
    diagonal = square.reshape(-1, 16)[:, ::5]  # a view
    diagonal[:, :3] += (1.0 - trace)[:, None]
    diagonal[:, 3] = 1.0 + trace
    for k, i, j in ((0, 2, 1), (1, 0, 2), (2, 1, 0)):
        square[:, k, 3] = square[:, 3, k] = m[:, i, j] - m[:, j, i]
    q = square[np.arange(len(m)), diagonal.argmax(axis=1)]
    q *= np.where(q[:, 3:] < 0.0, -1.0, 1.0)
    sine = np.sqrt((q[:, :3] * q[:, :3]).sum(axis=1, keepdims=True))
    angle = 2.0 * np.arctan2(sine, q[:, 3:])
    return q[:, :3] * np.divide(angle, sine, out=np.zeros_like(sine), where=sine > 0.0)


def nearest_turn(angles: np.ndarray, reference: np.ndarray | float) -> np.ndarray:
    """Return angles moved by whole turns to within half a turn of a reference [rad]."""
    turn = 2.0 * np.pi
    return angles + turn * np.round((reference - angles) / turn)
