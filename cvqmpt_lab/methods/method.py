"""A method: how to observe, predict, update and search, with a name and what it needs."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.proposal import Proposal, Proposer, uniform
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.search import Search
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot

CloudOf = Callable[[PlanningProblem], np.ndarray]
"""Gives the cloud (m, 3) [m, robot base frame] of a problem."""


@dataclass(frozen=True, eq=False)
class Stages:
    """What a method does with one robot's problems, stage by stage."""

    predict: Proposer = uniform
    """What it proposes to a search."""
    search: Search = field(default_factory=BiRRT)
    """How it looks for a path."""
    observe: CloudOf | None = None
    """How it sees the world; None if it does not look."""
    update: Callable[[Query, Proposal], Proposal] | None = None
    """How a proposal is moved towards the constraint (paper, Algorithm 2); None to leave it."""


@dataclass(frozen=True)
class Weights:
    """Trained weights that a method needs: what kind, where, and for which robot."""

    kind: str
    """Key of `vqmpt.weights.SHIPPED`."""
    model: str | None = None
    """Name or folder, see `vqmpt.weights.resolve_model`; None for the shipped ones."""

    def unfit(self, robot: Robot) -> str:
        """Why the weights cannot serve a robot, or ""."""
        from cvqmpt_lab.vqmpt.codebook import robot_signature
        from cvqmpt_lab.vqmpt.weights import incompatibility  # only learned planners read weights

        return incompatibility(self.model or self.kind, self.kind, robot_signature(robot))


@dataclass(frozen=True, eq=False)
class Method:
    """A planner by name; light until its stages are asked for."""

    name: str
    build: Callable[[Robot, Weights | None], Stages]
    """Makes the stages for a robot; slow the first time where weights are loaded."""
    weights: Weights | None = None
    """None for methods that serve any robot."""
    needs_constraint: bool = False

    @staticmethod
    def simple(name: str, **stages) -> "Method":
        """A method without weights, its stages given as they are."""
        fixed = Stages(**stages)
        return Method(name, lambda robot, weights: fixed)

    def with_model(self, model: str) -> "Method":
        """The same on other weights.

        Raises
        ------
        InvalidInputError
            When the method uses none.
        """
        if self.weights is None:
            raise InvalidInputError(f"{self.name} uses no weights: leave --model {model} out")
        return replace(self, weights=replace(self.weights, model=model))

    def unfit(self, problem: PlanningProblem) -> str:
        """Why the method cannot serve a problem, or ""."""
        if self.needs_constraint and not problem.constraint:
            return "it needs a constraint, and the problem has none"
        return "" if self.weights is None else self.weights.unfit(problem.robot)

    def stages(self, problem: PlanningProblem) -> Stages:
        """What it does with the robot of a problem that it can serve, see `unfit`."""
        return self.build(problem.robot, self.weights)
