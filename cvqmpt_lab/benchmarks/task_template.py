"""Template of a task, with comments: an arm opens a drawer or a door within its reach."""

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import pose, rigid
from cvqmpt_lab.benchmarks.hold_handle import BAR_EDGE_M, Grip, hold_of
from cvqmpt_lab.benchmarks.templates import box_object, pose_field
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.goals import SAMPLE_MARGIN_M, first_guesses, sample_region, solve_poses
from cvqmpt_lab.constraints.no_goal import hand_reach
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.features.motion.timing import TimingSettings
from cvqmpt_lab.features.tasks.solve import solve_task
from cvqmpt_lab.features.tasks.task import Move, Slide, Task, Turn
from cvqmpt_lab.planning.margins import Margin
from cvqmpt_lab.robot.robot import SLOW_SPEED
from cvqmpt_lab.search.result import Budget

Furniture = Literal["drawer", "door"]
TASK_COMMENTS = {  # comments of the template: possible values of fields of a task file
    "task": [
        "A task for `cvqmpt plan FILE`. Lengths in m, angles in rad; a field _comment may "
        "stand anywhere.",
        "Planned phases: move (the hand into a region), slide (along an axis of the hand), turn "
        "(a held door or drawer).",
        "Between them: hold (a door or drawer), grasp (an object), release; `gripper` has fields "
        "of the robot that change.",
    ],
    "articulation": (
        "A drawer or door: the objects it moves, and its axis, the z of T_world_joint; a hinge "
        "turns about it."
    ),
    "hold": (
        "May touch: pieces of the robot (`cvqmpt robot NAME --json`) and parts of the furniture, "
        "from then on."
    ),
    "turn": [
        "How the hand holds the part: a region as in a problem file, whose frame w hangs on the "
        "moving object `base`.",
        "Bw: what it may do meanwhile; here all is fixed but the turn about a bar.",
    ],
    "away": "Regions in which the hand stops first, in this order.",
}


class Place(NamedTuple):
    """Position of a handle relative to the arm's first joint."""

    yaw: float  # direction from the joint to the handle [rad]
    ahead: float  # distance of the hand that holds the closed handle, in shares of its reach
    up: float  # height in shares of the hand's reach
    roll: float  # roll of the hand about the line to the handle [rad]
    side: float  # -1 or 1: the side of the hinge, and of the hand at the start


def task_template(
    source: Mapping[str, Any],
    what: Furniture = "drawer",
    report: Callable[[int, int], None] = lambda done, total: None,
    seconds: float = 120.0,
) -> dict[str, Any]:
    """Return json of a task that `solve_task` solves with birrt.

    Args:
        source: json of the robot; acceleration limits must be known.
        what: furniture that the arm opens.
        report: called with the number of tried places and the number of all.
        seconds: time after which no further place is tried [s].

    Raises:
        InvalidInputError: no such task is found; the message says what is missing.
    """
    hold = hold_of(source)
    if len(hold.robot.end_effectors) > 1:
        raise InvalidInputError(
            f"robot {hold.robot.name} has several end effectors, and a task is for one hand: name "
            f"one, --end-effector {hold.robot.end_effector}"
        )
    reach = hand_reach(hold.robot)
    tried, reached, failure, began = 0, 0, "", time.monotonic()
    places = [*_places(hold, what)]
    for place in places:
        if time.monotonic() - began > seconds:
            failure += f"; {seconds:.0f} s are over, and {len(places) - tried} places not tried"
            break
        report(tried, len(places))
        tried += 1
        made = _task(source, hold, what, place, reach)
        start = _start(Task.from_dict(made), hold)
        if start is None:
            continue
        reached += 1
        made["start"] = dict(zip(hold.robot.joint_names, start.tolist(), strict=True))
        solution = solve_task(
            Task.from_dict(made),
            "birrt",
            Budget(seconds=3.0),
            seed=0,
            timing=TimingSettings(speed=SLOW_SPEED),
            margin=Margin(),
        )
        if solution.solved:
            report(len(places), len(places))
            return made
        failure = f"; at the last one {solution.failure}"
    raise InvalidInputError(
        f"no {what} was found that robot {hold.robot.name} opens: its {hold.robot.dof} joints bring"
        f" {hold.robot.end_effector}, {hold.axis} ahead, to {reached} of {tried} places{failure}; "
        "name another --end-effector, change the task of another arm, or write a problem for this "
        "arm, without --task"
    )


