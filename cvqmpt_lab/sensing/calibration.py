"""Where a depth camera stands, from the arm that it sees: no marker, only the current configuration and a rough guess.

Poses around the guess are compared with a picture of depths, in which every sample of the arm's surface is confirmed,
hidden by something nearer, or looked through. The best are sharpened by laying the measured points onto the surface
(`laying`). What the picture says of the result decides whether it is trusted.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.sensing.icp import Surface, arm_surface, laid, small_motions
from cvqmpt_lab.sensing.scan import Arm

# A cloud as its camera saw it, in coarse pixels: which of some surface it confirms, hides, or looks through.
PIXEL = 0.01
"""Edge of a pixel [tangent]: a few measured points in each."""
WIDEST = 0.2
"""Cosine of the angle from the middle of the cloud beyond which points are left out."""
FACING = 0.3
"""Least cosine between a sample's normal and its ray; others lie near outlines, where a pixel shows something else."""
OWN = 0.02
"""[m] samples this much behind others of the same surface in their pixel are hidden by them."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """What a picture says of k samples of a surface that could be seen if nothing hid them."""

    seen: np.ndarray
    """(k,) bool, towards the camera, where it measured something."""
    excess: FloatArray
    """(k,) [m], measured depth over that of the sample; positive where the camera looked through it."""


@dataclass(frozen=True, eq=False)
class DepthPicture:
    """Depths of a cloud around its middle."""

    turn: FloatArray
    """(3, 3), from the camera's frame to one whose z points to the middle of the cloud."""
    first: FloatArray
    """(2,), corner of the picture [tangents]."""
    depth: FloatArray
    """(rows, columns) [m] along rays, median of the points in each pixel; nan where there are none."""

    @classmethod
    def of(cls, points: FloatArray) -> "DepthPicture":
        """The picture of points (m, 3), m >= 1 [m, camera frame], of which some are not at the origin."""
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

    def compare(self, surface: Surface, T_camera_world: np.ndarray) -> Agreement:
        """How samples agree at poses (..., 4, 4) of the world in the camera's frame; arrays are (..., s)."""
        turn = self.turn @ T_camera_world[..., :3, :3]
        shift = T_camera_world[..., :3, 3] @ self.turn.T
        at = np.einsum("...ij,sj->...si", turn, surface.points) + shift[..., None, :]
        outwards = np.einsum("...ij,sj->...si", turn, surface.normals)
        far = np.linalg.norm(at, axis=-1)
        facing = (np.einsum("...i,...i->...", outwards, at) < -FACING * far) & (at[..., 2] > 0.0)
        pixel = np.floor((at[..., :2] / np.where(at[..., 2:] > 0.0, at[..., 2:], 1.0) - self.first) / PIXEL)
        inside = facing & ((pixel >= 0.0) & (pixel < self.depth.shape)).all(axis=-1)
        row, column = (
            np.where(inside[..., None], pixel, 0.0).astype(np.int64).transpose(-1, *range(at.ndim - 1))
        )
        measured = np.where(inside, self.depth[row, column], np.nan)
        return Agreement(inside & np.isfinite(measured), measured - far)

    def in_front(self, surface: Surface, T_camera_world: np.ndarray) -> np.ndarray:
        """Which samples (s,) no other sample hides, at one pose (4, 4)."""
        at = surface.points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        far = np.linalg.norm(at, axis=1)
        ahead = at @ self.turn.T
        tangents = ahead[:, :2] / np.where(ahead[:, 2:] > 0.0, ahead[:, 2:], np.nan)
        place = np.nan_to_num(np.floor((tangents - np.nanmin(tangents, axis=0)) / PIXEL)).astype(np.int64)
        pixel = place[:, 0] * (place[:, 1].max() + 1) + place[:, 1]
        nearest = np.full(pixel.max() + 1, np.inf)
        np.minimum.at(nearest, pixel, far)
        return far <= nearest[pixel] + OWN


