"""A task to start from: the Panda opens a drawer, with comments that say what else there is."""

from typing import Any

from cli.problem_template import SCHEMA_FILE
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.tasks.task import Task

ROBOT = {"name": "panda", "finger_opening": 0.04}
START = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
SCHEMA = SCHEMA_FILE.replace("problem", "task")
# [m] of the drawer; thickness of its handle; way of the hand to it
OPENED, BAR, AHEAD = 0.2, 0.014, 0.08
FRONT, HEIGHT = 0.62, 0.45  # [m] of the drawer's handle
HAND = [0.5, 0.5, 0.5, 0.5]  # its z ahead, its fingers above each other
COMMENT = [
    "A task for `cvqmpt plan --task-file`. Lengths in m, angles in rad; a field _comment may "
    "stand anywhere.",
    "Planned phases: move (the hand into a region), slide (along the hand's z), turn (a held door "
    "or drawer).",
    "Between them: hold (a door or drawer), grasp (an object), release; `gripper` has fields of "
    "the robot that change.",
]
JOINT = (
    "A drawer or door: the objects it moves, and its axis, the z of T_world_joint; a hinge "
    "turns about it."
)
TOUCH = (
    "May touch: pieces of the robot (`cvqmpt robot panda --json`) and parts of the drawer, "
    "from then on."
)
CHAIN = [
    "How the hand holds the part: a region as in a problem file, whose frame w hangs on the "
    "moving object `base`.",
    "Here all is fixed but the turn about the bar.",
]
THROUGH = "Regions in which the hand stops first, in this order."


def task_template(source: dict[str, Any]) -> dict[str, Any]:
    """Json of a task that can be planned; InvalidInputError for another robot than the Panda."""
    if source.get("name") != ROBOT["name"]:
        raise InvalidInputError(
            "the template of a task is for the panda, whose fingers it names; write it without "
            "--robot and --urdf, "
            "then replace 'robot', 'start', 'gripper' and 'may_touch'"
        )
    fingers = [part.name for part in robot_from_source(ROBOT).links if "finger" in part.name]
    held = {
        "base": "drawer/bar",
        "T0_w": {},
        "Tw_e": _hand(-0.1, 0.0, 0.0),
        "Bw": [[0, 0]] * 4 + [[-0.3, 0.3], [0, 0]],
    }
    plain = {
        "$schema": SCHEMA,
        "schema": Task.SCHEMA,
        "_comment": COMMENT,
        "name": "drawer",
        "robot": ROBOT,
        "scene": {"name": "cabinet", "objects": _objects(), "articulations": [_drawer()]},
        "start": START,
        "phases": [
            {
                "kind": "move",
                "name": "reach",
                "goal": {"pose": {"at": _hand(FRONT - 0.1 - AHEAD, 0.0, HEIGHT)}},
            },
            {"kind": "slide", "name": "approach", "distance": AHEAD},
            {
                "_comment": TOUCH,
                "kind": "hold",
                "name": "close",
                "articulation": "drawer",
                "gripper": {"finger_opening": BAR / 2},
                "may_touch": [[finger, "drawer/bar"] for finger in fingers],
            },
            {
                "kind": "turn",
                "name": "pull",
                "value": OPENED,
                "constraint": {"_comment": CHAIN, **held},
                "goal": held,
            },
            {
                "kind": "release",
                "name": "let-go",
                "gripper": {"finger_opening": ROBOT["finger_opening"]},
            },
            {"kind": "slide", "name": "back", "distance": -AHEAD},
            {
                "_comment": THROUGH,
                "kind": "move",
                "name": "away",
                "through": [{"pose": {"at": _hand(0.3, 0.0, 0.6), "position": 0.02}}],
                "goal": {"pose": {"at": _hand(0.3, 0.4, 0.6), "position": 0.02}},
            },
        ],
    }
    Task.from_dict(plain)
    return plain


def _hand(x: float, y: float, z: float) -> dict[str, Any]:
    return {"xyz": [round(x, 3), y, z], "quaternion": HAND}


def _objects() -> list[dict[str, Any]]:
    boxes = {
        "cabinet": ((0.4, 0.8, 0.8), (FRONT + 0.27, 0.0, 0.4)),
        "drawer/front": ((0.02, 0.5, 0.2), (FRONT + 0.05, 0.0, HEIGHT)),
        "drawer/bar": ((BAR, 0.2, BAR), (FRONT, 0.0, HEIGHT)),
        "drawer/left_post": ((0.04, BAR, BAR), (FRONT + 0.02, 0.093, HEIGHT)),
        "drawer/right_post": ((0.04, BAR, BAR), (FRONT + 0.02, -0.093, HEIGHT)),
    }
    return [
        {
            "name": name,
            "shape": {"type": "box", "size": list(size)},
            "T_world_object": {"xyz": [round(x, 3) for x in at]},
        }
        for name, (size, at) in boxes.items()
    ]


def _drawer() -> dict[str, Any]:
    return {
        "_comment": JOINT,
        "name": "drawer",
        "kind": "slider",
        "T_world_joint": {"xyz": [FRONT, 0.0, HEIGHT], "rpy": [0.0, -1.5708, 0.0]},
        "lower": 0.0,
        "upper": 0.3,
        "value": 0.0,
        "moves": ["drawer/front", "drawer/bar", "drawer/left_post", "drawer/right_post"],
    }
