"""The constraint of task-space regions, and of functions beside them: F(q) = 0 in compiled code."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from cvqmpt_lab.base.values import frozen
from cvqmpt_lab.constraints.bounds_between import bound_between
from cvqmpt_lab.constraints.constraint import Constraint, with_functions
from cvqmpt_lab.constraints.project import (
    PROJECTION_STEPS,
    PROJECTION_TOLERANCE,
    project,
    projection_scratch,
)
from cvqmpt_lab.constraints.regions import Regions, batch_residual_and_jacobian, no_regions
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, bounds_text, displacements
from cvqmpt_lab.robot.robot import Robot


class FunctionMember(Protocol):
    """A function among the members of a constraint, such as a constraint of the user's own."""

    def on(self, robot: Robot) -> Constraint:
        """Return the constraint for a robot."""

    def reraise(self) -> None:
        """Raise what Python code raised inside compiled code."""


Member = TaskSpaceRegion | FunctionMember


def regions_of(members: Iterable[Member]) -> tuple[TaskSpaceRegion, ...]:
    """Return the members that are regions."""
    return tuple(member for member in members if isinstance(member, TaskSpaceRegion))


def functions_of(members: Iterable[Member]) -> tuple[FunctionMember, ...]:
    """Return the members that are functions."""
    return tuple(member for member in members if not isinstance(member, TaskSpaceRegion))


def reraise(members: Iterable[Member]) -> None:
    """Raise what Python code of functions raised inside compiled code, Ctrl-C included."""
    for function in functions_of(members):
        function.reraise()


def constraint_text(robot: Robot, members: Sequence[Member]) -> str:
    """Return the bounds of regions and the words of functions; ";" between members."""
    functions = [function.on(robot).describe() for function in functions_of(members)]
    regions = regions_of(members)
    texts = [bounds_text(regions)] if regions or not functions else []
    return "; ".join([*texts, *functions])