def _places(hold: Grip, what: Furniture) -> Iterator[Place]:
    """Yield the positions of the handle that are tried, likely ones first."""
    quarter = np.pi / 2
    if not hold.bar:
        rolls = [0.0, quarter, np.pi, -quarter]
    elif what == "door":
        rolls = [quarter, quarter + np.pi]  # a bar on a door is vertical
    else:
        rolls = [0.0, np.pi]
    for turn in (0.0, 1.0, -1.0, 0.5, -0.5, 0.25, -0.25, 2.0):
        for ahead, up in ((0.6, 0.14), (0.7, 0.0), (0.65, 0.35), (0.8, 0.15), (0.6, -0.2)):
            for roll in rolls:
                for side in (1.0, -1.0):
                    yield Place(turn * quarter, ahead, up, roll, side)


def _task(
    source: Mapping[str, Any], hold: Grip, what: Furniture, place: Place, reach: float
) -> dict[str, Any]:
    """Return json of the task of one place, without a start.

    The frame of the room stands at the handle, x into the furniture, z up.

    Args:
        source: json of the robot.
        hold: grip of the handle.
        what: furniture that the arm opens.
        place: position of the handle.
        reach: reach of the hand [m].
    """
    size = min(round(reach / 0.86, 2), 1.2)  # scale of the furniture: 1 for the panda
    pull = 0.2 * size if what == "drawer" else -0.6 * place.side
    approach = round(max(0.08 * size, hold.beyond + 0.03), 3)
    x, y, z = hold.robot.kinematics.translation[0]
    roll = Rotation.from_euler("x", place.roll).as_matrix()
    T_room_hand = rigid(roll) @ hold.T_handle_hand
    forward = place.ahead * reach - T_room_hand[0, 3]
    up = max(z + place.up * reach, 0.15 * size)
    at = (x + forward * np.cos(place.yaw), y + forward * np.sin(place.yaw), up)
    T_world_room = pose(np.round(at, 3), place.yaw)
    if hold.robot.dof < 6:
        T_world_room = T_world_room @ pose((0.0, _aside(hold, T_world_room, T_room_hand), 0.0))
    grasp = T_world_room @ T_room_hand

    def hand(dx: float, dy: float = 0.0, dz: float = 0.0) -> dict[str, Any]:
        return pose_field(T_world_room @ pose((dx, dy, dz)) @ T_room_hand)

    handle = f"{what}/bar" if hold.bar else f"{what}/knob"
    objects, hinge = _furniture(hold, what, place.side, size, up)
    scene_objects = [
        box_object(name, edges, T_world_room @ pose(np.round(middle, 3)))
        for name, (edges, middle) in objects.items()
    ]
    knob = np.linalg.inv(T_world_room @ pose(np.round(objects[handle][1], 3))) @ grasp
    region: dict[str, Any] = {
        "base": handle,
        "T0_w": {},
        "Tw_e": pose_field(knob),
        "Bw": [[0, 0] for _ in range(6)],
    }
    if hold.bar:
        region["Bw"][4 if what == "drawer" else 5] = [-0.3, 0.3]
    # a hand that less than six joints move cannot go sideways and stay turned as it is
    aside = place.side * 0.25 * reach if hold.robot.dof > 5 else 0.0
    away = (-0.3 * reach, aside, 0.1 * reach)
    phases = _phases(hold, what, hand, handle, region, (approach, pull), away)
    return {
        "$schema": "task.schema.json",
        "schema": Task.SCHEMA,
        "_comment": TASK_COMMENTS["task"],
        "name": what,
        "robot": {**source, **hold.opened},
        "scene": {
            "name": "cabinet",
            "objects": scene_objects,
            "articulations": [
                {
                    "_comment": TASK_COMMENTS["articulation"],
                    "name": what,
                    "kind": "slider" if what == "drawer" else "hinge",
                    "T_world_joint": pose_field(T_world_room @ hinge),
                    "lower": min(0.0, round(1.5 * pull, 3)),
                    "upper": max(0.0, round(1.5 * pull, 3)),
                    "value": 0.0,
                    "moves": [name for name in objects if name.startswith(f"{what}/")],
                }
            ],
        },
        "start": [0.0] * hold.robot.dof,
        "phases": phases,
    }


