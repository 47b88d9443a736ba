"""Read depth images (16-bit PNG or NPY), intrinsics and extrinsics; a capture is their points.

Intrinsics and extrinsics are JSON or YAML files.
"""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.errors import (
    InvalidInputError,
    known_fields,
    located,
    mapping,
    shown,
    whole_number,
)
from cvqmpt_lab.base.files import write_bytes, write_text
from cvqmpt_lab.base.poses import Placement, Pose, PoseForm, rigid, ros_vector
from cvqmpt_lab.base.readers import plain_readers, read_array, read_by_suffix
from cvqmpt_lab.base.values import Array, FloatArray
from cvqmpt_lab.features.scan.depth_forms import refuse_buffer
from cvqmpt_lab.scene.cloud_files import Cloud, check_lengths, read_cloud
from cvqmpt_lab.scene.scene import log, refuse_far_poses
from cvqmpt_lab.sensing.camera import Intrinsics, View

FARTHEST_DEPTH_M = 30.0  # of half of an image in millimetres
NEAREST_DEPTH_M = 0.05  # of half of an image: depth cameras measure from 0.07 m on
NO_DEPTH = 2**16 - 1  # in images of 16 bits, as 0
MAX_PIXELS = 2**24  # of an image; its points then take 400 MB


def read_capture(
    path: Path | str,
    intrinsics: Path | str | None = None,
    extrinsics: Path | str | None = None,
    scale: float | None = None,
) -> Cloud:
    """Read a depth image (with intrinsics) or a cloud (without); errors name the file.

    Args:
        path: depth image or cloud.
        intrinsics: file for `read_intrinsics`; None: `path` is a cloud.
        extrinsics: file for `read_extrinsics`; None: the camera frame is the robot's base frame.
        scale: length of a unit in the file [m]; None: 1 m, for a 16-bit image 1 mm. Extrinsics that
            cannot be metres are taken in this unit, too.
    """
    path = Path(path)
    if intrinsics is None and path.suffix.lower() == ".png":
        raise InvalidInputError(
            f"depth image {path} needs the intrinsics of its camera; give them (json or yaml)"
        )
    T = np.eye(4) if extrinsics is None else read_extrinsics(extrinsics, scale)
    if intrinsics is None:
        cloud = read_cloud(path, 1.0 if scale is None else scale, posed=extrinsics is not None)
        return replace(cloud, T_world_camera=T)
    lens = read_intrinsics(intrinsics)
    pixels = deprojected(read_depth(path, lens, scale), lens).reshape(-1, 3)
    points = pixels[np.isfinite(pixels[:, 2])]
    if len(points) == 0:
        raise InvalidInputError(
            f"depth image {path} has no depth: every pixel is 0, 65535 or not finite"
        )
    middle = float(np.median(points[:, 2]))
    if scale is None and middle > FARTHEST_DEPTH_M and has_millimetres(path):
        raise InvalidInputError(
            f"depth image {path} is {middle:.3g} m deep if its units are 1 mm; give --scale, the "
            "length of a unit (0.0001: 0.1 mm) [m]; if it is a renderer's depth buffer, convert it "
            "to depth"
        )
    if scale is None and middle < NEAREST_DEPTH_M:
        raise InvalidInputError(
            f"half of depth image {path} is nearer than {middle:.3g} m, which no depth camera "
            "measures; give --scale, the length of a unit [m]; if it is a renderer's depth buffer "
            "(reversed: 1 is near), convert it to depth"
        )
    check_lengths(points, f"depth image {path}")
    return Cloud(points, len(pixels) - len(points), T)


def read_depth(path: Path | str, lens: Intrinsics, scale: float | None = None) -> FloatArray:
    """Read depth (height, width) along the camera's axis [m]; NaN: none; errors name the file.

    No depth: 0, values that are not finite, and the largest value of 16 bits, 65535.

    Args:
        path: PNG or NPY file.
        lens: intrinsics of the image.
        scale: length of a unit in the file [m]; None: 1 mm for integers, 1 m for floats, which are
            refused if they are probably the depth buffer of a renderer.
    """
    readers = {".png": _read_png, ".npy": _read_npy}
    image = read_by_suffix(readers, path, "depth image", lens)
    if scale is None and image.dtype.kind == "f":
        with located(f"depth image {path}"):
            refuse_buffer(image)
    unit = (0.001 if image.dtype.kind in "iu" else 1.0) if scale is None else scale
    with np.errstate(over="ignore", invalid="ignore"):
        depth = unit * image.astype(np.float64)
    depth[~(np.isfinite(depth) & (depth > 0.0))] = np.nan
    if image.dtype == np.uint16:
        # many cameras write it where they measured nothing; a ray to it would free unknown space
        depth[image == NO_DEPTH] = np.nan
    return depth