@dataclass(frozen=True, eq=False)
class RegionConstraint(Constraint):
    """The intersection of regions of a robot's end effectors as F(q) = 0; without any m = 0.

    Members that are no regions are functions: constraints, or what gives one by `on`.
    """

    robot: Robot
    members: tuple[Member, ...]

    @property
    def dim(self) -> int:
        """Number m of bounded rows of all members."""
        return len(self.regions.axis)

    @cached_property
    def functions(self) -> tuple[Constraint, ...]:
        """The members that are no regions, for this robot."""
        return tuple(function.on(self.robot) for function in functions_of(self.members))

    def residual(self, q: np.ndarray) -> np.ndarray:
        """Return F(q), the signed distance of x outside its bounds, (m,) or (b, m) [m, rad]."""
        return self.residual_and_jacobian(q)[0]

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return J(q), (m, n) or (b, m, n); rows inside their bounds are zero."""
        return self.residual_and_jacobian(q)[1]

    def bound_between(self, states: np.ndarray) -> np.ndarray | None:
        """Return how far F can exceed its larger value at both ends, see `bounds_between`."""
        most = np.zeros(len(states) - 1)
        for region in regions_of(self.members):
            x = displacements(self.robot, region, states)
            most = np.maximum(most, bound_between(self.robot, region, states, x)[0])
        for function in self.functions:
            found = function.proven_between(states)
            if found is None:
                return None
            most = np.maximum(most, found)
        return most

    def describe(self) -> str:
        """Return the bounds of all members in words, see `bounds_text`."""
        return constraint_text(self.robot, self.members)

    def residual_and_jacobian(
        self, q: np.ndarray, full: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """F(q) and J(q) = dF/dq.

        Args:
            q: (n,) or (b, n) [rad or m].
            full: rows inside their bounds are dx/dq instead of zero.

        Returns:
            (m,) and (m, n), or (b, m) and (b, m, n).
        """
        batch = np.array(q, dtype=float, order="C", ndmin=2)
        kinematics, regions = self.robot.kinematics, self._regions_alone
        scratch = projection_scratch(kinematics, regions)
        work = scratch.link_rotation, scratch.link_translation, scratch.displacement
        residual = np.zeros((len(batch), len(regions.axis)))
        jacobian = np.zeros((*residual.shape, self.robot.dof))
        batch_residual_and_jacobian(kinematics, regions, batch, full, *work, residual, jacobian)
        if self.functions:
            others = (function.residual_and_jacobian(batch) for function in self.functions)
            F, J = zip((residual, jacobian), *others, strict=True)
            residual, jacobian = np.concatenate(F, axis=1), np.concatenate(J, axis=1)
        return (residual, jacobian) if np.ndim(q) == 2 else (residual[0], jacobian[0])

    def project(
        self,
        q: np.ndarray,
        tolerance: float = PROJECTION_TOLERANCE,
        max_iterations: int = PROJECTION_STEPS,
    ) -> np.ndarray | None:
        """Move q (n,) onto the manifold by Algorithm 1, inside the limits; None on failure."""
        q = np.array(q, dtype=float)
        regions = self.regions
        scratch = projection_scratch(self.robot.kinematics, regions)
        iterations = project(self.robot.kinematics, regions, q, tolerance, max_iterations, scratch)
        self.reraise()
        return q if iterations >= 0 else None

    @cached_property
    def regions(self) -> Regions:
        """Plain arrays of all members."""
        return frozen(stack_regions(self.robot, self.members))

    @cached_property
    def _regions_alone(self) -> Regions:
        """`regions` without functions, whose Python code takes a batch at once."""
        if not self.functions:
            return self.regions
        return stack_regions(self.robot, regions_of(self.members))

    def inner_regions(self, inset: float = 0.0) -> Regions:
        """Plain arrays of all members, bounds moved inwards, see `stack_regions`."""
        return stack_regions(self.robot, self.members, inset)

    def reraise(self) -> None:
        """Raise what Python code of functions raised inside compiled code."""
        reraise(self.members)


class JumpingConstraint(RegionConstraint):
    """Regions as the published code constrains them: F jumps at the bounds.

    F_i(q) = x_i - c_i outside the bounds of row i with their centre c_i, and 0 inside. The set
    F = 0 is `RegionConstraint`'s, but Newton's method aims at the centre and stops at the
    first state inside the bounds. A row with one bound has no centre: c_i is that bound. Only
    OMPL's planners project so; others end at the bounds.
    """

    @staticmethod
    def jumped(residual: np.ndarray, regions: Regions) -> np.ndarray:
        """Return F (m,) of the signed distances (m,) of x outside the bounds [m, rad]."""
        half = 0.5 * (regions.upper - regions.lower)
        return residual + np.sign(residual) * np.where(np.isfinite(half), half, 0.0)


def stack_regions(robot: Robot, among: Sequence[Member], shrink: float = 0.0) -> Regions:
    """Plain arrays of regions and functions, in any order.

    shrink: bounds are moved inwards by this much [m, rad], at most a tenth of their width, so that
        straight joint motions between two states at the bounds stay inside.
    """
    functions = [function.on(robot).rows for function in functions_of(among)]
    members = regions_of(among)
    references, hands = (
        zip(*(member.links(robot) for member in members), strict=True) if members else ((), ())
    )
    ends = [T @ np.linalg.inv(it.Tw_e) for it, (_, T) in zip(members, hands, strict=True)]
    rows = [(k, row) for k, member in enumerate(members) for row in member.bounded_rows]
    bounds = np.array([members[k].bounds[row] for k, row in rows]).reshape(-1, 2)
    inset = np.minimum(shrink, 0.1 * (bounds[:, 1] - bounds[:, 0]))
    k = len(members)
    regions = no_regions()._replace(
        link=np.array([row for row, _ in hands], dtype=np.int64),
        base=np.array([row for row, _ in references], dtype=np.int64),
        end_rotation=np.array([T[:3, :3] for T in ends]).reshape(k, 3, 3),
        end_translation=np.array([T[:3, 3] for T in ends]).reshape(k, 3),
        reference_rotation=np.array([T[:3, :3] for _, T in references]).reshape(k, 3, 3),
        reference_translation=np.array([T[:3, 3] for _, T in references]).reshape(k, 3),
        region=np.array([k for k, _ in rows], dtype=np.int64),
        axis=np.array([row for _, row in rows], dtype=np.int64),
        lower=bounds[:, 0] + inset,
        upper=bounds[:, 1] - inset,
    )
    return with_functions(regions, functions, shrink) if functions else regions
