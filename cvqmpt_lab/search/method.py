"""A planner by name: how its stages are made, and what it needs.

A planner consists of up to four stages, see `search.planner_interface`. They are made when they are
used. `planning.planners` is the table of all names.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.planner_interface import Stages
from cvqmpt_lab.sensing.observation import Observer


@dataclass(frozen=True, eq=False)
class Method:
    """A named planner: how its stages are made, and what it needs."""

    name: str
    # makes stages from a problem (its robot and attachments) and a model's name or folder
    build: Callable[[PlanningProblem, str], Stages]
    weights: str | None = None  # kind of weights it needs, a key of `vqmpt.weights.SHIPPED`
    # why a model cannot serve a problem, of (problem, name or folder of the model); "" if it can
    misfit: Callable[[PlanningProblem, str], str] | None = None
    # whether it needs charts of the manifold, which exist only with more joints than bounded rows
    needs_charts: bool = False
    model: str | None = None  # name or folder of its weights; None for the shipped ones
    sampler: Any = None  # the choices that a learned sampler is composed of, else None
    external: str = ""  # Python distributions and versions of an external planner
    grows: bool = True  # whether its search, or what follows a roadmap without a path, is `BiRRT`

    @staticmethod
    def simple(name: str, **stages: Any) -> "Method":
        """A planner without weights that has the same stages for every problem."""
        fixed = Stages(**stages)
        return Method(name, lambda problem, model: fixed)

    def with_model(self, model: str) -> "Method":
        """The same planner with other weights; InvalidInputError if it uses none."""
        if self.weights is None:
            raise InvalidInputError(f"{self.name} uses no weights: leave --model {model} out")
        return replace(self, model=model)

    def with_reach(self, reach: float) -> "Method":
        """The same planner with another longest extension towards a draw [rad]; inf: no limit.

        InvalidInputError if its search has none, or reach is not above 0.
        """
        if not self.grows:
            raise InvalidInputError(f"{self.name} has no reach of its own: leave --reach out")

        def build(problem: PlanningProblem, model: str) -> Stages:
            stages = self.build(problem, model)
            search = stages.search or BiRRT()
            assert isinstance(search, BiRRT)
            return replace(stages, search=replace(search, reach=reach))

        BiRRT(reach=reach)
        sampler = self.sampler and replace(self.sampler, reach=reach)
        return replace(self, build=build, sampler=sampler)

    def with_cloud(self, points: np.ndarray) -> "Method":
        """The same planner on points (p, 3) [m, base frame]; InvalidInputError if it uses none."""

        def build(problem: PlanningProblem, model: str) -> Stages:
            stages = self.build(problem, model)
            if not isinstance(stages.observe, Observer):
                raise InvalidInputError(f"{self.name} uses no cloud: leave the cloud out")
            cloud = stages.observe.of_points(points)
            return replace(stages, observe=lambda scene: cloud)

        return replace(self, build=build)

    def incompatibility(self, problem: PlanningProblem) -> str:
        """Why the planner cannot solve problems of this kind; "" if it can."""
        rows = sum(len(region.bounded_rows) for region in problem.constraint)
        if self.needs_charts and rows >= problem.robot.dof:
            return (
                f"it needs more joints than the constraint bounds, {problem.robot.dof} joints and "
                f"{rows} entries"
            )
        if self.weights is None or self.misfit is None:
            return ""
        return self.misfit(problem, self.model or self.weights)

    def stages(self, problem: PlanningProblem) -> Stages:
        """The stages for a problem's robot and attachments; `incompatibility` must be ""."""
        return self.build(problem, self.model or self.weights or "")
