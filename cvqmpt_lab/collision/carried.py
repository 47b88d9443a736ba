"""Attachments of a robot: pairs of pieces to check, and the reach of robot and attachments."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.robot.reach import MAX_REACH_M
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment


def carried_pairs(robot: Robot, attachments: Sequence[Attachment]) -> list[tuple[int, int]]:
    """Pairs to check, as indices of (link piece, attachment), without pieces of a holding hand."""
    holding = _holding(robot, attachments)
    return [
        (i, k)
        for k, hands in enumerate(holding)
        for i, piece in enumerate(robot.links)
        if piece.link not in hands and not piece.self_only
    ]


def pairs_of_carried(robot: Robot, attachments: Sequence[Attachment]) -> list[tuple[int, int]]:
    """Pairs of attachments to check: neither is carried by a hand that also holds the other."""
    holding = _holding(robot, attachments)
    return [
        (k, m)
        for k, m in combinations(range(len(holding)), 2)
        if holding[k][0] not in holding[m] and holding[m][0] not in holding[k]
    ]


def _holding(robot: Robot, attachments: Sequence[Attachment]) -> list[list[int]]:
    """Pose rows of the hands that hold each attachment; the first one carries it."""
    return [[robot.hand(name)[0] for name in item.held_by] for item in attachments]


def reach_with(robot: Robot, attachments: Sequence[Attachment], longest: float = 20.0) -> float:
    """Radius [m] of a ball around the base that robot and attachments cannot leave.

    Raises InvalidInputError if an attachment reaches further than `longest` [m] from its hand, or
    the robot, with a door, further than robots may. The usual cause is a wrong unit.
    """
    carried = [
        float(np.linalg.norm(item.T_hand_object[:3, 3])) + item.shape.bounding_radius
        for item in attachments
    ]
    reaches = [(f"robot {robot.name}", robot.reach, MAX_REACH_M)]
    names = [f"attachment {item.name!r}" for item in attachments]
    reaches += [(name, length, longest) for name, length in zip(names, carried, strict=True)]
    for name, length, most in reaches:
        if not length <= most:
            raise InvalidInputError(
                f"{name} reaches {length:.3g} m, more than {most:g}: give positions, sizes and "
                "slider limits in metres"
            )
    return robot.reach + max(carried, default=0.0)
