"""Camera pose from the arm in its depth image: no marker, only the configuration and a rough guess
of the pose.

Candidates around the guess are compared with the image: each sample of the arm's surface is
confirmed, hidden, or looked through. Point-to-plane ICP refines the best; the image decides whether
the result is trusted.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.sensing.icp import Surface, arm_surface, point_to_plane_icp, small_motions
from cvqmpt_lab.sensing.scan import Arm
from cvqmpt_lab.values import FloatArray

PIXEL = 0.01  # edge of a pixel of the depth picture [tangent]: a few measured points in each
WIDEST = 0.2  # cosine of the angle from the middle of the cloud beyond which points are left out
# least cosine between a sample's normal and its ray; near outlines a pixel shows something else
FACING = 0.3
# [m] samples this much behind others of the same surface in their pixel are hidden by them
OWN = 0.02
SAMPLES = 12_000  # of the arm's surface
COMPARED = 300  # of them with which candidates are compared
ROUNDS = ((3000, 1.0, 0.05), (1500, 0.4, 0.03), (1500, 0.15, 0.02))
"""Of the search:
candidates, how far they are drawn as a share of how wrong the guess may be, what agrees [m].
"""
SURVIVORS = 30  # candidates around which those of the next round are drawn
REFINED = 3  # candidates that ICP refines
DIFFERENT = (0.03, 3.0)  # [m], [deg] between poses that are not the same one twice
AGREEING = 0.02  # [m] between surface and picture, at the end
# that the guess may be off along, and turned about, each axis
GUESS_METRES, GUESS_DEGREES = 0.1, 10.0

# What must hold of a pose that is trusted; shares are of the arm's surface in view and not hidden.
ENOUGH = 60  # samples of a link in view, from which on it is judged
LEAST_CONFIRMED = 0.85  # share that must be where it should be
LEAST_OF_LINK = 0.6  # the same of every link of which enough is in view
LEAST_SAMPLES = 400  # samples of the surface that must be confirmed
LARGEST_RESIDUAL = 0.005  # [m] root mean square distance of the points on the arm from its surface
LARGEST_DEVIATION = 0.007  # [m] of the camera's position, by leaving out one link after the other
LEAST_LEAD = 0.03  # by which the score must exceed that of any other pose


@dataclass(frozen=True, eq=False)
class DepthPicture:
    """Depths of a cloud around its middle."""

    # (3, 3), from the camera's frame to one whose z points to the middle of the cloud
    turn: FloatArray
    first: FloatArray  # (2,), corner of the picture [tangents]
    # (rows, columns) [m] along rays, median of the points in each pixel; nan: none
    depth: FloatArray

    @classmethod
    def of(cls, points: FloatArray) -> "DepthPicture":
        """The picture of points (m, 3), m >= 1 [m, camera frame], of which some are not at the
        origin.
        """
        far = np.linalg.norm(points, axis=1)
        towards = points[far > 0.0] / far[far > 0.0, None]
        middle = towards.mean(axis=0)
        turn = np.linalg.svd(middle[None])[2][[1, 2, 0]]
        turn[2] = middle / np.linalg.norm(middle)
        ahead = towards @ turn.T
        wide = ahead[:, 2] > WIDEST
        tangents, depth = ahead[wide, :2] / ahead[wide, 2:], far[far > 0.0][wide]
        first = tangents.min(axis=0)
        row, column = np.floor((tangents - first) / PIXEL).astype(np.int64).T
        picture = np.full((row.max() + 1, column.max() + 1), np.nan)
        pixel = row * picture.shape[1] + column
        order = np.lexsort((depth, pixel))
        taken, start, count = np.unique(pixel[order], return_index=True, return_counts=True)
        picture.ravel()[taken] = depth[order][start + count // 2]
        return cls(turn, first, picture)

    def excess(self, surface: Surface, T_camera_world: np.ndarray) -> FloatArray:
        """Measured depth over that of samples (..., s) [m], at poses (..., 4, 4) of the world in
        the camera's frame.

        Positive where the camera looked through a sample, -inf where it cannot see it or measured
        nothing.
        """
        turn = self.turn @ T_camera_world[..., :3, :3]
        shift = T_camera_world[..., :3, 3] @ self.turn.T
        at = np.einsum("...ij,sj->...si", turn, surface.points) + shift[..., None, :]
        outwards = np.einsum("...ij,sj->...si", turn, surface.normals)
        far = np.linalg.norm(at, axis=-1)
        facing = (np.einsum("...i,...i->...", outwards, at) < -FACING * far) & (at[..., 2] > 0.0)
        pixel = np.floor(
            (at[..., :2] / np.where(at[..., 2:] > 0.0, at[..., 2:], 1.0) - self.first) / PIXEL
        )
        inside = facing & ((pixel >= 0.0) & (pixel < self.depth.shape)).all(axis=-1)
        row, column = np.moveaxis(np.where(inside[..., None], pixel, 0.0).astype(np.int64), -1, 0)
        measured = np.where(inside, self.depth[row, column], np.nan)
        return np.where(np.isfinite(measured), measured - far, -np.inf)

    def in_front(self, surface: Surface, T_camera_world: np.ndarray) -> np.ndarray:
        """Which samples (s,) no other sample hides, at one pose (4, 4)."""
        at = surface.points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        far = np.linalg.norm(at, axis=1)
        ahead = at @ self.turn.T
        tangents = ahead[:, :2] / np.where(ahead[:, 2:] > 0.0, ahead[:, 2:], np.nan)
        place = np.nan_to_num(np.floor((tangents - np.nanmin(tangents, axis=0)) / PIXEL)).astype(
            np.int64
        )
        pixel = place[:, 0] * (place[:, 1].max() + 1) + place[:, 1]
        nearest = np.full(pixel.max() + 1, np.inf)
        np.minimum.at(nearest, pixel, far)
        return far <= nearest[pixel] + OWN


@dataclass(frozen=True, eq=False)
class Calibration:
    """Where a camera stands, and the evidence for it."""

    T_world_camera: FloatArray  # (4, 4) [m]
    residual: float  # root mean square distance of the points on the arm from its surface [m]
    # share of the arm's surface in view, and not hidden, that is where it should be
    confirmed: float
    deviation: float  # standard deviation of the camera's position [m], by a jackknife over links
    moved_metres: float  # from the guess [m]
    moved_degrees: float  # from the guess [deg]
    doubts: tuple[str, ...]  # why it is not trusted; empty when it is


def calibrate(
    points: FloatArray, T_world_guess: FloatArray, arm: Arm, rng: np.random.Generator
) -> Calibration:
    """Pose of the camera that saw points (m, 3) [m, camera frame];
    InvalidInputError for no point but the origin.
    """
    if not np.any(points):
        raise InvalidInputError(
            "a camera that saw nothing cannot be calibrated; give the cloud as it was taken"
        )
    surface = arm_surface(arm, SAMPLES, rng)
    picture = DepthPicture.of(points)
    starts = _search(picture, surface, T_world_guess, rng)
    fits = [point_to_plane_icp(points, surface, T_world_camera, rng) for T_world_camera in starts]
    views = [_view(picture, surface, fit.T_world_camera) for fit in fits]
    best = int(np.argmax([view.score for view in views]))
    T, residual, deviation = fits[best]
    rivals = [
        view.score for fit, view in zip(fits, views, strict=True) if _differ(fit.T_world_camera, T)
    ]
    moved = np.linalg.inv(T_world_guess) @ T
    distance = float(np.linalg.norm(moved[:3, 3]))
    found = Calibration(T, residual, views[best].share, deviation, distance, _degrees(moved), ())
    doubts = _doubts(found, views[best], max(rivals, default=-1.0), surface, arm)
    return replace(found, doubts=tuple(doubts))


def _search(
    picture: DepthPicture, surface: Surface, T_world_guess: FloatArray, rng: np.random.Generator
) -> list[FloatArray]:
    """The few different poses of the camera around the guess in which the picture agrees best with
    the surface.
    """
    few = surface[rng.permutation(len(surface.points))[:COMPARED]]
    reach = np.repeat([np.radians(GUESS_DEGREES), GUESS_METRES], 3)
    best = T_world_guess[None]
    for count, share, tolerance in ROUNDS:
        motions = small_motions(share * reach * rng.uniform(-1.0, 1.0, (count, 6)))
        poses = np.concatenate([best, best[rng.integers(len(best), size=count)] @ motions])
        score = _score(picture.excess(few, np.linalg.inv(poses)), tolerance)
        best = poses[np.argsort(-score)[:SURVIVORS]]
    chosen: list[FloatArray] = []
    for T in best:
        if all(_differ(T, other) for other in chosen):
            chosen.append(T)
    return chosen[:REFINED]


def _score(excess: FloatArray, tolerance: float) -> FloatArray:
    """How well samples (..., s) agree:
    those confirmed less those looked through, each a share of all, (...).
    """
    through = np.clip(excess / tolerance - 1.0, 0.0, 1.0)
    return (np.exp(-np.square(excess / tolerance)) - through).mean(axis=-1)


class _View(NamedTuple):
    """How picture and surface agree at a pose."""

    confirmed: np.ndarray  # (s,) bool, samples that are where they should be
    through: np.ndarray  # (s,) bool, samples that the camera looked through
    score: float  # see `_score`

    @property
    def share(self) -> float:
        """Of the samples that could be judged, those confirmed."""
        return float(self.confirmed.sum() / max(1, self.confirmed.sum() + self.through.sum()))


def _view(picture: DepthPicture, surface: Surface, T_world_camera: FloatArray) -> _View:
    T_camera_world = np.linalg.inv(T_world_camera)
    in_front = picture.in_front(surface, T_camera_world)
    excess = np.where(in_front, picture.excess(surface, T_camera_world), -np.inf)
    return _View(np.abs(excess) <= AGREEING, excess > AGREEING, float(_score(excess, AGREEING)))


def _doubts(
    found: Calibration, view: _View, rival: float, surface: Surface, arm: Arm
) -> Iterator[str]:
    """What speaks against a pose."""
    count = int(view.confirmed.sum())
    if count < LEAST_SAMPLES:
        yield (
            f"the camera sees too little of the arm: {count} of {len(surface.points)} samples "
            f"of its surface"
        )
        return
    if found.confirmed < LEAST_CONFIRMED:
        yield (
            f"only {100 * found.confirmed:.0f} % of the arm's surface is where the configuration "
            f"says; was it this one?"
        )
    names = {part.link: part.name for part in reversed(arm.robot.links)}
    for link in np.unique(surface.link):
        yes, no = (int(mask[surface.link == link].sum()) for mask in (view.confirmed, view.through))
        if yes + no >= ENOUGH and yes < LEAST_OF_LINK * (yes + no):
            yield f"{names[link]} is not where the configuration says"
    if found.residual > LARGEST_RESIDUAL:
        yield f"points on the arm lie {1e3 * found.residual:.1f} mm from its surface"
    if found.deviation > LARGEST_DEVIATION:
        yield f"what is in view of the arm leaves {1e3 * found.deviation:.0f} mm open"
    if view.score - rival < LEAST_LEAD:
        yield "another pose fits as well"
    limits = 1.5 * np.sqrt(3.0) * np.array([GUESS_METRES, GUESS_DEGREES])
    if found.moved_metres > limits[0] or found.moved_degrees > limits[1]:
        yield f"it is {found.moved_metres:.2f} m and {found.moved_degrees:.0f} deg from the guess"


def _differ(one: FloatArray, other: FloatArray) -> bool:
    way = np.linalg.inv(one) @ other
    return bool(np.linalg.norm(way[:3, 3]) > DIFFERENT[0] or _degrees(way) > DIFFERENT[1])


def _degrees(T: FloatArray) -> float:
    """Angle of a pose's rotation [deg]."""
    return float(np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude()))
