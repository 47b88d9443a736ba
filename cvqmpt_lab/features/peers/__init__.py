"""Adapters of planners of others, which tables compare with ours: drake, hpp, roboplan, sscbirrt.

The library does not import them: they are entry points of this distribution, like planners of any
other package. They support one upright constraint and one goal. Only hpp supports loads, also in
two hands.

Command: ``cvqmpt reproduce peers``. Extra: `peers`. Page: docs/your_planner.md.
"""

from dataclasses import replace
from importlib import metadata

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, install_command
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.problem import PlanningProblem


def versions(planner: str, *distributions: str) -> str:
    """Return names and versions of distributions; refuse a planner if one is not installed."""
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
    """Return the region that bounds only rotation vector entries y and z of the hand, by +-b.

    A region that bounds the tilt by b (a cone) is converted to this form, with the x axis of frame
    w along the axis of the cone. The box of `rpy_box` lies inside the cone, too.

    Raises:
        InvalidInputError: the problem has another constraint, several goals or a load, which
            adapters do not support.
    """
    require_no_followers(problem)
    region = problem.regions[0] if len(problem.constraint) == len(problem.regions) == 1 else None
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
            f"{problem.name}: this adapter supports one upright constraint only, on tilt or on "
            "rotation y and z"
        )
    if not np.array_equal(np.abs(region.Bw[4:]), np.full((2, 2), region.Bw[4, 1])):
        raise InvalidInputError(
            f"{problem.name}: this adapter supports only equal bounds +-b on rotation y and z, not "
            f"{region.Bw[4:].tolist()}"
        )
    if len(problem.goals) != 1:
        raise InvalidInputError(
            f"{problem.name}: this adapter supports one goal, not {len(problem.goals)}"
        )
    if problem.attachments:
        raise InvalidInputError(
            f"{problem.name}: this adapter supports no load: remove {problem.attachments[0].name!r}"
        )
    return region


def fixed_holds(problem: PlanningProblem) -> list[TaskSpaceRegionChain]:
    """Return regions that fix one frame of the robot to another, e.g. two hands on a tray.

    Raises:
        InvalidInputError: a region leaves freedom, which adapters do not support.
    """
    require_no_followers(problem)
    found = [part for part in problem.constraint if isinstance(part, TaskSpaceRegionChain)]
    for part in found:
        if part.bounds[:6].any() or part.tilt is not None:
            raise InvalidInputError(
                f"{problem.name}: the pose in the frame of {part.base!r} has bounds "
                f"{part.Bw.tolist()}; this adapter supports only fixed poses: set all six to 0 "
                "without a tilt, or use a built-in planner such as birrt"
            )
    return found


def rpy_box(region: TaskSpaceRegion, share: float = 0.55) -> np.ndarray:
    """Return bounds (6, 2) on x, y, z [m] and roll, pitch, yaw [rad] inside an upright region.

    Roll r is free; pitch and yaw are at most s b, where b is the region's bound on rotation vector
    entries y and z. To first order these entries are then at most s b h (cot h + 1), h = r / 2,
    which is at most 1.67 s b: s = 0.60 would suffice. A smaller s leaves room for the planners'
    tolerances and for states between those that they check. The tilt t has
    cos t = cos(pitch) cos(yaw), so it is at most 0.78 b.

    Args:
        region: region by `upright_region`.
        share: the factor s.
    """
    tilt, far = share * region.Bw[4, 1], 100.0
    upper = np.array([far, far, far, np.pi, tilt, tilt])
    return np.stack([-upper, upper], axis=1)
