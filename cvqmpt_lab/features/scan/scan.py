"""A scan: captures of depth cameras, merged in the robot's base frame and filtered.

The points become an occupancy map: cells with points and, as an option, cells that no ray crossed.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from cvqmpt_lab.base.codec import Checked
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.values import FloatArray, Length, Padding
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.features.scan.camera_pose import has_pose
from cvqmpt_lab.features.scan.plane import (
    SupportingPlane,
    box_around,
    level_pose,
    on_table,
    supporting_plane,
    table_below,
)
from cvqmpt_lab.features.scan.shadow import in_shadow
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.cells import distinct, map_of_points
from cvqmpt_lab.scene.cloud_files import Cloud
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Measured, OccupancyMap, require_resolution
from cvqmpt_lab.sensing.crop import Crop, voxel_means

MAP_RESOLUTION_M = 0.02  # edge of a map's cells


class Arm(NamedTuple):
    """The robot during the scan."""

    robot: Robot
    q: FloatArray  # (n,) [rad or m]


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanSettings(Checked):
    """Settings of a scan."""

    level: bool = False  # find the camera's pose by levelling the table; needs one capture
    down: float = 40.0  # rough angle by which this camera looks down [deg]
    highest: float = 1.5  # largest height of this camera above the table: the arm's reach [m]
    front: tuple[float, float, float] = (0.3, 0.0, 0.0)  # middle of the table's near edge [m]
    crop: Crop | None = None  # region of the points that stay; None: everywhere
    voxel: Length = 0.01  # edge of the cells in which points are averaged [m]
    robot_margin: Padding = 0.05  # points within this distance of the robot are removed [m]
    neighbours: int = 2  # points with fewer others within three voxels are removed; 0: none
    plane: Literal["keep", "box", "remove"] = "keep"  # use of the supporting plane's points


class Step(NamedTuple):
    """Report of one filter."""

    name: str
    before: int  # number of points before the filter
    after: int  # number of points after it


class Levelled(NamedTuple):
    """Result of levelling a scan."""

    T_world_camera: FloatArray  # (4, 4) pose of the camera [m]
    plane: SupportingPlane  # plane of the table in the camera's frame


@dataclass(frozen=True, eq=False)
class Scan:
    """A cleaned scan."""

    points: FloatArray  # (m, 3) [m, robot base frame]
    dropped: int  # number of pixels or rows without a point
    steps: tuple[Step, ...]  # report of each filter, in order
    captures: tuple[Cloud, ...] = ()  # the captures, with the poses that were used
    levelled: Levelled | None = None  # None: not levelled
    plane: SupportingPlane | None = None  # in the robot's base frame; None: not searched
    table: SceneObject | None = None  # box in place of the plane's points

    def scene(self, shape: Measured | None = None, name: str = "scan") -> Scene:
        """Return a scene of the points, by default as an occupancy map, and the table."""
        boxes = () if self.table is None else (self.table,)
        if shape is None and len(self.points) == 0:
            return Scene(name, boxes)
        shape = map_of_points(self.points, MAP_RESOLUTION_M) if shape is None else shape
        return Scene(name, (SceneObject(name, shape, np.eye(4)), *boxes))


def scan(
    captures: Sequence[Cloud],
    settings: ScanSettings,
    rng: np.random.Generator,
    arm: Arm | None = None,
) -> Scan:
    """Merge captures and filter them by crop, voxels, robot and outliers; level them before.

    Args:
        captures: clouds with the poses of their cameras; one alone if it is to be levelled.
        settings: levelling, filters and use of the supporting plane.
        rng: random numbers of RANSAC.
        arm: the robot during the scan; its points are removed.

    Raises:
        InvalidInputError: no point is left, no supporting plane or table is found, or several
            captures are to be levelled.
    """
    levelled = None
    if settings.level:
        if len(captures) != 1:
            raise InvalidInputError(
                f"{len(captures)} captures cannot be levelled by a table; give the pose of each "
                "camera"
            )
        cloud = captures[0].points
        seen = table_below(cloud, np.radians(settings.down), settings.highest, rng)
        levelled = Levelled(level_pose(cloud, seen, settings.front), seen)
        captures = [replace(captures[0], T_world_camera=levelled.T_world_camera)]
    points = np.concatenate([capture.in_world for capture in captures])
    steps = []
    for name, keep in _filters(settings, arm):
        left = keep(points)
        if len(left) == 0:
            low = points.min(axis=0).round(3).tolist()
            high = points.max(axis=0).round(3).tolist()
            raise InvalidInputError(
                f"nothing of the scan is left after {name}: before, its {len(points)} points were "
                f"between {low} and {high} [m]"
            )
        steps.append(Step(name, len(points), len(left)))
        points = left
    plane = table = None
    if settings.plane != "keep":
        up, tilt = np.array([0.0, 0.0, 1.0]), np.radians(15.0)
        plane = supporting_plane(points, up, tilt, rng)
        flat = on_table(points, plane, max(0.05, 2.0 * settings.voxel))
        table = box_around(points[flat], plane) if settings.plane == "box" else None
        left = points[~flat]
        steps.append(Step("supporting plane", len(points), len(left)))
        points = left
    dropped = sum(capture.dropped for capture in captures)
    return Scan(points, dropped, tuple(steps), tuple(captures), levelled, plane, table)


def refuse_touching(scene: Scene, arm: Arm) -> None:
    """Raise InvalidInputError if the arm is in collision with the scan."""
    pair = CollisionChecker(arm.robot, scene).colliding_pair(arm.q)
    if pair is not None:
        raise InvalidInputError(
            f"the arm is inside the scan: {pair} overlap; remove more points around it (a larger "
            "robot margin), or give the configuration that it really had"
        )


def _filters(
    settings: ScanSettings, arm: Arm | None
) -> Iterator[tuple[str, Callable[[FloatArray], FloatArray]]]:
    """Yield the filters of points (m, 3) [m] with their names, in order."""
    crop = settings.crop
    radius = 3.0 * settings.voxel
    if crop is not None:
        yield "crop", lambda points: points[crop.contains(points)]
    yield "voxels", lambda points: voxel_means(points, settings.voxel)
    if arm is not None:
        yield "robot", lambda points: points[~near_robot(points, *arm, settings.robot_margin)]
    if settings.neighbours > 0:
        yield "outliers", lambda points: points[~outliers(points, radius, settings.neighbours)]


def near_robot(points: FloatArray, robot: Robot, q: FloatArray, margin: float) -> np.ndarray:
    """Return a mask (m,) of points in, on or near the robot.

    A point is near if its signed distance to every face plane of a convex piece is at most
    `margin`; near corners this includes slightly farther points.

    Args:
        points: (m, 3) [m, world].
        robot: the robot.
        q: configuration (n,) [rad or m].
        margin: [m].
    """
    (rotations,), (translations,) = link_poses(
        robot.kinematics, np.ascontiguousarray(q, dtype=float)[None]
    )
    near = np.zeros(len(points), dtype=bool)
    for part, faces in zip(robot.links, _faces(robot), strict=True):
        turn, (middle, radius) = rotations[part.link], part.ball
        away = points - (turn @ middle + translations[part.link])
        close = np.flatnonzero(np.einsum("ij,ij->i", away, away) <= (radius + margin) ** 2)
        local = away[close] @ turn + middle
        # inside a piece n x + d <= 0 for all its planes
        near[close[(local @ faces[:, :3].T + faces[:, 3] <= margin).all(axis=1)]] = True
    return near


def without_arm(captures: Sequence[Cloud], arm: Arm | None, margin: float) -> list[Cloud]:
    """Return captures without the points within a margin [m] of the arm; None: all points."""
    if arm is None:
        return [*captures]
    near = [near_robot(capture.in_world, *arm, margin) for capture in captures]
    return [
        replace(capture, points=capture.points[~its])
        for capture, its in zip(captures, near, strict=True)
    ]


def outliers(points: FloatArray, radius: float, neighbours: int) -> np.ndarray:
    """Return a mask (m,) of points (m, 3) [m] with fewer than `neighbours` others within radius."""
    from scipy.spatial import cKDTree  # takes 0.3 s to import

    distances, _ = cKDTree(points).query(points, k=[neighbours + 1], distance_upper_bound=radius)
    return ~np.isfinite(distances[:, 0])


@lru_cache(maxsize=4)
def _faces(robot: Robot) -> list[FloatArray]:
    """Return planes (f, 4), n x + d <= 0 inside, of each convex piece in its link's frame [m]."""
    from scipy.spatial import ConvexHull

    return [ConvexHull(part.vertices_in_link).equations for part in robot.links]


