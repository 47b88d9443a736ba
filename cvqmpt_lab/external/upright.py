"""What adapters of other planners share:
the upright constraint as they state it, and their models of a world, kept.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import TypeVar

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.problem import PlanningProblem

Model = TypeVar("Model")
RPY_SHARE = 0.55
"""Share of a bound b on rotation vector entries y and z that pitch and yaw get, while roll r is
free.

To first order pitch and yaw of s b each become entries of at most s b h (cot h + 1), h = r / 2,
which is 1.67 s b at the most: so s = 0.60 fits. The rest is for their tolerances, and for what lies
between states.
"""


def upright_region(problem: PlanningProblem) -> TaskSpaceRegion:
    """The region of a problem that keeps the x axis of w upright: rotation y and z bounded by +-b,
    all else free.

    InvalidInputError for any other constraint, which the adapters do not translate, and for several
    goals.
    """
    region = problem.constraint[0] if len(problem.constraint) == 1 else None
    if (
        region is None
        or isinstance(region, TaskSpaceRegionChain)
        or region.bounded_rows.tolist() != [4, 5]
    ):
        raise InvalidInputError(
            f"{problem.name}: this adapter keeps one upright constraint, rotation y and z bounded"
        )
    if not np.array_equal(np.abs(region.Bw[4:]), np.full((2, 2), region.Bw[4, 1])):
        raise InvalidInputError(
            f"{problem.name}: this adapter keeps one bound of rotation y and z, both ways"
        )
    if len(problem.goals) != 1:
        raise InvalidInputError(
            f"{problem.name}: this adapter plans to one goal, not to {len(problem.goals)}"
        )
    return region


def rpy_box(region: TaskSpaceRegion) -> np.ndarray:
    """Bounds (6, 2) on x, y, z [m] and roll, pitch, yaw [rad] within which an upright region is
    kept at any roll.
    """
    tilt, far = RPY_SHARE * region.Bw[4, 1], 100.0
    upper = np.array([far, far, far, np.pi, tilt, tilt])
    return np.stack([-upper, upper], axis=1)


def once_a_world(make: Callable[[PlanningProblem], Model]) -> Callable[[PlanningProblem], Model]:
    """A function of a problem's robot, scene and constraint, called once for problems that share
    them.
    """

    @lru_cache(maxsize=4)
    def made(world: _World) -> Model:
        return make(world.problem)

    return lambda problem: made(_World(problem))


class _World:
    """A problem that equals others of the same robot, scene and constraint."""

    def __init__(self, problem: PlanningProblem) -> None:
        self.problem = problem

    def __hash__(self) -> int:
        return hash((id(self.problem.robot), self.problem.scene, self.problem.constraint))

    def __eq__(self, other: object) -> bool:
        mine, theirs = self.problem, getattr(other, "problem", None)
        if theirs is None or mine.robot is not theirs.robot:
            return False
        return bool(mine.scene == theirs.scene and mine.constraint == theirs.constraint)
