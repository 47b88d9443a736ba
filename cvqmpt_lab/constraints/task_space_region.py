"""Task-space regions (Berenson et al. 2011; paper, section IV-A): bounds on the hand's pose."""

from __future__ import annotations  # so `help` shows forms by their names

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np

from cvqmpt_lab.base.codec import Checked
from cvqmpt_lab.base.errors import InvalidInputError, shown
from cvqmpt_lab.base.poses import Pose, rigid, rotation_matrices, rotation_vectors, tilts
from cvqmpt_lab.base.values import (
    FULL_TURN_RAD,
    Angle,
    Condition,
    FloatArray,
    Name,
    frozen,
    numbers,
)
from cvqmpt_lab.robot.robot import Robot

Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
FREE = np.inf
# hand x = world z
UPRIGHT_ROTATION = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
ROWS = (
    *(f"position {axis}" for axis in "xyz"),
    *(f"rotation about {axis}" for axis in "xyz"),
    "tilt",
    "distance",
    "radius",
    "bearing",
)
UNITS = np.array([*["m"] * 3, *["rad"] * 4, "m", "m", "rad"], dtype=object)
ROWS_TEXT = (
    "6 rows [lower, upper]: position x, y, z [m], rotation vector x, y, z [rad]; null = free"
)


def axis_vector(axis: Axis) -> np.ndarray:
    """Return the unit vector (3,) of an axis of a frame."""
    return (-1.0 if axis[0] == "-" else 1.0) * np.eye(3)["xyz".index(axis[-1])]


def nearest_axis(vector: np.ndarray) -> Axis:
    """Return the axis of a frame that is nearest to a vector (3,)."""
    k = int(np.argmax(np.abs(vector)))
    return get_args(Axis)[2 * k + (vector[k] < 0.0)]


def frame_along(point: Vector, direction: Vector | np.ndarray) -> np.ndarray:
    """Return a frame (4, 4) at a point whose z axis points along a direction."""
    if not any(direction):
        raise InvalidInputError("the direction is 0, 0, 0")
    # scaled, so that the squared length is neither 0 nor infinite
    z = np.ldexp(direction, -np.frexp(np.abs(direction).max())[1])
    z /= np.linalg.norm(z)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return rigid(np.stack([x, np.cross(z, x), z], axis=1), point)


class BoundsForm:
    """Json form of six rows of two bounds, null where there is no bound."""

    def read(self, value: Any, where: str) -> FloatArray:
        """Return a read-only array (6, 2) with +-inf where there is no bound."""
        if isinstance(value, list | tuple):
            value = [
                [
                    sign * FREE if bound is None else bound
                    for bound, sign in zip(row, (-1, 1), strict=True)
                ]
                if isinstance(row, list | tuple) and len(row) == 2
                else row
                for row in value
            ]
        Bw = numbers(value, where, ROWS_TEXT)
        if Bw.shape != (6, 2):
            raise InvalidInputError(f"{where} has shape {Bw.shape}; it must be {ROWS_TEXT}")
        for k, (lower, upper) in enumerate(Bw.tolist()):
            if not (lower <= upper and lower < FREE and upper > -FREE):
                raise InvalidInputError(
                    f"{where}[{k}], {ROWS[k]} [{UNITS[k]}], is {shown([lower, upper])}; "
                    f"lower <= upper is needed in {ROWS_TEXT}"
                )
        turns = np.abs(Bw[3:], where=np.isfinite(Bw[3:]), out=np.zeros((3, 2)))
        if (most := turns.max()) > FULL_TURN_RAD:
            raise InvalidInputError(
                f"{where} bounds a rotation by {most:g} rad, more than 2 pi: degrees? 10 degrees "
                "are 0.1745 rad"
            )
        return frozen(Bw)

    def write(self, value: FloatArray) -> list:
        """Return the rows, infinite bounds as null."""
        return [[None if np.isinf(bound) else float(bound) for bound in row] for row in value]

    def schema(self, schema_of: Any) -> dict[str, Any]:
        """Return the JSON schema, whose rows have a title."""
        row = schema_of(tuple[float | None, float | None])
        rows = [{**row, "title": f"{ROWS[k]} [{UNITS[k]}]"} for k in range(6)]
        return {"type": "array", "prefixItems": rows, "minItems": 6, "maxItems": 6}


