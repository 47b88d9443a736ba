"""What a small json or yaml file says, as plain dicts, lists and numbers."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from cvqmpt_lab.codec.forms import Array, FloatArray, Length, Such
from cvqmpt_lab.codec.plain import Checked, from_plain, located, mapping
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import json_value
from cvqmpt_lab.poses import MATRIX, Placement, Pose
from cvqmpt_lab.scene.cloud_files import file_bytes, kind_of, parsing
from cvqmpt_lab.sensing.camera import Lens

LARGEST = 2**16  # [bytes]; calibrations take one thousand


def read_settings(path: Path | str, what: str) -> Any:
    """Read a json or yaml file, by its suffix; `what` names it in errors.

    Raises
    ------
    UnknownChoiceError: another suffix.
    InvalidInputError: a file that cannot be read or parsed, or is no settings; names it.
    """
    path = Path(path)
    parse = PARSERS[kind_of(path, PARSERS, what)]
    data = file_bytes(path, what)
    with parsing(path, what):
        if len(data) > LARGEST:
            raise InvalidInputError(f"it has {len(data)} bytes; {LARGEST} at most")
        return parse(data.decode("utf-8"))


def _from_json(text: str) -> Any:
    return json_value(text, "it")


FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")


def _from_yaml(text: str) -> Any:
    """Plain values alone: no tags, no aliases (a few of which grow without end), no key twice."""
    import yaml  # planning without scans need not pay for it

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise InvalidInputError("it has an alias (*name); write the value out")
            return super().compose_node(parent, index)

        def construct_mapping(self, node: Any, deep: bool = False) -> dict:
            keys = [self.construct_object(key) for key, _ in node.value]
            twice = next((key for k, key in enumerate(keys) if key in keys[:k]), None)
            if twice is not None:
                raise InvalidInputError(f"key {twice!r} occurs twice")
            return super().construct_mapping(node, deep)

    Loader.add_implicit_resolver(
        "tag:yaml.org,2002:float", FLOAT, list("-+.0123456789")
    )  # 1e-3 is a number too
    return yaml.load(text, Loader)


PARSERS: Mapping[str, Callable[[str], Any]] = {".json": _from_json, ".yaml": _from_yaml, ".yml": _from_yaml}
"""By suffix."""


# A depth camera: how it projects (intrinsics) and where it stands (extrinsics), from files.
ROUNDED = 1e-3
"""How far a rotation matrix in a file may be from orthonormal: three digits were written down."""
FORMS = "width, height, fx, fy, cx, cy, or width, height and camera_matrix (ROS), K or intrinsic_matrix"
MOST_PIXELS = 2**14
"""Of a side of an image."""
Pixels = Annotated[
    int, Such(int, lambda n: 1 <= n <= MOST_PIXELS, f"1 to {MOST_PIXELS} pixels", {"minimum": 1})
]


@dataclass(frozen=True, eq=False)
class Pinhole(Checked):
    """How a camera without distortion projects; pixel (0, 0) is the middle of the upper left one."""

    width: Pixels
    """Of its image [pixels]."""
    height: Pixels
    """Of its image [pixels]."""
    fx: Length
    """Focal length along rows [pixels]."""
    fy: Length
    """Focal length along columns [pixels]."""
    cx: float
    """Column of the principal point [pixels]."""
    cy: float
    """Row of the principal point [pixels]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0.0 <= self.cx < self.width and 0.0 <= self.cy < self.height):
            raise InvalidInputError(
                f"intrinsics: principal point ({self.cx:g}, {self.cy:g}) is outside the image of "
                f"{self.width} x {self.height} pixels; give those of this image's size"
            )

    @classmethod
    def of(cls, lens: Lens) -> "Pinhole":
        """That of virtual cameras."""
        focal = 0.5 * lens.height / lens.extent[1]
        return cls(lens.width, lens.height, focal, focal, 0.5 * (lens.width - 1), 0.5 * (lens.height - 1))


def read_intrinsics(path: Path | str) -> Pinhole:
    """Read a json or yaml file: our own fields, ROS's camera_info, Open3D's, or a matrix K.

    Raises
    ------
    InvalidInputError, UnknownChoiceError: what is wrong, and the file.
    """
    data = read_settings(path, "intrinsics")
    with located(f"intrinsics {path}"):
        return _pinhole(data)


def _pinhole(data: Any) -> Pinhole:
    fields = mapping(data, "", FORMS)
    name = next((name for name in ("camera_matrix", "K", "k", "intrinsic_matrix") if name in fields), None)
    if name is None:
        return from_plain(Pinhole, fields)
    distortion = next((fields[d] for d in ("distortion_coefficients", "D", "d") if d in fields), None)
    if distortion is not None and np.any(Array((None,)).read(_listed(distortion), "distortion") != 0.0):
        raise InvalidInputError("it says that the lens distorts; give rectified images and their intrinsics")
    listed = np.ravel(np.asarray(_listed(fields[name]), dtype=object)).tolist()
    K = Array((9,), "numbers, row after row").read(listed, name).reshape(3, 3)
    if name == "intrinsic_matrix" and K[2, 0] != 0.0:
        K = K.T  # Open3D writes column after column
    if not np.array_equal(K * [[0, 1, 0], [1, 0, 0], [1, 1, 0]], np.zeros((3, 3))) or K[2, 2] != 1.0:
        raise InvalidInputError(f"{name} is {K.tolist()}; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    size = {side: fields.get(f"image_{side}", fields.get(side)) for side in ("width", "height")}
    return from_plain(Pinhole, {**size, "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]})


def _listed(value: Any) -> Any:
    """ROS writes a matrix as {rows, cols, data}."""
    return value.get("data") if isinstance(value, Mapping) else value


def read_extrinsics(path: Path | str) -> FloatArray:
    """Read T_world_camera (4, 4) from a json or yaml file.

    A 4x4 matrix, {xyz, quaternion}, {xyz, rpy}, or ROS's {translation, rotation}, alone or as "T_world_camera".
    A matrix that was rounded is made orthonormal.

    Raises
    ------
    InvalidInputError, UnknownChoiceError: what is wrong, and the file.
    """
    data = read_settings(path, "extrinsics")
    if isinstance(data, Mapping) and set(data) == {"T_world_camera"}:
        data = data["T_world_camera"]
    with located(f"extrinsics {path}"):
        return from_plain(Pose, _rigid(data), "T_world_camera")


def _rigid(data: Any) -> Any:
    """A pose as `Pose` takes it."""
    if isinstance(data, Mapping):
        if "translation" not in data:
            return data
        named = {"xyz": data["translation"], "quaternion": data.get("rotation")}
        ordered = {key: _in_order(value, "xyzw"[: 3 + (key != "xyz")]) for key, value in named.items()}
        return from_plain(Placement, ordered, "T_world_camera").matrix
    T = np.array(MATRIX.read(data, "T_world_camera"))
    turn = T[:3, :3]
    rounded = np.abs(turn).max() < 2.0 and np.abs(turn @ turn.T - np.eye(3)).max() <= ROUNDED
    if rounded and np.linalg.det(turn) > 0.0:
        from scipy.spatial.transform import Rotation  # a third of a second to import

        T[:3, :3] = Rotation.from_matrix(turn).as_matrix()
    return T


def _in_order(value: Any, axes: str) -> Any:
    """ROS writes vectors as {x, y, z} and quaternions as {x, y, z, w}."""
    return [value.get(axis) for axis in axes] if isinstance(value, Mapping) else value
