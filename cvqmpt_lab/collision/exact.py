"""Exact collision checking with coal: convex hulls of the links against the shapes of a scene.

The certificate and the `exact` backend use it. Links against each other are pinocchio's pairs;
links against obstacles are coal's broad phases, one a link and one for the world: ten thousand
obstacles need no pairs.
"""

import threading
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import Any, NamedTuple, Protocol, TypeVar

import coal
import numpy as np
import pinocchio as pin

from cvqmpt_lab.collision.carried import carried_pairs, pairs_of_carried, reach_with
from cvqmpt_lab.collision.motion_bounds import Sweep, ball_around
from cvqmpt_lab.collision.solids import obstacles_within, solids
from cvqmpt_lab.robot.hulls import coal_distance
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.coal_shapes import transform
from cvqmpt_lab.scene.scene import Attachment, Scene

Number = TypeVar("Number", float, np.ndarray)
COAL_ROUNDING_M = 1e-6  # coal stops when a distance d is known to COAL_ROUNDING_M (1 + d)
# inflations of the boxes in broad phases: each reports the obstacles that are closer
BROAD_PHASE_INFLATIONS_M = (1e-3, 1e-2, 0.05, 0.1, 0.25)


@dataclass(frozen=True)
class CollidingPair:
    """Two pieces that overlap or are closest."""

    first: str  # name of a piece of the robot or of what it carries
    second: str  # name of another one, or of an obstacle

    def __str__(self) -> str:
        return f"{self.first} and {self.second}"


class Nearest(NamedTuple):
    """Least distance of all pairs."""

    distance: float  # [m], negative (penetration) in collision; inf without pairs
    pair: CollidingPair | None


class Cleared(NamedTuple):
    """What is proven of links or pairs in hulls of configurations."""

    free: np.ndarray  # (k,) int, numbers of leading links or pairs that are proven to be free
    moved: np.ndarray  # (k,), largest motion of any point of what was checked in each hull [m]
    hits: np.ndarray  # (k,) bool, whether a doubtful configuration collides