@dataclass(frozen=True, kw_only=True)
class MapSettings:
    """Settings of an occupancy map."""

    resolution: float = MAP_RESOLUTION_M  # edge of the cells [m]
    padding: float = 0.0  # distance by which cells are inflated [m]
    # cells that no ray crossed: free (as in MoveIt), all occupied, or only those behind a measured
    # point that is not the arm's
    unknown: Literal["free", "shadow", "occupied"] = "free"
    # region of unknown cells: a box with these corners [m, robot base frame]
    lower: tuple[float, float, float] = (-1.2, -1.2, -0.4)
    upper: tuple[float, float, float] = (1.2, 1.2, 1.4)
    robot_margin: float = 0.05  # cells within this distance of the robot are known [m]

    def __post_init__(self) -> None:
        require_resolution(self.resolution)
        if not np.all(np.subtract(self.upper, self.lower) >= self.resolution):
            raise InvalidInputError(
                f"box of a map from {self.lower} to {self.upper} m has no cell of "
                f"{self.resolution:g} m; give a lower corner below the upper one"
            )


def occupancy_map(
    points: FloatArray,
    settings: MapSettings,
    captures: Sequence[Cloud] = (),
    arm: Arm | None = None,
) -> OccupancyMap:
    """Return a map of the cells that contain points and, as an option, of unknown cells.

    Args:
        points: (m, 3) [m, robot base frame].
        settings: settings of the map.
        captures: all captures of the sensors, used if unknown cells are occupied or in shadows:
            cells between a sensor and its points are known.
        arm: the robot during the scan; cells around it, and all that it stands in, are known.

    Raises:
        InvalidInputError: no cell is occupied; unknown cells without captures or without the pose
            of a camera; too many cells.
    """
    if settings.unknown != "free":
        # from a cell's middle to its farthest corner, and 5 mm for the margin of planning
        across = 0.5 * np.sqrt(3.0) * settings.resolution + settings.padding + 0.005
        spared = replace(settings, robot_margin=max(settings.robot_margin, across))
        unknown = _unknown(spared, captures, arm)
        if not all(has_pose(capture) for capture in captures):
            raise InvalidInputError(
                f"unknown cells are to be {settings.unknown}, but a capture has no camera's pose, "
                "so that nobody knows what it saw: give the pose (--extrinsics or --level), or "
                "leave unknown cells free"
            )
        if settings.unknown == "shadow":
            hiding = without_arm(captures, arm, settings.robot_margin)
            unknown = unknown[in_shadow(unknown, hiding, settings.resolution)]
        points = np.concatenate([points, unknown])
    if len(points) == 0:
        raise InvalidInputError("no point is left for a map; crop less, or plan without a map")
    return map_of_points(points, settings.resolution, settings.padding)


