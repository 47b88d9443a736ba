"""Intrinsics and extrinsics of depth cameras from small json or yaml files."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.codec import from_plain
from cvqmpt_lab.errors import InvalidInputError, located, mapping
from cvqmpt_lab.files import json_value, yaml_value
from cvqmpt_lab.poses import MATRIX, Placement, Pose
from cvqmpt_lab.scene.cloud_files import read_by_suffix
from cvqmpt_lab.sensing.camera import Intrinsics
from cvqmpt_lab.values import Array, FloatArray


def read_intrinsics(path: Path | str) -> Intrinsics:
    """Read fields of `Intrinsics`, of ROS or Open3D, or a matrix K; errors name the file."""
    data = _read_settings(path, "intrinsics")
    with located(f"intrinsics {path}"):
        return _intrinsics(data)


def _intrinsics(data: Any) -> Intrinsics:
    forms = (
        "width, height, fx, fy, cx, cy, or width, height and camera_matrix (ROS), K or "
        "intrinsic_matrix"
    )
    fields = mapping(data, "", forms)
    name = next(
        (name for name in ("camera_matrix", "K", "k", "intrinsic_matrix") if name in fields), None
    )
    if name is None:
        return from_plain(Intrinsics, fields)
    distortion = next(
        (fields[d] for d in ("distortion_coefficients", "D", "d") if d in fields), None
    )
    if distortion is not None and np.any(
        Array((None,)).read(_listed(distortion), "distortion") != 0.0
    ):
        raise InvalidInputError(
            "the lens distorts (distortion is not 0); give rectified images and their intrinsics"
        )
    listed = np.ravel(np.asarray(_listed(fields[name]), dtype=object)).tolist()
    K = Array((9,), "numbers, row after row").read(listed, name).reshape(3, 3)
    if name == "intrinsic_matrix" and K[2, 0] != 0.0:
        K = K.T  # Open3D writes K column by column
    # the product has the entries that must be 0
    if (
        not np.array_equal(K * [[0, 1, 0], [1, 0, 0], [1, 1, 0]], np.zeros((3, 3)))
        or K[2, 2] != 1.0
    ):
        raise InvalidInputError(
            f"{name} is {K.tolist()}; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
        )
    size = {side: fields.get(f"image_{side}", fields.get(side)) for side in ("width", "height")}
    return from_plain(
        Intrinsics, {**size, "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    )


def read_extrinsics(path: Path | str) -> FloatArray:
    """Read T_world_camera (4, 4), alone or under the key "T_world_camera"; errors name the file.

    Forms: a 4x4 matrix (a rounded rotation is made orthonormal), {xyz, quaternion}, {xyz, rpy}, or
    ROS's {translation, rotation}.
    """
    data = _read_settings(path, "extrinsics")
    if isinstance(data, Mapping) and set(data) == {"T_world_camera"}:
        data = data["T_world_camera"]
    with located(f"extrinsics {path}"):
        return from_plain(Pose, _rigid(data), "T_world_camera")


def _rigid(data: Any) -> Any:
    """A pose in any form of `read_extrinsics`, as a value that `Pose` reads."""
    if isinstance(data, Mapping):
        if "translation" not in data:
            return data
        # ROS writes vectors as {x, y, z} and quaternions as {x, y, z, w}
        named = {"xyz": data["translation"], "quaternion": data.get("rotation")}
        for key, axes in (("xyz", "xyz"), ("quaternion", "xyzw")):
            if isinstance(named[key], Mapping):
                named[key] = [named[key].get(axis) for axis in axes]
        return from_plain(Placement, named, "T_world_camera").matrix
    T = np.array(MATRIX.read(data, "T_world_camera"))
    R = T[:3, :3]
    # entries written with three decimals only
    rounded = np.abs(R).max() < 2.0 and np.abs(R @ R.T - np.eye(3)).max() <= 1e-3
    if rounded and np.linalg.det(R) > 0.0:
        from scipy.spatial.transform import Rotation  # takes 0.3 s to import

        T[:3, :3] = Rotation.from_matrix(R).as_matrix()
    return T


def _listed(value: Any) -> Any:
    """The entries of a matrix, which ROS writes as {rows, cols, data}."""
    return value.get("data") if isinstance(value, Mapping) else value


def _read_settings(path: Path | str, what: str) -> Any:
    """Plain dicts, lists and numbers of a json or yaml file; `what` names it in errors."""
    parsers: Mapping[str, Callable[[bytes], Any]] = {
        ".json": lambda data: json_value(data.decode("utf-8"), "it"),
        ".yaml": lambda data: yaml_value(data.decode("utf-8")),
        ".yml": lambda data: yaml_value(data.decode("utf-8")),
    }
    return read_by_suffix(parsers, Path(path), what, most=2**16)