class CollisionChecker:
    """Check whether a robot with attachments touches itself or the obstacles of a scene.

    Pieces that do not move relative to each other (a base link and the walls, a hand and its load)
    are no pair. Contact is defined to 1e-5 m only: two checkers agree where a margin is kept. Each
    thread needs its own checker.

    Args:
        robot: the robot.
        scene: obstacles.
        attachments: loads in the hands.
        margin: pieces closer than this count as touching [m].
        clearance: distance to keep from obstacles in addition [m].
    """

    def __init__(
        self,
        robot: Robot,
        scene: Scene,
        attachments: Sequence[Attachment] = (),
        margin: float = 0.0,
        clearance: float = 0.0,
    ) -> None:
        self.robot, self.margin, self._clearance = robot, margin, clearance
        self.outer = margin + clearance  # kept from obstacles [m]
        self._model, self._data = robot.model, robot.model.createData()
        self._geometry = _robot_geometry(robot, attachments)
        self._own_results = pin.GeometryData(self._geometry)
        _forget_guesses(self._own_results)
        for request in self._own_results.collisionRequests:
            request.security_margin = margin
            # else coal calls some pairs free that overlap by half a millimetre
            request.enable_contact = True
        self._own = pin.TreeBroadPhaseManager_DynamicAABBTreeCollisionManager(
            self._model, self._geometry, self._own_results
        )
        # links in order from the base, without it
        phases = list(enumerate(self._own.getBroadPhaseManagers()))[1:]
        links = [(k, phase.getManager(), phase.getCollisionObjects()) for k, phase in phases]
        objects = self._geometry.geometryObjects
        hidden = {piece.name for piece in robot.links if piece.self_only}
        # broad phases of links some of whose pieces are not compared with obstacles
        self._parts: list[coal.DynamicAABBTreeCollisionManager] = []
        if hidden:
            links = [(k, *self._compared(k, manager, items, hidden)) for k, manager, items in links]
        self._links = [link for link in links if link[1].size() > 0]
        self._pieces = [
            item.name
            for k, *_ in self._links
            for item in objects
            if item.parentJoint == k and item.name not in hidden
        ]
        self._moving = [item for *_, items in self._links for item in items]
        self.links = len(self._links)
        balls = np.array([ball_around([item]) for item in objects]).reshape(-1, 4)
        self._balls = np.array([item.parentJoint for item in objects], dtype=int), balls
        pairs = [(p.first, p.second) for p in self._geometry.collisionPairs]
        self._own_pairs = np.array(pairs, dtype=int).reshape(-1, 2).T
        self.pairs = len(pairs)
        self._obstacles = list(obstacles_within(scene, reach_with(robot, attachments) + clearance))
        self.obstacles = len(self._obstacles)  # number of pieces of obstacles
        # broad phases by inflation [m], and the objects whose boxes they use and do not own
        self._worlds: dict[
            float, tuple[coal.DynamicAABBTreeCollisionManager, list[coal.CollisionObject]]
        ] = {}
        self._callback = coal.CollisionCallBackDefault()
        self._request, self._result = self._callback.data.request, self._callback.data.result
        self._request.enable_contact = True
        self._sweep = Sweep(robot, self._geometry, [k for k, *_ in self._links])

    def in_collision(self, q: np.ndarray) -> bool:
        """Whether configuration q (n,) touches anything. About 20 us."""
        if self._touches_itself(q):
            return True
        for part in self._parts:
            part.update()
        return self._near_obstacles(self.outer)

    def in_collision_batch(self, configurations: np.ndarray) -> np.ndarray:
        """Whether each row of configurations (b, n) touches anything, (b,) bool."""
        return np.array([self.in_collision(q) for q in configurations], dtype=bool)

    def clear_of_obstacles(
        self,
        q: np.ndarray,
        hulls: np.ndarray,
        known: np.ndarray,
        least: np.ndarray | float = 0.0,
        doubtful: np.ndarray | bool = False,
    ) -> Cleared:
        """Number of leading links proven to touch no obstacle anywhere in hulls of configurations.

        Links are in order from the base. A link l is free in a hull H if its distance from
        obstacles at q is larger than the margin and the largest motion of its points in H:
        d_l(q) > margin + max_{x on l, q' in H} |x(q') - x(q)|. The first link that is not proven
        may be free, too.

        Args:
            q: (k, n), a configuration in each hull.
            hulls: (k, c, n), corners of convex hulls of configurations.
            known: (k,) int, numbers of leading links known to be free: they are not checked.
            least: (k,) or one for all, distance to prove [m], if it is larger than the checker's
                margin.
            doubtful: (k,) bool or one for all, whether q is checked for collision if a link is not
                proven.
        """
        moved = self._sweep.in_world(q, hulls, known)
        needed = _needed(moved, np.maximum(self.outer, np.reshape(least, (-1, 1))))
        free, hits = known.copy(), np.zeros(len(q), dtype=bool)
        doubtful = np.broadcast_to(doubtful, len(q))
        for k in np.flatnonzero(free < self.links).tolist():
            self._pose(q[k])
            gaps, link = needed[k].tolist(), int(free[k])
            while link < self.links:
                if gaps[link] > BROAD_PHASE_INFLATIONS_M[-1] or self._meets_obstacle(
                    link, gaps[link]
                ):
                    hits[k] = doubtful[k] and self._near_obstacles(self.outer, link)
                    break
                link += 1
            free[k] = link
        return Cleared(free, moved.max(axis=1, initial=0.0), hits)

    def clear_of_itself(
        self,
        q: np.ndarray,
        hulls: np.ndarray,
        known: np.ndarray,
        least: np.ndarray | float = 0.0,
        doubtful: np.ndarray | bool = False,
    ) -> Cleared:
        """Number of leading pairs of the robot's own pieces proven to be free.

        Args:
            q: as in `clear_of_obstacles`.
            hulls: the same.
            known: numbers of pairs known to be free.
            least: the same.
            doubtful: the same.
        """
        free, hits = np.full(len(q), self.pairs), np.zeros(len(q), dtype=bool)
        if self.pairs == 0:
            return Cleared(free, np.zeros(len(q)), hits)
        doubtful = np.broadcast_to(doubtful, len(q))
        poses = self._sweep.poses(q)
        moved, left = self._sweep.between(q, hulls, poses), np.arange(self.pairs) >= known[:, None]
        moved[~left] = 0.0
        needed = _needed(moved, np.maximum(self.margin, np.reshape(least, (-1, 1))))
        near = self._near_pairs(poses, needed) & left
        for k in np.flatnonzero(near.any(axis=1)):
            self._place(q[k])
            for pair in np.flatnonzero(near[k]).tolist():
                if self._own_distance(pair) <= needed[k, pair]:
                    free[k], hits[k] = pair, doubtful[k] and self._touches_itself(q[k])
                    break
        return Cleared(free, moved.max(axis=1), hits)

    def _place(self, q: np.ndarray) -> None:
        """Move all pieces to configuration q (n,), without the broad phases."""
        values = self.robot.kinematics.joint_values(q)
        pin.updateGeometryPlacements(
            self._model, self._data, self._geometry, self._own_results, values
        )

    def _pose(self, q: np.ndarray) -> None:
        """Move all pieces to configuration q (n,), and the broad phases."""
        self._place(q)
        self._own.update()
        for part in self._parts:
            part.update()

    def _compared(self, joint: int, manager: Any, items: Any, hidden: set[str]) -> tuple:
        """Return broad phase and objects of the pieces of a joint that obstacles are compared with.

        Args:
            joint: number of the joint.
            manager: broad phase of all its pieces.
            items: objects of all its pieces.
            hidden: names of pieces that are not compared with obstacles.
        """
        pieces = [it.name for it in self._geometry.geometryObjects if it.parentJoint == joint]
        if not hidden & set(pieces):
            return manager, items
        seen = [item for item, name in zip(items, pieces, strict=True) if name not in hidden]
        part = coal.DynamicAABBTreeCollisionManager()
        part.registerObjects(seen)
        part.setup()
        self._parts.append(part)
        return part, seen

    def moved(self, q: np.ndarray, hull: np.ndarray) -> float:
        """Bound [m] on the motion of any point of the robot from q (n,) in a hull (c, n)."""
        return float(self._sweep.in_world(q[None], hull[None]).max(initial=0.0))

    def _near_pairs(self, poses: np.ndarray, gaps: np.ndarray | float) -> np.ndarray:
        """Return which own pairs have balls that are at most `gaps` apart.

        Args:
            poses: (joints + 1, k, 4, 4) of all frames.
            gaps: (k, pairs), or one for all [m].

        Returns:
            (k, pairs) bool.
        """
        (first, second), (joints, balls) = self._own_pairs, self._balls
        T = poses[joints]
        centres = (T[..., :3, :3] @ balls[:, None, :3, None])[..., 0] + T[..., :3, 3]
        between = centres[first] - centres[second]
        reach = balls[first, 3] + balls[second, 3]
        return np.sqrt(np.einsum("pka,pka->kp", between, between)) - reach <= gaps

    def _own_distance(self, pair: int) -> float:
        """Distance of an own pair [m] where the pieces are placed."""
        return pin.computeDistance(self._geometry, self._own_results, pair).min_distance

    def _touches_itself(self, q: np.ndarray) -> bool:
        """Whether the robot's own pieces touch each other at q (n,)."""
        values = self.robot.kinematics.joint_values(q)
        return bool(pin.computeCollisions(self._model, self._data, self._own, values, True))

    def colliding_pair(self, q: np.ndarray) -> CollidingPair | None:
        """First overlapping pair, or None."""
        values = self.robot.kinematics.joint_values(q)
        pin.computeCollisions(
            self._model, self._data, self._geometry, self._own_results, values, False
        )
        for k, result in enumerate(self._own_results.collisionResults):
            if result.isCollision():
                return self._own_pair(k)
        self._own.update()
        self._request.security_margin = self.outer
        _, objects = self._world(0.0)
        gaps = _box_gaps(self._obstacle_boxes, _boxes(self._moving))
        for j, i in np.argwhere(gaps <= self.outer):
            if coal.collide(self._moving[i], objects[j], self._request, coal.CollisionResult()):
                return CollidingPair(self._pieces[i], self._obstacles[j].name)
        return None

    def contact(self, q: np.ndarray) -> str:
        """Text about the first overlapping pair, and the clearance that it breaks."""
        text = str(self.colliding_pair(q))
        if self._clearance:
            text += f", closer than the clearance of {1e3 * self._clearance:g} mm"
        return text

    def standing_inside(self) -> Nearest:
        """Deepest overlap of a piece of the standing base with an obstacle, which is no pair."""
        nearest, (_, objects) = Nearest(0.0, None), self._world(0.0)
        for item in self._geometry.geometryObjects:
            if item.parentJoint != 0:
                continue
            placed = coal.CollisionObject(item.geometry, transform(item.placement.homogeneous))
            for obstacle, other in zip(self._obstacles, objects, strict=True):
                distance = coal_distance(placed, other)
                if distance < nearest.distance:
                    nearest = Nearest(distance, CollidingPair(item.name, obstacle.name))
        return nearest

    def _own_pair(self, k: int) -> CollidingPair:
        pair, objects = self._geometry.collisionPairs[k], self._geometry.geometryObjects
        return CollidingPair(objects[pair.first].name, objects[pair.second].name)

    def clearance(self, q: np.ndarray) -> float:
        """Smallest distance of all pairs [m]; negative in collision, inf without pairs."""
        return self.nearest(q).distance

    def nearest(self, q: np.ndarray) -> Nearest:
        """Smallest distance of all pairs, and the pair."""
        itself = self.nearest_of_itself(q)
        return min(itself, self.nearest_obstacle(q, itself.distance), key=lambda it: it.distance)

    def nearest_of_itself(self, q: np.ndarray, least: float = np.inf) -> Nearest:
        """Smallest distance of the robot's own pieces, if it is below `least` [m]."""
        nearest = Nearest(least, None)
        near = np.empty(0, dtype=int)
        if self.pairs:
            near = np.flatnonzero(self._near_pairs(self._sweep.poses(q[None]), least))
        self._place(q)
        for k in near.tolist():
            found = self._own_distance(k)
            if found < nearest.distance:
                nearest = Nearest(found, self._own_pair(k))
        return nearest

    def nearest_obstacle(self, q: np.ndarray, least: float = np.inf) -> Nearest:
        """Smallest distance of the robot from an obstacle, if it is below `least` [m].

        Pairs are measured in the order of the gaps between their boxes until a gap is larger than
        the smallest distance so far. Groups of obstacles with larger gaps are left out.
        """
        # coal's broad phases would return the last pair's distance, not the smallest
        nearest = Nearest(least, None)
        self._pose(q)
        margin = _needed(least, 0.0)
        if margin <= BROAD_PHASE_INFLATIONS_M[-1] and not self._near_obstacles(margin):
            return nearest
        moving, (groups, around) = _boxes(self._moving), self._groups
        apart = _box_gaps(around, moving).min(axis=1, initial=np.inf)
        if len(groups) > 1 and nearest.distance == np.inf:
            nearest = self._nearest_in(groups[apart.argmin()], moving, nearest)
        within = np.flatnonzero(apart <= max(nearest.distance, 0.0))
        rows = np.sort(np.concatenate([np.empty(0, dtype=int), *(groups[k] for k in within)]))
        return self._nearest_in(rows, moving, nearest)

    def _nearest_in(self, rows: np.ndarray, moving: np.ndarray, nearest: Nearest) -> Nearest:
        """Smaller one of the nearest distance so far and that to some obstacles.

        Args:
            rows: numbers of the obstacles (k,).
            moving: boxes (b, 2, 3) around the pieces of the posed robot [m].
            nearest: the nearest so far.
        """
        _, objects = self._world(0.0)
        gaps = _box_gaps(self._obstacle_boxes[rows], moving)
        close = np.flatnonzero(gaps <= max(nearest.distance, 0.0))
        by_gap = close[gaps.flat[close].argsort(kind="stable")]
        for k, gap in zip(by_gap.tolist(), gaps.flat[by_gap].tolist(), strict=True):
            if gap > max(nearest.distance, 0.0):
                break
            row, i = divmod(k, len(self._moving))
            j = rows[row]
            distance = coal_distance(self._moving[i], objects[j])
            if distance < nearest.distance:
                nearest = Nearest(distance, CollidingPair(self._pieces[i], self._obstacles[j].name))
        return nearest

    @cached_property
    def _groups(self) -> tuple[list[np.ndarray], np.ndarray]:
        """Groups of neighbouring obstacles (k,), and boxes around the groups (g, 2, 3) [m]."""
        boxes, most = self._obstacle_boxes, 64  # of a group; fewer in all are one group
        centres, left = boxes.mean(axis=1), [np.arange(len(boxes))]
        groups = []
        while left:
            rows = left.pop()
            if len(rows) <= most:
                groups.append(rows)
                continue
            axis = np.ptp(centres[rows], axis=0).argmax()
            left += np.array_split(rows[centres[rows, axis].argsort(kind="stable")], 2)
        around = [(boxes[g, 0].min(axis=0), boxes[g, 1].max(axis=0)) for g in groups if len(g)]
        return groups, np.array(around).reshape(-1, 2, 3)

    @cached_property
    def _obstacle_boxes(self) -> np.ndarray:
        return _boxes(self._world(0.0)[1])

    def _world(
        self, inflation: float
    ) -> tuple[coal.DynamicAABBTreeCollisionManager, list[coal.CollisionObject]]:
        """Broad phase and objects of the obstacles, with boxes inflated by a length [m]."""
        if inflation not in self._worlds:
            objects = []
            for item in self._obstacles:
                placed = coal.CollisionObject(item.shape, transform(item.T_parent_shape))
                placed.getAABB().expand(np.full(3, inflation))
                objects.append(placed)
            phase = coal.DynamicAABBTreeCollisionManager()
            phase.registerObjects(objects)
            phase.setup()
            self._worlds[inflation] = phase, objects
        return self._worlds[inflation]

    def _near_obstacles(self, margin: float, first: int = 0) -> bool:
        """Whether a posed link, from number `first` on, is closer to an obstacle than `margin` [m].

        Links are in order from the base.
        """
        # from the tip: the hand is near most often
        links = range(self.links - 1, first - 1, -1)
        return any(self._meets_obstacle(link, margin) for link in links)

    def _meets_obstacle(self, link: int, margin: float) -> bool:
        """Whether a posed link (from the base) is closer to an obstacle than `margin` [m]."""
        self._request.security_margin = margin
        # few inflations serve all margins: a broad phase of 10 000 obstacles is slow to make
        inflation = self.outer
        if margin > inflation:
            k = bisect_left(BROAD_PHASE_INFLATIONS_M, margin)
            inflation = (*BROAD_PHASE_INFLATIONS_M, margin)[k]
        world = self._worlds.get(inflation) or self._world(inflation)
        self._links[link][1].collide(world[0], self._callback)
        return self._result.isCollision()