def unseen_share(
    captures: Sequence[Cloud],
    reach: float,
    arm: Arm | None = None,
    coarse: float = 0.05,
    shadows: MapSettings | None = None,
) -> float:
    """Return the share of a ball of an arm's reach that no ray crossed; 1.0 without camera poses.

    Args:
        captures: all captures of the sensors.
        reach: radius of the ball around the robot's base [m].
        arm: the robot during the scan; the space inside it is known.
        coarse: edge of the cells that are counted [m].
        shadows: a map whose cells in shadows are occupied: they do not count.
    """
    captures = [capture for capture in captures if has_pose(capture)]
    if not captures:
        return 1.0  # the points are in the base frame, and nobody knows from where they were seen
    edge = max(coarse, reach / 40.0)
    box = (-reach,) * 3, (reach,) * 3
    places = _unknown(MapSettings(resolution=edge, lower=box[0], upper=box[1]), captures, arm)
    places = places[np.linalg.norm(places, axis=1) <= reach]
    if shadows is not None:
        inside = ((places >= shadows.lower) & (places <= shadows.upper)).all(axis=1)
        hiding = without_arm(captures, arm, shadows.robot_margin)
        places = places[~(inside & in_shadow(places, hiding, edge))]
    return min(len(places) * edge**3 / (4.0 / 3.0 * np.pi * reach**3), 1.0)


