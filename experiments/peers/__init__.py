"""Adapters of other planners, for tables beside ours: drake, hpp, roboplan, sscbirrt.

The library does not know them: they are entry points of this distribution, as anybody's planner may
be. They keep one upright constraint and plan to one goal, with an empty hand; hpp carries loads,
in two hands as well.
"""

from dataclasses import replace
from importlib import metadata

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, install_command
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.problem import PlanningProblem


def versions(planner: str, *distributions: str) -> str:
    """Return distributions and versions; InvalidInputError with the cure if one is missing."""
    try:
        return ", ".join(f"{name} {metadata.version(name)}" for name in distributions)
    except metadata.PackageNotFoundError as error:
        raise InvalidInputError(
            f"planner {planner} needs {error.name}, which is not installed: "
            f"{install_command('peers')}"
        ) from error


def require_no_followers(problem: PlanningProblem) -> None:
    """Refuse joints that mimic planned joints: adapters do not translate them."""
    if problem.robot.followers:
        names = ", ".join(joint.name for joint in problem.robot.followers)
        raise InvalidInputError(
            f"{problem.name}: {names} mimic planned joints, which this adapter does not translate; "
            "take a planner of ours, such as birrt"
        )


def upright_region(problem: PlanningProblem) -> TaskSpaceRegion:
    """The region of a problem that bounds rotation y and z of the hand by +-b, and nothing else.

    A cone of tilt b is turned to that form, x of w along its axis: `rpy_box` lies in the cone too.

    InvalidInputError: other constraints, several goals, a load, which adapters do not translate.
    """
    require_no_followers(problem)
    region = problem.constraint[0] if len(problem.constraint) == 1 else None
    if region is not None and region.bounded_rows.tolist() == [6]:
        turn = np.eye(4)[:, [2, 0, 1, 3]]
        upper = np.array([np.inf] * 4 + [region.tilt] * 2)
        region = replace(
            region,
            T0_w=region.T0_w @ turn,
            Tw_e=turn.T @ region.Tw_e,
            Bw=np.stack([-upper, upper], axis=1),
            tilt=None,
        )
    if (
        region is None
        or isinstance(region, TaskSpaceRegionChain)
        or region.bounded_rows.tolist() != [4, 5]
    ):
        raise InvalidInputError(
            f"{problem.name}: this adapter keeps one upright constraint, a tilt or rotation y, z"
        )
    if not np.array_equal(np.abs(region.Bw[4:]), np.full((2, 2), region.Bw[4, 1])):
        raise InvalidInputError(
            f"{problem.name}: this adapter keeps one bound of rotation y and z, both ways"
        )
    if len(problem.goals) != 1:
        raise InvalidInputError(
            f"{problem.name}: this adapter plans to one goal, not to {len(problem.goals)}"
        )
    if problem.attachments:
        raise InvalidInputError(
            f"the hand carries {problem.attachments[0].name!r}: it must be empty"
        )
    return region


def fixed_holds(problem: PlanningProblem) -> list[TaskSpaceRegionChain]:
    """The regions of a frame of the robot in another one, such as two hands that hold one thing.

    InvalidInputError: one leaves freedom, which no adapter translates.
    """
    require_no_followers(problem)
    found = [part for part in problem.constraint if isinstance(part, TaskSpaceRegionChain)]
    for part in found:
        if part.bounds[:6].any() or part.tilt is not None:
            raise InvalidInputError(
                f"{problem.name}: the pose in the frame of {part.base!r} has bounds "
                f"{part.Bw.tolist()}; this adapter keeps fixed ones: make all six 0, without a "
                "tilt, or take a planner of ours, such as birrt"
            )
    return found


def rpy_box(region: TaskSpaceRegion, share: float = 0.55) -> np.ndarray:
    """Bounds (6, 2) on x, y, z [m] and roll, pitch, yaw [rad] that lie inside an upright region.

    Roll r is free; pitch and yaw are at most s b, with b the region's bound on rotation vector
    entries y and z. To first order these entries are then at most s b h (cot h + 1), h = r / 2,
    which is 1.67 s b at the most: s = 0.60 fits. The rest is for the planners' tolerances and for
    what lies between states. The tilt t has cos t = cos(pitch) cos(yaw), so it is at most 0.78 b.

    Args:
        region: an `upright_region`.
        share: s.
    """
    tilt, far = share * region.Bw[4, 1], 100.0
    upper = np.array([far, far, far, np.pi, tilt, tilt])
    return np.stack([-upper, upper], axis=1)