def _needed(moved: Number, margin: float) -> Number:
    """Distance [m] that coal must report to prove a margin [m] after a motion of points [m].

    Coal never reports less than the true distance.
    """
    return (moved + margin + COAL_ROUNDING_M) * (1.0 + 2.0 * COAL_ROUNDING_M)


def _forget_guesses(results: pin.GeometryData) -> None:
    """Start GJK at the boxes' centres, not at the result of the pair's last call.

    Else the last digits of distances, and contacts, depend on earlier calls.
    """
    for requests, kind in (
        (results.collisionRequests, coal.CollisionRequest),
        (results.distanceRequests, coal.DistanceRequest),
    ):
        for k in range(len(requests)):
            requests[k] = kind()
            requests[k].gjk_initial_guess = coal.GJKInitialGuess.BoundingVolumeGuess


def _boxes(objects: Sequence[coal.CollisionObject]) -> np.ndarray:
    """Least and greatest corners of boxes around objects (b, 2, 3) [m]."""
    found = [item.getAABB() for item in objects]
    return np.array([(box.min_, box.max_) for box in found]).reshape(-1, 2, 3)


def _box_gaps(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Distances (a, b) [m] between boxes (a, 2, 3) and (b, 2, 3)."""
    low, high = first.transpose(1, 2, 0)[..., None]
    least, most = second.transpose(1, 2, 0)[:, :, None]
    apart = np.maximum(np.maximum(low - most, least - high), 0.0)
    return np.sqrt(np.einsum("iab,iab->ab", apart, apart))


def _robot_geometry(robot: Robot, attachments: Sequence[Attachment]) -> pin.GeometryModel:
    """Geometry of the robot and its attachments, with the pairs to check."""
    geometry = robot.collision_model.copy()
    carried = []
    for item in attachments:
        frame = item.end_effector or robot.end_effector
        hand = robot.model.frames[robot.model.getFrameId(frame, pin.FrameType.BODY)]
        rows = []
        for piece in solids(item.name, item.shape, item.T_hand_object):
            placement = hand.placement * pin.SE3(piece.T_parent_shape)
            placed = pin.GeometryObject(piece.name, hand.parentJoint, placement, piece.shape)
            rows.append(geometry.addGeometryObject(placed))
        carried.append(rows)
    for i, k in carried_pairs(robot, attachments):
        for piece in carried[k]:
            geometry.addCollisionPair(pin.CollisionPair(i, piece))
    for k, m in pairs_of_carried(robot, attachments):
        for first, second in product(carried[k], carried[m]):
            geometry.addCollisionPair(pin.CollisionPair(first, second))
    return geometry


@lru_cache(maxsize=8)
def _checker_of_thread(thread: int, *parts: Any) -> CollisionChecker:
    """Return a checker for one thread alone: a check writes to pinocchio's and coal's data."""
    return CollisionChecker(*parts)


def shared_checker(
    robot: Robot,
    scene: Scene,
    attachments: tuple[Attachment, ...],
    margin: float,
    clearance: float = 0.0,
) -> CollisionChecker:
    """Return the exact checker of a world, cached for this thread; making one takes 10 ms.

    Args:
        robot: the robot.
        scene: obstacles.
        attachments: bodies that the robot carries.
        margin: distances below it are collisions [m].
        clearance: kept from obstacles in addition [m].
    """
    thread = threading.get_ident()
    return _checker_of_thread(thread, robot, scene, attachments, margin, clearance)


class CheckedParts(Protocol):
    """The parts of a planning problem that an exact checker is made of."""

    @property
    def robot(self) -> Robot:
        """The robot."""

    @property
    def scene(self) -> Scene:
        """Obstacles."""

    @property
    def carried(self) -> tuple[Attachment, ...]:
        """Bodies that the robot carries, with the hands that really hold them."""

    @property
    def clearance(self) -> float:
        """Distance kept from obstacles [m]."""


def checker_of(problem: CheckedParts, margin: float = 0.0) -> CollisionChecker:
    """Return the exact checker of a problem; distances below margin [m] are collisions."""
    parts = problem.robot, problem.scene, problem.carried
    return shared_checker(*parts, margin, problem.clearance)
