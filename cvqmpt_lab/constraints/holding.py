"""Hands that hold an object, by the regions that keep them at it."""

from collections.abc import Sequence
from dataclasses import replace

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment


def really_held(
    robot: Robot, attachments: tuple[Attachment, ...], regions: Sequence[TaskSpaceRegion]
) -> tuple[Attachment, ...]:
    """Attachments without the hands in `also_held_by` that no region keeps at them.

    A hand is kept if regions between hands lead from the carrying hand to it, each with at most
    2 cm and 0.2 rad from its lower to its upper bounds; it may turn further about one axis.

    Args:
        robot: the robot.
        attachments: what it carries.
        regions: the constraint.
    """
    if not any(item.also_held_by for item in attachments):
        return attachments
    ties = [
        {row for row, _ in region.links(robot)}
        for region in regions
        if isinstance(region, TaskSpaceRegionChain) and _has_little_play(region)
    ]

    def held(item: Attachment) -> Attachment:
        tied = {robot.hand(item.end_effector)[0]}
        for _ in ties:  # each round may lead one hand further
            tied |= set().union(*(tie for tie in ties if tie & tied))
        names = tuple(name for name in item.also_held_by if robot.hand(name)[0] in tied)
        return replace(item, also_held_by=names)

    return tuple(map(held, attachments))


def _has_little_play(region: TaskSpaceRegion) -> bool:
    """Return whether positions, and two rotations or the tilt, have close bounds."""
    widths = region.bounds[:, 1] - region.bounds[:, 0]
    turns = (widths[3:6] <= 0.2).sum() >= 2 or widths[6] <= 0.2
    return bool((widths[:3] <= 0.02).all() and turns)