def has_millimetres(path: Path) -> bool:
    """Whether a file that was read is an image of whole numbers, by default in millimetres."""
    if path.suffix.lower() == ".npy":
        image = np.load(path, mmap_mode="r")
        return image.ndim == 2 and image.dtype.kind in "iu"
    return path.suffix.lower() == ".png"


def deprojected(depth: FloatArray, lens: Intrinsics) -> FloatArray:
    """Return points d ((u - cx) / fx, (v - cy) / fy, 1) [m, camera frame] of a depth image d."""
    x, y = lens.axes()
    return np.stack([depth * x, depth * y[:, None], depth], axis=-1)


def write_depth(path: Path | str, depth: FloatArray, scale: float = 0.001) -> None:
    """Write depth (height, width) [m] as a 16-bit PNG, `scale` [m] per unit; 0: no depth."""
    with np.errstate(invalid="ignore"):
        units = np.rint(depth / scale)
    units[~(units < NO_DEPTH)] = 0.0
    from PIL import Image  # imported here: only depth images need it

    stream = io.BytesIO()
    Image.fromarray(units.astype(np.uint16)).save(stream, format="PNG")
    write_bytes(Path(path), stream.getvalue())


def write_view(view: View, folder: Path, name: str) -> tuple[Path, Path, Path]:
    """Write NAME.png, NAME.intrinsics.json and NAME.extrinsics.json; return their paths."""
    ends = ("png", "intrinsics.json", "extrinsics.json")
    image, intrinsics, extrinsics = (folder / f"{name}.{end}" for end in ends)
    write_depth(image, view.depth)
    write_text(intrinsics, json.dumps(to_plain(view.camera.intrinsics), indent=1) + "\n")
    pose = {"T_world_camera": view.camera.T_world_camera.tolist()}
    write_text(extrinsics, json.dumps(pose, indent=1) + "\n")
    return image, intrinsics, extrinsics


def _read_png(data: bytes, lens: Intrinsics) -> np.ndarray:
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        if image.mode not in ("I;16", "I;16B", "I;16L"):
            raise InvalidInputError(
                f"it is a picture of mode {image.mode}, without depth: give a 16-bit depth image"
            )
        _check_size((image.height, image.width), lens)
        if image.width * image.height > MAX_PIXELS:
            raise InvalidInputError(
                f"it has {image.width} x {image.height} pixels, at most {MAX_PIXELS} are read: "
                "give a smaller image, with its intrinsics"
            )
        # PNG compresses at most by a factor of 1100
        if image.width * image.height * 2 > 1100 * len(data):
            raise InvalidInputError(
                "its header has more pixels than the file can contain: truncated?"
            )
        pixels = np.asarray(image, dtype=np.uint16)
    if data.partition(b"IEND\xaeB`\x82")[2]:
        raise InvalidInputError("the file continues after its image; give one image per file")
    return pixels


def _read_npy(data: bytes, lens: Intrinsics) -> np.ndarray:
    image = read_array(data)
    if image.ndim != 2 or image.dtype.kind not in "fui":
        raise InvalidInputError("it has no array (height, width) of numbers")
    _check_size(image.shape, lens)
    return image


def _check_size(shape: tuple[int, ...], lens: Intrinsics) -> None:
    if shape != (lens.height, lens.width):
        raise InvalidInputError(
            f"the image has {shape[1]} x {shape[0]} pixels, the intrinsics are for {lens.width} x "
            f"{lens.height}; give the intrinsics of this image (fx, fy, cx, cy grow with its "
            "size; roi and binning of a camera_info are applied)"
        )