def _phases(
    hold: Grip,
    what: Furniture,
    hand: Callable[..., dict[str, Any]],
    handle: str,
    region: Mapping[str, Any],
    lengths: tuple[float, float],
    away: tuple[float, float, float],
) -> list[dict[str, Any]]:
    """Return json of the phases: reach, hold, pull, let go, and move away.

    Args:
        hold: grip of the handle.
        what: furniture that the arm opens.
        hand: pose of the hand, as json, at an offset (x, y, z) [m] from the handle.
        handle: name of the handle's object.
        region: region of the hand that holds the handle.
        lengths: of the approach [m], and value of the joint that is pulled [m or rad].
        away: offset of the hand at the end [m].
    """
    approach, pull = lengths
    above = [{"pose": {"at": hand(away[0], 0.0, away[2]), "position": 0.02}}] if away[1] else []
    return [
        {"kind": "move", "name": "reach", "goal": {"pose": {"at": hand(-approach)}}},
        _slide("approach", approach, hold),
        {
            "_comment": TASK_COMMENTS["hold"],
            "kind": "hold",
            "name": "close",
            "articulation": what,
            "gripper": dict(hold.closed),
            "may_touch": [[piece, handle] for piece in hold.touching],
        },
        {
            "kind": "turn",
            "name": "pull",
            "value": round(pull, 3),
            "constraint": {"_comment": TASK_COMMENTS["turn"], **region},
            "goal": region,
        },
        {"kind": "release", "name": "let-go", "gripper": dict(hold.opened)},
        _slide("back", -approach, hold),
        {
            "_comment": TASK_COMMENTS["away"],
            "kind": "move",
            "name": "away",
            **({"through": above} if above else {}),
            "goal": {"pose": {"at": hand(*away), "position": 0.02}},
        },
    ]


def _aside(hold: Grip, T_world_room: np.ndarray, T_room_hand: np.ndarray) -> float:
    """Return the sideways offset of a hand that fewer than six joints move [m]; 0: none found."""
    bounds = np.zeros((6, 2))
    bounds[1] = -0.1, 0.1
    region, robot = TaskSpaceRegion(T_world_room, T_room_hand, bounds), hold.robot
    guesses = first_guesses(robot, np.random.default_rng(0), 4)
    poses = np.broadcast_to(np.eye(4), (4, 4, 4))
    found = np.concatenate(solve_poses(robot, region, poses, guesses, anywhere=True))
    if not len(found):
        return 0.0
    return float((np.linalg.inv(T_world_room) @ robot.pose(found[0]))[1, 3] - T_room_hand[1, 3])


def _slide(name: str, distance: float, hold: Grip) -> dict[str, Any]:
    """Return a slide along the hand's axis."""
    axis = {} if hold.axis == "z" else {"axis": hold.axis}
    return {"kind": "slide", "name": name, "distance": distance, **axis}


