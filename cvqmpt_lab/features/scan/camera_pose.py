"""Say where a camera is and where it looks; find poses that are probably written wrongly."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import rigid
from cvqmpt_lab.base.values import FloatArray
from cvqmpt_lab.features.scan.plane import CAMERA_UP, supporting_plane
from cvqmpt_lab.scene.cloud_files import Cloud
from cvqmpt_lab.sensing.crop import Crop

LEVEL_DEG = 5.0  # cameras that look less than this upwards are taken as level


class Region(NamedTuple):
    """Where the points of a scan are expected."""

    crop: Crop | None
    reach: float  # without a crop: a ball around the robot's base [m]

    @property
    def name(self) -> str:
        """The region in words."""
        return "crop" if self.crop is not None else f"arm's reach of {self.reach:.3g} m"

    def share(self, capture: Cloud, T_world_camera: FloatArray) -> float:
        """Return the share of a capture's points in the region, with the camera at a pose."""
        some = capture.points[:: 1 + len(capture.points) // 5000]
        points = some @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        if self.crop is not None:
            return float(self.crop.contains(points).mean())
        return float((np.linalg.norm(points, axis=1) <= self.reach).mean())


def has_pose(capture: Cloud) -> bool:
    """Whether the camera's pose is known: the identity stands for points in the base frame."""
    return not np.array_equal(capture.T_world_camera, np.eye(4))


def camera_text(capture: Cloud) -> str:
    """Return where the camera of a capture is and where it looks, in words."""
    if not has_pose(capture):
        return "no pose given: the points count as points in the robot's base frame"
    T = capture.T_world_camera
    x, y, z = T[:3, 3]
    place = [f"{abs(z):.2f} m {'above' if z >= 0.0 else 'below'} the base"]
    if abs(x) >= 0.005:
        place.append(f"{abs(x):.2f} m {'in front of' if x > 0.0 else 'behind'} it")
    if abs(y) >= 0.005:
        place.append(f"{abs(y):.2f} m to its {'left' if y > 0.0 else 'right'}")
    depth = float(np.median(capture.points[:, 2]))
    if depth <= 0.0:
        return f"{', '.join(place)}; most points are behind it: z must point forward"
    down = down_deg(T)
    turn = "level" if abs(down) < 0.5 else f"{abs(down):.0f} deg {'down' if down > 0.0 else 'up'}"
    roll = roll_deg(T)
    turn += f", rolled by {roll:.0f} deg," if roll > 10.0 else ""
    target = ", ".join(f"{value + 0.0:.2f}" for value in (T[:3, 3] + depth * T[:3, 2]).round(2))
    return f"{', '.join(place)}, looks {turn} towards ({target})"


def down_deg(T_world_camera: FloatArray) -> float:
    """Return the angle by which a camera looks down [deg]; its axis is z."""
    return float(np.degrees(np.arcsin(np.clip(-T_world_camera[2, 2], -1.0, 1.0))))


def roll_deg(T_world_camera: FloatArray) -> float:
    """Return the angle between a camera's x and the horizontal [deg]; 180: y points up.

    It is 0 where the camera looks down or up by more than 75 deg.
    """
    R = T_world_camera[:3, :3]
    if abs(R[2, 2]) > np.sin(np.radians(75.0)):
        return 0.0
    return float(np.degrees(abs(np.arctan2(R[2, 0], -R[2, 1]))))


def pose_doubts(capture: Cloud, region: Region, quaternion: bool) -> str:
    """Return why the pose of a capture's camera is probably wrong, in words; "": it is not.

    Args:
        capture: points of the camera, with its pose.
        region: where points are expected.
        quaternion: whether a quaternion without names gave the pose.
    """
    if not has_pose(capture):
        return ""
    T = capture.T_world_camera
    down, roll, share = down_deg(T), roll_deg(T), region.share(capture, T)
    outside = f"{1.0 - share:.0%} of its points are outside the {region.name}"
    doubts = []
    if down < -LEVEL_DEG:
        doubts.append(f"it looks {-down:.0f} deg up")
    if T[2, 3] < 0.0:
        doubts.append(f"it is {-T[2, 3]:.2f} m below the base")
    if share < 0.5 and region.crop is not None:
        doubts.append(outside)
    hints = [f"it is rolled by {roll:.0f} deg"] if roll > 20.0 and quaternion else []
    if share < 0.5 and region.crop is None:
        hints.append(outside)
    plane = _largest_plane(capture)
    tilt = 0.0 if plane is None else _tilt_deg(T, plane)
    if plane is not None and tilt > 15.0:
        hints.append(f"the largest plane in it is tilted by {tilt:.0f} deg")
    for cause, other in _other_readings(T, quaternion):
        if plane is not None and tilt > 15.0 and _tilt_deg(other, plane) > 5.0:
            continue
        usual = other[2, 3] >= 0.0 and down_deg(other) > LEVEL_DEG and roll_deg(other) < 10.0
        if usual and region.share(capture, other) > max(0.5, share) and (doubts or hints):
            found = ", ".join((*doubts, *hints))
            return f"{found}; {cause} it looks {down_deg(other):.0f} deg down"
    if not doubts:
        return ""
    order = "the quaternion in the order x, y, z, w, and " if quaternion else ""
    return (
        f"{', '.join(doubts)}: if that is wrong, give {order}the pose of the camera in the base "
        "frame, not its inverse, with z forward and y down"
    )


def _largest_plane(capture: Cloud) -> FloatArray | None:
    """Return the normal (3,) of the largest plane in a capture, in the camera's frame, if any."""
    try:
        plane = supporting_plane(capture.points, CAMERA_UP, np.pi, np.random.default_rng(0))
    except InvalidInputError:
        return None
    return plane.normal


def _tilt_deg(T_world_camera: FloatArray, normal: FloatArray) -> float:
    """Return the angle between a plane with a normal in the camera's frame and the floor [deg]."""
    height = abs(float(T_world_camera[2, :3] @ normal))
    return float(np.degrees(np.arccos(min(height, 1.0))))


def _other_readings(T: FloatArray, quaternion: bool) -> Iterator[tuple[str, FloatArray]]:
    """Yield what a pose (4, 4) may be mistaken for: the cure, and the pose that is meant."""
    if quaternion:
        from scipy.spatial.transform import Rotation  # takes 0.3 s to import

        # numbers a, b, c, d were read as x, y, z, w
        a, b, c, d = Rotation.from_matrix(T[:3, :3]).as_quat()
        R = Rotation.from_quat([b, c, d, a]).as_matrix()
        yield "if its quaternion has w first (w last is read: x, y, z, w),", rigid(R, T[:3, 3])
    back = T[:3, :3].T
    yield "if it is the inverse of the camera's pose,", rigid(back, -back @ T[:3, 3])