def _unknown(
    settings: MapSettings, captures: Sequence[Cloud], arm: Arm | None, most: int = 1 << 27
) -> FloatArray:
    """Return centres (k, 3) [m] of cells that no ray crossed, in a box of at most `most` cells."""
    if not captures:
        raise InvalidInputError(
            "unknown space is occupied, but the captures with their cameras' poses are missing"
        )
    first: FloatArray = np.floor(np.divide(settings.lower, settings.resolution))
    across = (np.ceil(np.divide(settings.upper, settings.resolution)) - first).astype(np.int64)
    if across.prod() > most:
        raise InvalidInputError(
            f"box from {settings.lower} to {settings.upper} m has {across.prod():.2g} cells of "
            f"{settings.resolution:g} m, more than {most:.2g}; give a smaller box or larger cells"
        )
    known = np.zeros(across, dtype=bool)
    for capture in captures:
        origin = capture.T_world_camera[:3, 3] / settings.resolution - first
        ends = capture.in_world / settings.resolution - first
        least = np.floor(ends.min(axis=0, initial=0.0)).astype(np.int64)
        ends = distinct(np.floor(ends).astype(np.int64) - least) + least + 0.5  # one ray per cell
        for crossed in _crossed(origin, ends, across):
            known[tuple(crossed.T)] = True
    places = (np.argwhere(~known) + first + 0.5) * settings.resolution
    return places if arm is None else places[~near_robot(places, *arm, settings.robot_margin)]


def _crossed(origin: FloatArray, ends: FloatArray, across: np.ndarray) -> Iterator[np.ndarray]:
    """Yield cells (k, 3) of a unit grid that segments from origin (3,) to ends (r, 3) cross.

    All segments are traversed in parallel, one cell a step (Amanatides and Woo, "A fast voxel
    traversal algorithm", 1987).
    """
    ray = ends - origin
    ray[ray == 0.0] = 1e-12
    sides = np.stack([-origin / ray, (across - origin) / ray])
    enter = np.maximum(sides.min(axis=0).max(axis=1), 0.0)
    leave = np.minimum(sides.max(axis=0).min(axis=1), 1.0)
    through = enter < leave
    ray, enter, leave = ray[through], enter[through], leave[through]
    cell = np.clip(np.floor(origin + enter[:, None] * ray).astype(np.int64), 0, across - 1)
    step = np.where(ray > 0.0, 1, -1)
    border = (cell + (step > 0) - origin) / ray  # ray parameter of the next cell
    while len(cell):
        yield cell
        rows, axis = np.arange(len(cell)), border.argmin(axis=1)
        going = border[rows, axis] < leave
        rows, axis = rows[going], axis[going]
        cell[rows, axis] += step[rows, axis]
        border[rows, axis] += 1.0 / np.abs(ray[rows, axis])
        going[rows] = ((cell[rows] >= 0) & (cell[rows] < across)).all(axis=1)
        cell, border, step, ray, leave = (part[going] for part in (cell, border, step, ray, leave))