def _furniture(
    hold: Grip, what: Furniture, side: float, size: float, up: float
) -> tuple[dict[str, tuple[Any, Any]], np.ndarray]:
    """Return the boxes of the furniture and T_room_joint (4, 4).

    Args:
        hold: grip of the handle.
        what: drawer or door.
        side: -1 or 1: the side of the hinge.
        size: scale of the furniture.
        up: height of the handle [m].

    Returns:
        Edges and middle in the room [m] of the boxes by name, and the pose of the joint.
    """
    far = round(max(0.04, hold.beyond + 0.025), 3)  # from the handle's origin to the front
    wide, high = (0.5 * size, 0.2 * size) if what == "drawer" else (0.45 * size, 0.5 * size)
    offset = 0.0 if what == "drawer" else side * (0.5 * wide - 0.05 * size)
    front = 0.02
    top = min(2.0 * up, up + 0.4 * size)
    objects: dict[str, tuple[Any, Any]] = {
        "cabinet": (
            (0.4 * size, wide + 0.1 * size, top),
            (far + front + 0.01 + 0.2 * size, offset, 0.5 * top - up),
        ),
        f"{what}/front": ((front, wide, high), (far + 0.5 * front, offset, 0.0)),
    }
    if hold.bar:
        long = np.array((0.0, 1.0, 0.0) if what == "drawer" else (0.0, 0.0, 1.0))
        objects[f"{what}/bar"] = (BAR_EDGE_M + (hold.bar - BAR_EDGE_M) * long, (0.0, 0.0, 0.0))
        deep = far - 0.5 * BAR_EDGE_M
        for name, way in (("left_post", 1.0), ("right_post", -1.0)):
            along = way * 0.5 * (hold.bar - BAR_EDGE_M) * long
            middle = 0.5 * (BAR_EDGE_M + deep) * np.eye(3)[0] + along
            objects[f"{what}/{name}"] = ((deep, BAR_EDGE_M, BAR_EDGE_M), middle)
    else:
        objects[f"{what}/knob"] = ((far, 0.03, 0.03), (0.5 * far, 0.0, 0.0))
    if what == "drawer":
        return objects, rigid(Rotation.from_euler("y", -np.pi / 2).as_matrix())
    return objects, pose((far + 0.5 * front, offset + side * 0.5 * wide, 0.0))


def _start(task: Task, hold: Grip) -> np.ndarray | None:
    """Return a configuration (n,) at the task's end; None if the hand cannot reach all poses."""
    robot, rng = hold.robot, np.random.default_rng(0)
    checker = CollisionChecker(robot, task.scene, margin=SAMPLE_MARGIN_M)
    reach, away = (phase for phase in task.phases if isinstance(phase, Move))
    turn = next(phase for phase in task.phases if isinstance(phase, Turn))
    *_, slide = (phase for phase in task.phases if isinstance(phase, Slide))
    opened = task.scene.with_joint(task.name, turn.value)
    last = turn.goal.at(opened[turn.goal.base].T_world_object)
    there = CollisionChecker(robot, opened, margin=SAMPLE_MARGIN_M)
    back = TaskSpaceRegion(last.T0_w, last.Tw_e @ pose(slide.translation), np.zeros((6, 2)))
    for region, check in (
        (reach.goal, checker),
        (last, there),
        (back, there),
        *((region, there) for region in away.through),
    ):
        if not len(sample_region(robot, region, check, rng, 1, max_poses=3).configurations):
            return None
    exact = TaskSpaceRegion(away.goal.T0_w, away.goal.Tw_e, np.zeros((6, 2)))
    found = sample_region(robot, exact, checker, rng, 8, max_poses=8).configurations
    if not len(found):
        return None
    middle = 0.5 * (robot.lower + robot.upper)
    middle = np.where(robot.turning, np.clip(0.0, robot.lower, robot.upper), middle)
    inside = found.round(4).clip(robot.lower, robot.upper)
    return min(inside, key=lambda q: float(np.linalg.norm(q - middle)))