SAMPLES = 12_000
"""Of the arm's surface."""
COMPARED = 300
"""Of them with which candidates are compared."""
ROUNDS = ((3000, 1.0, 0.05), (1500, 0.4, 0.03), (1500, 0.15, 0.02))
"""Of the search: candidates, how far they are drawn as a share of how wrong the guess may be, what agrees [m]."""
KEPT = 30
"""Candidates around which those of the next round are drawn."""
SHARPENED = 3
"""Candidates that are laid."""
DIFFERENT = (0.03, 3.0)
"""[m], [deg] between poses that are not the same one twice."""
AGREEING = 0.02
"""[m] between surface and picture, at the end."""
ENOUGH = 60
"""Samples of a link in view, from which on it is judged."""


@dataclass(frozen=True, kw_only=True)
class CalibrationSettings:
    """How far is searched, and what must hold of a result that is trusted."""

    metres: float = 0.1
    """The guess may be this far off, along each axis [m]."""
    degrees: float = 10.0
    """And turned by this much, about each axis [deg]."""
    least_confirmed: float = 0.85
    """Share of the arm's surface in view, and not hidden, that must be where it should be."""
    least_of_link: float = 0.6
    """The same of every link of which enough is in view."""
    least_samples: int = 400
    """Samples of the surface that must be confirmed."""
    largest_residual: float = 0.005
    """Root mean square distance of the points on the arm from its surface [m]."""
    largest_doubt: float = 0.007
    """Standard deviation of the camera's position [m], by leaving out one link after the other."""
    least_lead: float = 0.03
    """By which the score must exceed that of any other pose."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Where a camera stands, and why that should be believed."""

    T_world_camera: FloatArray
    """(4, 4) [m]."""
    residual: float
    """Root mean square distance of the points on the arm from its surface [m]."""
    confirmed: float
    """Share of the arm's surface in view, and not hidden, that is where it should be."""
    doubt: float
    """Standard deviation of the camera's position [m], by leaving out one link after the other."""
    moved_metres: float
    """From the guess [m]."""
    moved_degrees: float
    """From the guess [deg]."""
    doubts: tuple[str, ...]
    """Why it is not trusted; empty when it is."""


def calibrate(
    points: FloatArray,
    T_world_guess: FloatArray,
    arm: Arm,
    rng: np.random.Generator,
    settings: CalibrationSettings | None = None,
) -> Calibration:
    """Find the pose of the camera that saw points (m, 3) [m, camera frame, camera at the origin].

    Raises
    ------
    InvalidInputError: no point but the origin.
    """
    if not np.any(points):
        raise InvalidInputError(
            "a camera that saw nothing cannot be calibrated; give the cloud as it was taken"
        )
    settings = settings or CalibrationSettings()
    surface = arm_surface(arm, SAMPLES, rng)
    picture = DepthPicture.of(points)
    starts = _search(picture, surface, T_world_guess, settings, rng)
    fits = [laid(points, surface, T_world_camera, rng) for T_world_camera in starts]
    views = [_look(picture, surface, fit.T_world_camera) for fit in fits]
    best = int(np.argmax([view.score for view in views]))
    rivals = [
        view.score
        for fit, view in zip(fits, views, strict=True)
        if _differ(fit.T_world_camera, fits[best].T_world_camera)
    ]
    moved = np.linalg.inv(T_world_guess) @ fits[best].T_world_camera
    found = Calibration(
        fits[best].T_world_camera,
        fits[best].residual,
        views[best].share,
        fits[best].doubt,
        float(np.linalg.norm(moved[:3, 3])),
        _degrees(moved),
        (),
    )
    doubts = _doubts(found, views[best], max(rivals, default=-1.0), surface, arm, settings)
    return Calibration(**{**vars(found), "doubts": tuple(doubts)})