Bounds = Annotated[FloatArray, BoundsForm()]
Tolerance = Annotated[float, Condition(float, {"minimum": 0.0}, "0 or more")]
Span = tuple[Tolerance, Tolerance | None]  # lower and upper bound; None: no upper bound


@dataclass(frozen=True, eq=False)
class TaskSpaceRegion(Checked):
    """Poses T0_e of a frame e whose displacement x from a frame w lies within bounds.

    lower <= x <= upper, x = (t, Log R, tilt, distance, radius, bearing), with t, R the parts of
    (T0_w)^-1 T0_e (Tw_e)^-1. The tilt is the angle between the z axes of w and of the displaced
    frame, (0, 0, 1) and R z. A bound of 0 becomes rotation about x and y of 0: the same poses, and
    smooth there. The distance is `|t|`; the radius `|(t_x, t_y)|` is that from the z axis of w.
    The bearing is the angle between the z axis of the displaced frame and the line from its origin
    to the origin of w: how far off its axis e sees that point.
    """

    T0_w: Pose  # (4, 4), pose of w in the world
    Tw_e: Pose  # (4, 4), pose of e in w when the displacement is zero
    # (6, 2), lower and upper bounds of position x, y, z [m] and rotation vector x, y, z [rad];
    # +-inf (null in json) leaves an entry free, a rotation entry also when it spans [-pi, pi]
    Bw: Bounds
    # upper bound of the tilt [rad], a cone; None, or pi and more, leaves it free
    tilt: Angle | None = field(default=None, kw_only=True)
    # lower and upper bound of the displaced origin's distance from w's origin [m]; None: free
    distance: Span | None = field(default=None, kw_only=True)
    # lower and upper bound of its distance from the z axis of w [m]; None: free
    radius: Span | None = field(default=None, kw_only=True)
    # upper bound of the bearing [rad]; None, or pi and more, leaves it free
    bearing: Angle | None = field(default=None, kw_only=True)
    # frame e: an end effector or another body frame of the robot; None: its first end effector
    end_effector: Name | None = field(default=None, kw_only=True)

    def _check(self) -> None:
        for name, span in (("distance", self.distance), ("radius", self.radius)):
            if span is not None and span[1] is not None and not 0.0 < span[1] >= span[0]:
                raise InvalidInputError(
                    f"{name} is {shown(list(span))}; it must be [lower, upper] with lower <= upper "
                    "and 0 < upper [m]; null = free; bounds Bw of 0 keep a point"
                )
        if self.bearing == 0.0:
            raise InvalidInputError(
                "bearing is 0, where it is not smooth; give a small angle, such as 0.01 [rad]"
            )
        if self.tilt != 0.0:
            return
        Bw = self.Bw.copy()
        if (Bw[3:5, 0] > 0.0).any() or (Bw[3:5, 1] < 0.0).any():
            raise InvalidInputError(
                "tilt is 0, and Bw[3] or Bw[4], rotation about x or y, leaves out 0: leave out one "
                "of the two"
            )
        Bw[3:5] = 0.0
        object.__setattr__(self, "Bw", frozen(Bw))
        object.__setattr__(self, "tilt", None)

    def links(self, robot: Robot) -> tuple[tuple[int, np.ndarray], tuple[int, np.ndarray]]:
        """Return pose row (0 = the world) and T_link_w (4, 4) of w, and the same of e.

        InvalidInputError or UnknownChoiceError: the robot has no such frames.
        """
        row, T_link_e = robot.frame(self.end_effector)
        if not robot.kinematics.moves[:, row].any():
            raise InvalidInputError(
                f"frame {self.end_effector!r} stands still: none of the planned joints "
                f"({', '.join(robot.joint_names)}) moves it; name another frame"
            )
        return (0, self.T0_w), (row, T_link_e)

    def reference_poses(self, robot: Robot, q: np.ndarray) -> np.ndarray:
        """Return T_world_w (k, 4, 4) at q (k, n) by pinocchio; (1, 4, 4) if w does not move."""
        return self.T0_w[None]

    @cached_property
    def bounds(self) -> np.ndarray:
        """Lower and upper bounds (10, 2) of the displacement x, +-inf where it is free [m, rad]."""
        tilt, bearing = (FREE if it is None else it for it in (self.tilt, self.bearing))
        spans = [
            (lower or -FREE, FREE if upper is None else upper)
            for lower, upper in (self.distance or (0.0, None), self.radius or (0.0, None))
        ]
        return frozen(np.vstack([self.Bw, (-tilt, tilt), *spans, (-bearing, bearing)]))

    @cached_property
    def bounded(self) -> np.ndarray:
        """Which entries of x can be out of bounds, (10,) bool."""
        lower, upper = self.bounds.T
        limit = np.where(UNITS == "m", np.inf, np.pi)
        return frozen((lower > -limit) | (upper < limit))

    @cached_property
    def bounded_rows(self) -> np.ndarray:
        """Indices (m,) of the entries of x that can be out of bounds."""
        return frozen(np.flatnonzero(self.bounded))

    @cached_property
    def Te_w(self) -> np.ndarray:
        """Pose (4, 4) of w in e when the displacement is zero, the inverse of `Tw_e`."""
        return frozen(np.linalg.inv(self.Tw_e))

    @property
    def wide(self) -> np.ndarray:
        """Return which rows (10,) of `bounds` have a positive width; the others fix an entry."""
        return self.bounds[:, 0] < self.bounds[:, 1]

    def inset(self, metres: float, radians: float, share: float = 0.4) -> Self:
        """Return the region with bounds moved inwards; rows of width 0 stay.

        Args:
            metres: by which bounds of position, distance and radius are moved [m].
            radians: by which bounds of rotation, tilt and bearing are moved [rad].
            share: largest share of the width of a row by which its bound is moved.
        """
        lower, upper = self.bounds.T
        width = np.where(np.isinf(lower) | np.isinf(upper), FREE, upper - lower)
        inside = np.minimum(np.where(UNITS == "m", metres, radians), share * width)
        # an angle of pi or more is no bound, and stays
        free = np.where(UNITS == "m", np.inf, np.pi)
        inside_low, inside_high = (np.where(it < free, inside, 0.0) for it in (-lower, upper))
        moved = np.column_stack([lower + inside_low, upper - inside_high])
        tilt, bearing = (
            None if given is None else float(given - inside_high[row])
            for given, row in ((self.tilt, 6), (self.bearing, 9))
        )
        distance, radius = (
            None if given is None else (max(0.0, low), None if given[1] is None else high)
            for given, (low, high) in zip(
                (self.distance, self.radius), moved[7:9].tolist(), strict=True
            )
        )
        return self.changed(
            Bw=frozen(moved[:6]), tilt=tilt, distance=distance, radius=radius, bearing=bearing
        )

    @property
    def drawable(self) -> bool:
        """Whether poses can be drawn in it; in others, projections of configurations end."""
        beside = any(it is not None for it in (self.distance, self.radius, self.bearing))
        return not beside and bool(np.isfinite(self.Bw[:3]).all())

    def poses_or_frame(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw poses as `sample_poses`; copies of T0_w (count, 4, 4) if it is not drawable."""
        if self.drawable:
            return self.sample_poses(rng, count)
        return np.tile(self.T0_w, (count, 1, 1))

    def sample_poses(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw poses T0_w T(x) Tw_e (count, 4, 4), x uniform in the bounds, free rotations in +-pi.

        A rotation vector e turns by t <= pi and tilts by b: with h = hypot(e_x, e_y),
        sin(b / 2) = h sin(t / 2) / t >= h / pi. Candidates are drawn in a box.
        """
        lower, upper = self.Bw.T.copy()
        if any(it is not None for it in (self.distance, self.radius, self.bearing)):
            raise InvalidInputError(
                "cannot sample poses of a distance, radius or bearing: give it as a constraint, "
                "and a region with bounds Bw, such as a pose, beside it"
            )
        if np.isinf(self.Bw[:3]).any():
            raise InvalidInputError(
                "cannot sample poses: the position is unbounded: bound Bw rows 0-2"
            )
        tilt = np.pi if self.tilt is None else min(self.tilt, np.pi)
        most = np.pi * np.array([np.sin(0.5 * tilt), np.sin(0.5 * tilt), 1.0])
        lower[3:], upper[3:] = np.maximum(lower[3:], -most), np.minimum(upper[3:], most)
        x = np.empty((0, 6))
        for _ in range(1000 if (lower <= upper).all() else 0):
            drawn = rng.uniform(lower, upper, (count - len(x), 6))
            # a longer vector stands for another turn
            x = np.concatenate([x, drawn[(drawn[:, 3:] ** 2).sum(axis=1) <= np.pi**2]])
            if tilt < np.pi:
                x = x[tilts(rotation_matrices(x[:, 3:])) <= tilt]
            if len(x) == count:
                break
        else:
            raise InvalidInputError(
                "cannot sample poses of a region: its rotation bounds lie beyond angle pi, or its "
                "tilt"
            )
        T_w_displaced = np.tile(np.eye(4), (count, 1, 1))
        T_w_displaced[:, :3, :3] = rotation_matrices(x[:, 3:])
        T_w_displaced[:, :3, 3] = x[:, :3]
        return self.T0_w @ T_w_displaced @ self.Tw_e


@dataclass(frozen=True, eq=False)
class TaskSpaceRegionChain(TaskSpaceRegion):
    """TSR chain: a region whose frame w is fixed to a link that the robot moves.

    The chain goes from the world through the joints that move `base`, e.g. the hinge of a door, and
    one region to the end effector. The joints are the robot's (see `with_articulated_object`), free
    within their limits. `T0_w` is the pose of w in the base frame: `sample_poses` gives poses in
    the base frame. With another end effector as base, both hands form a closed chain.
    """

    base: Name  # name of a body frame of the robot, e.g. "dagger_door_left/handle_bar"
    # The base stands still while the robot moves; a base that does is refused without it
    fixed: bool = False

    def links(self, robot: Robot) -> tuple[tuple[int, np.ndarray], tuple[int, np.ndarray]]:
        """Return the links of w and e; refuse a base that e does not move against."""
        row, T_link_base = robot.link_of(self.base)
        if row == 0 and not self.fixed:
            raise InvalidInputError(
                f"base {self.base!r} stands still: none of the planned joints "
                f"({', '.join(robot.joint_names)}) moves it. Plan the joints that do, or, if it "
                'does stand still, give "fixed": true beside "base"'
            )
        if row != 0 and self.fixed:
            raise InvalidInputError(
                f'base {self.base!r} is moved by the planned joints: leave out "fixed": true'
            )
        link, T_link_e = robot.frame(self.end_effector)
        moves = robot.kinematics.moves
        if (moves[:, row] == moves[:, link]).all():
            raise InvalidInputError(
                f"base {self.base!r} and end effector {self.end_effector or robot.end_effector!r} "
                "do not move against each other: name another frame, or leave the region out"
            )
        return (row, T_link_base @ self.T0_w), (link, T_link_e)

    def reference_poses(self, robot: Robot, q: np.ndarray) -> np.ndarray:
        """Return T_world_w (k, 4, 4) at configurations q (k, n) by pinocchio."""
        return robot.poses(q, self.base) @ self.T0_w

    def at(self, T_world_base: np.ndarray) -> TaskSpaceRegion:
        """Return the region in the world for a base that stands at a pose (4, 4)."""
        return TaskSpaceRegion(
            T_world_base @ self.T0_w,
            self.Tw_e,
            self.Bw,
            tilt=self.tilt,
            distance=self.distance,
            radius=self.radius,
            bearing=self.bearing,
            end_effector=self.end_effector,
        )


def symmetric_region(
    T0_w: np.ndarray, Tw_e: np.ndarray, bounds: Sequence[float], tilt: float | None = None
) -> TaskSpaceRegion:
    """Return a region whose displacement x lies within symmetric bounds.

    Args:
        T0_w: pose of the frame w in the world (4, 4) [m].
        Tw_e: pose of the end effector in w at zero displacement (4, 4) [m].
        bounds: (6,), entry k of x lies in +-bounds[k] [m, rad].
        tilt: upper bound of the tilt [rad]; None: free.
    """
    Bw = np.array([[-bound, bound] for bound in bounds])
    return TaskSpaceRegion(T0_w, Tw_e, Bw, tilt=tilt)


def upright(tilt: Angle = 0.1, axis: Axis = "x") -> TaskSpaceRegion:
    """Return the region where an axis of the hand points up within a cone.

    Yaw and position are free.

    Args:
        tilt: largest angle between axis and vertical [rad].
        axis: axis of the end-effector frame.
    """
    return symmetric_region(np.eye(4), _standing(axis), [FREE] * 6, tilt)


def upright_box(tilt: Angle = 0.1, axis: Axis = "x") -> TaskSpaceRegion:
    """Return the region where an axis of the hand points up within the box of the paper.

    Yaw and position are free. With R_t the upright orientation, entries 1 and 2 of Log(R_t^T R) lie
    in +-tilt. With the hand's x and 0.1 rad this is the constraint of the published experiment
    code. The axis may lean by up to 1.41 tilt at yaw 0; at yaw pi leaning by 0.64 tilt can be too
    much.

    Args:
        tilt: bound of both entries [rad].
        axis: axis of the end-effector frame.
    """
    T0_w = rigid(UPRIGHT_ROTATION)
    return symmetric_region(T0_w, T0_w.T @ _standing(axis), [FREE] * 4 + [tilt] * 2)


def _standing(axis: Axis) -> np.ndarray:
    """Return a pose (4, 4) of the hand at the origin in which one of its axes points up."""
    # the axis of e is x of the upright orientation, ...
    R = np.roll(np.eye(3), -"xyz".index(axis[-1]), axis=0)
    if axis[0] == "-":
        R = np.diag([-1.0, -1.0, 1.0]) @ R  # ... or opposite to it
    return rigid(UPRIGHT_ROTATION @ R)


def shown_lower(row: int, lower: float) -> float:
    """Return the lower bound of a row of `bounds` as it is shown: rows from 6 are not negative."""
    return max(lower, 0.0) if row >= 6 else lower


def bounds_text(regions: Sequence[TaskSpaceRegion]) -> str:
    """Return bounds in words: "rotation about y -0.1 to 0.1 rad, ..."; ";" between regions."""
    texts = []
    for region in regions:
        bounds = [(row, *region.bounds[row]) for row in region.bounded_rows]
        texts.append(
            ", ".join(
                f"{ROWS[k]} {shown_lower(k, low):g} to {high:g} {UNITS[k]}"
                for k, low, high in bounds
            )
        )
    return "; ".join(texts) or "none"


def displacements(robot: Robot, region: TaskSpaceRegion, states: np.ndarray) -> np.ndarray:
    """Return displacements x (m, 10) of frame e at states (m, n), see `bounds` [m, rad]."""
    poses = robot.poses(states, region.end_effector)
    return displaced(region, poses, region.reference_poses(robot, states))


def displaced(
    region: TaskSpaceRegion, poses: np.ndarray, references: np.ndarray, needed: bool = False
) -> np.ndarray:
    """Return displacements (m, 10): x of T = (T0_w)^-1 T0_e (Tw_e)^-1, see `TaskSpaceRegion`.

    Args:
        region: the region.
        poses: T0_e (m, 4, 4) of frame e [m].
        references: T0_w (1 or m, 4, 4) of the region's frame [m].
        needed: whether tilt, distance, radius and bearing stay nan if none of them is bounded.
    """
    T = np.linalg.inv(references) @ poses @ region.Te_w
    R, t = T[:, :3, :3], T[:, :3, 3]
    x = np.full((len(T), len(ROWS)), np.nan)
    x[:, :3], x[:, 3:6] = t, rotation_vectors(R)
    if needed and not region.bounded[6:].any():
        return x
    radius, axis = np.hypot(t[:, 0], t[:, 1]), R[:, :, 2]
    off_axis = np.linalg.norm(np.cross(t, axis), axis=1)
    x[:, 6], x[:, 7], x[:, 8] = tilts(R), np.hypot(radius, t[:, 2]), radius
    x[:, 9] = np.arctan2(off_axis, -(t * axis).sum(axis=1))
    return x


def excess(region: TaskSpaceRegion, x: np.ndarray) -> np.ndarray:
    """Return max(lower - x, x - upper) of displacements x (m, 10), negative inside; -inf: free."""
    lower, upper = region.bounds.T
    return np.where(region.bounded, np.maximum(lower - x, x - upper), -np.inf)
