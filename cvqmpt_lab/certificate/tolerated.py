"""How far a frame moves and turns while points of the robot are off by a distance."""

from typing import NamedTuple

import numpy as np

from cvqmpt_lab.constraints.bounds_between import longest_lever
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.robot.robot import Robot


class Lever(NamedTuple):
    """Bounds on a frame while the points of the bodies that it is fixed to are off by d."""

    way: float  # the frame's origin is off by at most way * d
    turn: float  # it is turned by at most turn * d [rad/m]


STILL = Lever(0.0, 0.0)


def levers_of(robot: Robot, region: TaskSpaceRegion) -> Lever:
    """Return the bounds on the displacement of a region: the sum of those of its two frames.

    Args:
        robot: the robot.
        region: the region.
    """
    (base, T_base_w), (link, T_link_e) = region.links(robot)
    origin = (T_link_e @ np.linalg.inv(region.Tw_e))[:3, 3]
    end = lever_of(_corners(robot, link), origin)
    if base == 0:
        return end
    # the origin of the displaced frame, as the base sees it
    most = np.abs(region.bounds[:3]).max(axis=1)
    apart = float(np.linalg.norm(most)) if np.isfinite(most).all() else longest_lever(robot, region)
    other = lever_of(_corners(robot, base), T_base_w[:3, 3], apart)
    return Lever(end.way + other.way, end.turn + other.turn)


def lever_of(corners: np.ndarray, origin: np.ndarray, beyond: float = 0.0) -> Lever:
    """Bound the way and the turn of a rigid body whose corners are off by at most d.

    A turn by t about an axis u moves two corners p, q against each other by 2 sin(t / 2) times
    their distance across u, which is at most 2 d. With W the least width of all corners across an
    axis, 2 sin(t / 2) <= 2 d / W. The convex hull is off by at most d, and a point at a distance r
    from it by at most d (1 + 2 r / W).

    Args:
        corners: (k, 3), k may be 0 [m].
        origin: (3,), the point [m].
        beyond: the point is up to this far away from it [m].
    """
    if len(corners) == 0:
        return Lever(np.inf, np.inf)
    width = least_width(corners)
    apart = _distance(corners, origin) + beyond
    if width <= 0.0:
        return Lever(1.0 if apart == 0.0 else np.inf, np.inf)
    return Lever(1.0 + 2.0 * apart / width, np.pi / width)  # asin(x) <= x pi / 2


def least_width(corners: np.ndarray, directions: int = 720) -> float:
    """Bound the least width of corners (k, 3) across any axis from below [m].

    Any axis has a direction across it in the plane of the two longest principal axes, so that the
    least width in this plane is a bound. Widths are measured every half step of an angle.
    """
    centred = corners - corners.mean(axis=0)
    plane = np.linalg.eigh(centred.T @ centred)[1][:, 1:].T  # eigenvalues ascend
    angles = np.pi / directions * np.arange(directions)
    along = (centred @ plane.T) @ np.stack([np.cos(angles), np.sin(angles)])
    between = np.pi / directions * np.linalg.norm(centred, axis=1).max()
    return float(max(np.ptp(along, axis=0).min() - between, 0.0))


def _corners(robot: Robot, link: int) -> np.ndarray:
    """Return the corners (k, 3) of a link's convex pieces in its frame [m]."""
    pieces = [piece.vertices_in_link for piece in robot.links if piece.link == link]
    return np.concatenate(pieces) if pieces else np.empty((0, 3))


def _distance(corners: np.ndarray, point: np.ndarray) -> float:
    """Bound the distance of a point (3,) from the convex hull of corners (k, 3) from above [m]."""
    from scipy.optimize import nnls  # few certificates need it

    scale = max(float(np.abs(corners - point).max()), 1e-9)
    sides = np.vstack([(corners - point).T / scale, np.full(len(corners), 1e3)])
    shares = nnls(sides, np.array([0.0, 0.0, 0.0, 1e3]))[0]
    nearest = shares @ corners / shares.sum()
    nearest_corner = np.linalg.norm(corners - point, axis=1).min()
    return float(min(np.linalg.norm(nearest - point), nearest_corner))
