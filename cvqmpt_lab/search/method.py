"""A named planner: it makes its stages for a problem, and states its requirements.

A planner consists of up to four stages, see `search.planner_interface`. They are made when they are
first needed. `planning.planners` is the table of all names.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.planner_interface import Stages


@dataclass(frozen=True, eq=False)
class Method:
    """A named planner: it makes its stages for a problem, and states its requirements."""

    name: str
    # makes stages from (problem, name or folder of a model); uses only robot and attachments
    build: Callable[[PlanningProblem, str], Stages]
    weights: str | None = None  # kind of weights it needs, a key of `vqmpt.weights.SHIPPED`
    # returns the reason why (problem, name or folder of a model) do not fit together, or ""
    misfit: Callable[[PlanningProblem, str], str] | None = None
    # whether it needs charts of the manifold, which exist only with more joints than bounded rows
    needs_charts: bool = False
    model: str | None = None  # name or folder of its weights; None for the shipped ones
    sampler: Any = None  # `SamplerChoice` of a learned sampler, else None
    external: str = ""  # Python distributions and versions of an external planner
    grows: bool = True  # whether its search grows trees with a longest extension, `reach`

    @staticmethod
    def simple(name: str, **stages: Any) -> "Method":
        """Return a planner without weights that has the same stages for every problem."""
        fixed = Stages(**stages)
        return Method(name, lambda problem, model: fixed)

    def with_model(self, model: str) -> "Method":
        """Return the same planner with other weights; refuse a planner without weights."""
        if self.weights is None:
            raise InvalidInputError(f"{self.name} uses no weights: leave --model {model} out")
        return replace(self, model=model)

    def with_reach(self, reach: float) -> "Method":
        """Return the same planner with another longest extension towards a sample.

        Args:
            reach: above 0 [rad]; inf: no limit.

        Raises:
            InvalidInputError: the planner grows no trees, or reach is not above 0.
        """
        if not self.grows:
            raise InvalidInputError(f"{self.name} grows no trees with a reach: leave --reach out")

        def build(problem: PlanningProblem, model: str) -> Stages:
            stages = self.build(problem, model)
            # of `BiRRT`, or `OmplSearch`, which the core does not import
            search: Any = stages.search or BiRRT()
            return replace(stages, search=replace(search, reach=reach))

        BiRRT(reach=reach)  # refuses a wrong reach
        sampler = self.sampler and replace(self.sampler, reach=reach)
        return replace(self, build=build, sampler=sampler)

    def with_cloud(self, points: np.ndarray) -> "Method":
        """Return the same planner with a given cloud (p, 3) [m, base frame].

        Raises:
            InvalidInputError: when stages are made, if the planner uses no cloud.
        """

        def build(problem: PlanningProblem, model: str) -> Stages:
            stages = self.build(problem, model)
            from cvqmpt_lab.sensing.observation import Observer  # no other stage needs cameras

            if not isinstance(stages.observe, Observer):
                raise InvalidInputError(f"{self.name} uses no cloud: leave the cloud out")
            cloud = stages.observe.of_points(points)
            return replace(stages, observe=lambda scene: cloud)

        return replace(self, build=build)

    def incompatibility(self, problem: PlanningProblem) -> str:
        """Return the reason why the planner cannot solve problems of this kind, or ""."""
        rows = problem.manifold.dim
        if self.needs_charts and rows >= problem.robot.dof:
            return (
                f"it needs more joints than bounded rows of the constraint; there are "
                f"{problem.robot.dof} joints and {rows} bounded rows"
            )
        if self.weights is None or self.misfit is None:
            return ""
        return self.misfit(problem, self.model or self.weights)

    def stages(self, problem: PlanningProblem) -> Stages:
        """Make the stages for a problem's robot and attachments; `incompatibility` must be ""."""
        return self.build(problem, self.model or self.weights or "")