def _search(
    picture: DepthPicture,
    surface: Surface,
    T_world_guess: FloatArray,
    settings: CalibrationSettings,
    rng: np.random.Generator,
) -> list[FloatArray]:
    """The few different poses of the camera around the guess in which the picture agrees best with the surface."""
    few = surface[rng.permutation(len(surface.points))[:COMPARED]]
    reach = np.repeat([np.radians(settings.degrees), settings.metres], 3)
    kept = T_world_guess[None]
    for count, share, tolerance in ROUNDS:
        motions = small_motions(share * reach * rng.uniform(-1.0, 1.0, (count, 6)))
        poses = np.concatenate([kept, kept[rng.integers(len(kept), size=count)] @ motions])
        score = _score(picture.compare(few, np.linalg.inv(poses)), tolerance)
        kept = poses[np.argsort(-score)[:KEPT]]
    chosen: list[FloatArray] = []
    for T in kept:
        if all(_differ(T, other) for other in chosen):
            chosen.append(T)
    return chosen[:SHARPENED]


def _score(agreement: Agreement, tolerance: float) -> FloatArray:
    """How well samples (..., s) agree: those confirmed less those looked through, each a share of all, (...)."""
    excess = np.where(agreement.seen, agreement.excess, -np.inf)
    through = np.clip(excess / tolerance - 1.0, 0.0, 1.0)
    return (np.exp(-np.square(excess / tolerance)) - through).mean(axis=-1)


class _View(NamedTuple):
    """How picture and surface agree at a pose."""

    confirmed: np.ndarray
    """(s,) bool, samples that are where they should be."""
    through: np.ndarray
    """(s,) bool, samples that the camera looked through."""
    score: float
    """See `_score`."""

    @property
    def share(self) -> float:
        """Of the samples that could be judged, those confirmed."""
        return float(self.confirmed.sum() / max(1, self.confirmed.sum() + self.through.sum()))


def _look(picture: DepthPicture, surface: Surface, T_world_camera: FloatArray) -> _View:
    T_camera_world = np.linalg.inv(T_world_camera)
    agreement = picture.compare(surface, T_camera_world)
    seen = agreement.seen & picture.in_front(surface, T_camera_world)
    excess = np.where(seen, agreement.excess, -np.inf)
    score = float(_score(Agreement(seen, excess), AGREEING))
    return _View(np.abs(excess) <= AGREEING, excess > AGREEING, score)


def _doubts(
    found: Calibration, view: _View, rival: float, surface: Surface, arm: Arm, settings: CalibrationSettings
) -> Iterator[str]:
    """What speaks against a pose."""
    count = int(view.confirmed.sum())
    if count < settings.least_samples:
        yield f"the camera sees too little of the arm: {count} of {len(surface.points)} samples of its surface"
        return
    if found.confirmed < settings.least_confirmed:
        yield (
            f"only {100 * found.confirmed:.0f} % of the arm's surface is where the configuration says; was it this one?"
        )
    names = {part.link: part.name for part in reversed(arm.robot.links)}
    for link in np.unique(surface.link):
        yes, no = (int(mask[surface.link == link].sum()) for mask in (view.confirmed, view.through))
        if yes + no >= ENOUGH and yes < settings.least_of_link * (yes + no):
            yield f"{names[link]} is not where the configuration says"
    if found.residual > settings.largest_residual:
        yield f"points on the arm lie {1e3 * found.residual:.1f} mm from its surface"
    if found.doubt > settings.largest_doubt:
        yield f"what is in view of the arm leaves {1e3 * found.doubt:.0f} mm open"
    if view.score - rival < settings.least_lead:
        yield "another pose fits as well"
    limits = 1.5 * np.sqrt(3.0) * np.array([settings.metres, settings.degrees])
    if found.moved_metres > limits[0] or found.moved_degrees > limits[1]:
        yield f"it is {found.moved_metres:.2f} m and {found.moved_degrees:.0f} deg from the guess"


def _differ(one: FloatArray, other: FloatArray) -> bool:
    way = np.linalg.inv(one) @ other
    return bool(np.linalg.norm(way[:3, 3]) > DIFFERENT[0] or _degrees(way) > DIFFERENT[1])


def _degrees(T: FloatArray) -> float:
    """Angle of a pose's rotation [deg]."""
    return float(np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude()))