def read_intrinsics(path: Path | str) -> Intrinsics:
    """Read intrinsics: fields of `Intrinsics`, of ROS, OpenCV or Open3D, or K.

    Errors name the file.
    """
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
    # beside the matrix; others, such as a distortion of another name, are refused: they would be
    # left out
    known = (
        *("width", "height", "image_width", "image_height", "camera_matrix", "K", "k"),
        *("intrinsic_matrix", "distortion_coefficients", "D", "d", "roi", "binning_x", "binning_y"),
        *("projection_matrix", "P", "p", "rectification_matrix", "R", "r", "depth_scale"),
        *("header", "camera_name", "distortion_model", "device_name", "serial_number", "fps"),
        *("color_format", "depth_format", "color_mode", "depth_mode", "stream_length_usec"),
        # what the programs of OpenCV write beside the lens
        *("calibration_time", "nframes", "nr_of_frames", "board_width", "board_height", "flags"),
        *("square_size", "marker_size", "avg_reprojection_error", "extrinsic_parameters"),
        *("per_view_reprojection_errors", "image_points", "grid_points", "fisheye_model"),
        *("fix_aspect_ratio", "aspectRatio"),
    )
    known_fields(fields, f"intrinsics with {name}", known)
    # units per metre (Open3D) or metres per unit: both mean millimetres, as a 16-bit image does
    if (depth_scale := fields.get("depth_scale", 1000)) not in (1000, 0.001):
        raise InvalidInputError(
            f"depth_scale is {shown(depth_scale)}, which is not read: remove it, and give --scale, "
            "the length of one unit [m]"
        )
    if fields.get("fisheye_model") or fields.get("distortion_model") in ("equidistant", "fisheye"):
        raise InvalidInputError("it is a fisheye lens; give rectified images and their intrinsics")
    distortion = next(
        (fields[d] for d in ("distortion_coefficients", "D", "d") if d in fields), None
    )
    if distortion is not None and np.any(
        Array((None,)).read(_listed(distortion), "distortion") != 0.0
    ):
        raise InvalidInputError(
            "the lens has distortion (it is not 0); give rectified images and their intrinsics"
        )
    listed = np.ravel(np.asarray(_listed(fields[name]), dtype=object)).tolist()
    K = Array((9,), "numbers, row after row").read(listed, name).reshape(3, 3)
    if name == "intrinsic_matrix" and K[2, 0] != 0.0:
        K = K.T  # Open3D writes K column by column
    # the factors select the entries that must be 0
    if (
        not np.array_equal(K * [[0, 1, 0], [1, 0, 0], [1, 1, 0]], np.zeros((3, 3)))
        or K[2, 2] != 1.0
    ):
        raise InvalidInputError(
            f"{name} is {K.tolist()}; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
        )
    _refuse_other_projection(fields, K, name)
    width, fx, cx = _side(fields, "width", "x", K[0, 0], K[0, 2])
    height, fy, cy = _side(fields, "height", "y", K[1, 1], K[1, 2])
    named = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    changed = (fx, fy, cx, cy) != (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    with located("with its roi and binning" if changed else ""):
        return from_plain(Intrinsics, named)


def _refuse_other_projection(fields: Mapping[str, Any], K: FloatArray, name: str) -> None:
    """Refuse a P that differs from K: a rectified image has the constants of P, a raw one of K."""
    known = (key for key in ("projection_matrix", "P", "p") if fields.get(key) is not None)
    for key in known:
        listed = np.ravel(np.asarray(_listed(fields[key]), dtype=object)).tolist()
        P = Array((12,), "numbers, row after row").read(listed, key).reshape(3, 4)[:, :3]
        # zeros stand for a matrix that is not known
        if P.any() and not np.allclose(P, K, rtol=1e-3, atol=0.1):
            raise InvalidInputError(
                f"{key} is {P.tolist()}, but {name} is {K.tolist()}: a rectified image has the "
                f"first, a raw one the second; leave {key} out, or give width, height, fx, fy, cx, "
                "cy of the rectified image"
            )


def _side(
    fields: Mapping[str, Any], side: str, axis: str, focal: float, centre: float
) -> tuple[Any, float, float]:
    """Return size, focal length and principal point of an image along one of its sides [pixels].

    ROS's message describes the whole sensor; the image is its region of interest, binned.

    Args:
        fields: content of a file of intrinsics.
        side: "width" or "height".
        axis: "x" or "y".
        focal: focal length of the sensor [pixels].
        centre: principal point of the sensor [pixels].
    """
    size = fields.get(f"image_{side}", fields.get(side))
    region = mapping(fields.get("roi") or {}, "roi")
    offset = whole_number(f"roi.{axis}_offset", region.get(f"{axis}_offset", 0))
    part = whole_number(f"roi.{side}", region.get(side, 0))
    binning = whole_number(f"binning_{axis}", fields.get(f"binning_{axis}", 0)) or 1
    if offset == 0 and part == 0 and binning == 1:
        return size, focal, centre
    whole = whole_number(side, size, least=1)
    if offset and not part:
        raise InvalidInputError(f"roi.{axis}_offset is {offset}, but roi.{side} is 0; give both")
    # pixel i of the binned image has its centre at binning (i + 0.5) - 0.5
    return (part or whole) // binning, focal / binning, (centre - offset + 0.5) / binning - 0.5


def read_extrinsics(
    path: Path | str, scale: float | None = None, farthest: float = 100.0
) -> FloatArray:
    """Read T_world_camera (4, 4), alone or as field "T_world_camera"; errors name the file.

    Forms: a 4x4 matrix (a rounded rotation is made orthonormal), {xyz, quaternion}, {xyz, rpy},
    ROS's Transform, TransformStamped, Pose or PoseStamped, or a file of easy_handeye.

    Args:
        path: JSON or YAML file.
        scale: length of a unit of the camera's points [m]; a position beyond `farthest` is taken in
            this unit, with a warning.
        farthest: largest coordinate of the position [m].
    """
    data = _read_settings(path, "extrinsics")
    if isinstance(data, Mapping) and set(data) == {"T_world_camera"}:
        data = data["T_world_camera"]
    with located(f"extrinsics {path}"):
        T = from_plain(Pose, _rigid(data), "T_world_camera")
        away = float(np.abs(T[:3, 3]).max())
        if scale is not None and away > farthest >= scale * away:
            T = rigid(T[:3, :3], scale * T[:3, 3])
            log.warning(
                f"extrinsics {path}: a camera {away:.4g} m away cannot be meant; its position is "
                f"taken in the unit of the scale, {scale:g} m: {scale * away:.3g} m away"
            )
        refuse_far_poses({"its camera": T}, farthest)
    return T


def has_bare_quaternion(path: Path | str) -> bool:
    """Whether a file for `read_extrinsics` has a quaternion as four numbers without names."""
    data = _read_settings(path, "extrinsics")
    if isinstance(data, Mapping):
        data = data.get("T_world_camera", data)
    return isinstance(data, Mapping) and isinstance(data.get("quaternion"), Sequence)


def _rigid(data: Any) -> Any:
    """Return a pose in one of the forms of `read_extrinsics` as a value that `Pose` reads."""
    if isinstance(data, Mapping):
        if {"rows", "cols", "data"} <= data.keys():
            entries = Array((16,), "numbers, row after row").read(data["data"], "T_world_camera")
            return _rigid(entries.reshape(4, 4).tolist())
        return _of_message(data)
    T = np.array(PoseForm.matrix.read(data, "T_world_camera"))
    R = T[:3, :3]
    # entries that were written with three decimals
    rounded = np.abs(R).max() < 2.0 and np.abs(R @ R.T - np.eye(3)).max() <= 1e-3
    if rounded and np.linalg.det(R) > 0.0:
        from scipy.spatial.transform import Rotation  # takes 0.3 s to import

        T[:3, :3] = Rotation.from_matrix(R).as_matrix()
    return T


def _of_message(data: Mapping[str, Any]) -> Any:
    """Return a pose in a mapping of one of the forms of `read_extrinsics`."""
    settings = data.get("parameters")
    if isinstance(settings, Mapping):
        kind = settings.get("calibration_type")
        if settings.get("eye_on_hand") is True or kind == "eye_in_hand":
            raise InvalidInputError(
                "it is the pose of a camera in the hand's frame; give the pose in the robot's base "
                "frame: the hand's pose during the capture times this one"
            )
    # stamped messages, and files of easy_handeye and easy_handeye2, hold the pose in a field
    for name in ("transform", "pose", "transformation"):
        if isinstance(data.get(name), Mapping):
            data = data[name]
    names = set(data)
    for position, turn in (("translation", "rotation"), ("position", "orientation")):
        if position in names:
            # a rotation in another form, or a unit, would be left out
            known_fields(data, "the pose", (position, turn, "header", "frame_id", "child_frame_id"))
            if turn not in names:
                raise InvalidInputError(
                    f"it has {position!r} without {turn!r}; give the quaternion x, y, z, w"
                )
            data = {"xyz": ros_vector(data[position]), "quaternion": ros_vector(data[turn])}
            return from_plain(Placement, data, "T_world_camera").matrix
    if names == {"x", "y", "z", "qx", "qy", "qz", "qw"}:
        data = {"xyz": [data[k] for k in "xyz"], "quaternion": [data[f"q{k}"] for k in "xyzw"]}
    elif not names & {"xyz", "rpy", "quaternion"}:
        raise InvalidInputError(
            f"it has {shown(sorted(map(str, names)))}; give a 4x4 matrix, xyz with quaternion or "
            "rpy, ROS's translation and rotation, or position and orientation"
        )
    return data


def _listed(value: Any) -> Any:
    """Return the entries of a matrix; ROS writes {rows, cols, data}."""
    return value.get("data") if isinstance(value, Mapping) else value


def _read_settings(path: Path | str, what: str) -> Any:
    """Return the value in a JSON or YAML file; errors call the file `what`."""
    return read_by_suffix(plain_readers(), path, what, most=2**16)
