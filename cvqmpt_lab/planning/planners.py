"""Planners by name: those of the paper's tables, ours, and controls.

A control differs from a planner in one part, to measure what this part contributes. A planner
consists of up to four stages, see `search.planner_interface`, that are made when they are used.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegionChain
from cvqmpt_lab.external.door import entry_point_names, external_planner, is_external, refuse_clash
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.anytime import informed_roadmap_path
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.cell_trees import CellSearch
from cvqmpt_lab.search.controls import guided, no_costs, other_costs
from cvqmpt_lab.search.edge_costs import EdgeCosts
from cvqmpt_lab.search.planner_interface import Stages
from cvqmpt_lab.search.portfolio import Portfolio
from cvqmpt_lab.search.roadmap import scene_costs, spread_roadmap
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.sensing.observation import Observer
from cvqmpt_lab.vqmpt.sampler_choice import NAMED, PREFIX, SamplerChoice

VQ_MPT = "vq_mpt"  # the shipped weights


@dataclass(frozen=True, eq=False)
class Method:
    """A named planner: how its stages are made, and what it needs."""

    name: str
    # makes stages from a problem (its robot and attachments) and a model's name or folder
    build: Callable[[PlanningProblem, str], Stages]
    weights: str | None = None  # kind of weights it needs, a key of `vqmpt.weights.SHIPPED`
    # whether it needs charts of the manifold, which exist only with more joints than bounded rows
    needs_charts: bool = False
    model: str | None = None  # name or folder of its weights; None for the shipped ones
    sampler: SamplerChoice | None = None  # of a learned sampler, else None
    external: str = ""  # of an external planner: its Python distributions and versions
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
        if self.weights is None:
            return ""
        from cvqmpt_lab.vqmpt import weights  # imports safetensors

        robot = weights.robot_signature(problem.robot)
        return weights.incompatibility(self.model or self.weights, self.weights, robot)

    def stages(self, problem: PlanningProblem) -> Stages:
        """The stages for a problem's robot and attachments; `incompatibility` must be ""."""
        return self.build(problem, self.model or self.weights or "")


def _ompl(name: str, manifold: str, kpiece: bool = False) -> Method:
    def build(problem: PlanningProblem, model: str) -> Stages:
        from cvqmpt_lab.search.ompl_planners import OmplSearch  # ompl takes 0.3 s to import

        return Stages(search=OmplSearch(manifold, kpiece))

    return Method(name, build, needs_charts=manifold != "projected", grows=False)


def _mpnet(name: str, bridged: bool) -> Method:
    """MPNet; bridged: tree growth connects rollouts that the network does not connect."""

    def build(problem: PlanningProblem, model: str) -> Stages:
        from cvqmpt_lab.vqmpt.learned_sampler import mpnet  # imports safetensors

        return mpnet(problem.robot, model, bridged)

    return Method(name, build, "mpnet", grows=False)


def _roadmap(
    name: str,
    weights: str | None = None,
    draw: int | None = None,
    costs: Callable[[ConstrainedSpace], EdgeCosts] = scene_costs,
    oracle: bool = False,
) -> Method:
    """Trees, a roadmap and cells in turns.

    The roadmap is of the dictionary's nodes if weights are given, else evenly spread.

    Args:
        name: of the planner.
        weights: kind of weights, a key of `vqmpt.weights.SHIPPED`.
        draw: seed of nodes drawn independently, in place of evenly spread ones.
        costs: makes the edge costs in a space.
        oracle: whether blocked nodes and edges are known at no cost.
    """

    def build(problem: PlanningProblem, model: str) -> Stages:
        robot, load = problem.robot, problem.attachments
        if problem.closed_chain:
            roadmap = None  # hardly any node lies near a closed chain
        elif weights is None:
            roadmap = spread_roadmap(robot, load, draw)
        else:
            from cvqmpt_lab.vqmpt.learned_sampler import free_dictionary  # imports safetensors

            roadmap = free_dictionary(model, robot, load)
        return Stages(
            search=Portfolio(roadmap=roadmap, name=name, costs=costs, oracle=oracle),
            path_source=partial(informed_roadmap_path, costs),
        )

    return Method(name, build, weights)


def _product(name: str, choice: SamplerChoice) -> Method:
    """A planner with a learned sampler, as `choice` composes it, and the paper's search."""

    def build(problem: PlanningProblem, model: str) -> Stages:
        from cvqmpt_lab.vqmpt.learned_sampler import learned  # imports safetensors

        return learned(problem.robot, model, name, choice)

    return Method(name, build, VQ_MPT, sampler=choice)


def _by_name(*methods: Method) -> dict[str, Method]:
    return {method.name: method for method in methods}


PLANNERS = _by_name(
    Method.simple("birrt"),
    # Algorithm 3 without a limit of extensions, as it is printed; `birrt` has the best tuning
    Method.simple("birrt-printed", search=BiRRT(reach=math.inf)),
    replace(Method.simple("cells", search=CellSearch()), grows=False),  # for narrow passages
    _ompl("ompl-projected", "projected"),
    _ompl("atlas-rrt", "atlas"),
    _ompl("tb-rrt", "tangent-bundle"),
    _ompl("ompl-bkpiece", "projected", kpiece=True),
    _mpnet("mpnet", bridged=False),  # the paper's MPNet (w/ proj)
    _mpnet("mpnet-bridged", bridged=True),
    *(_product(name, choice) for name, choice in NAMED.items() if choice.predictor != "published"),
    _roadmap("roadmap"),
    _roadmap("roadmap-cvq", VQ_MPT),
)

# former names of controls, and the `SamplerChoice` in their place
_RENAMED = {
    "true-codes": "oracle+wide",
    "random-codes": "random+wide",
    "cvq-wrong-cloud": "transformer+decoded+other-cloud",
    "cvq-no-cloud": "transformer+decoded+no-cloud",
    "cvq-uniform": "transformer+decoded+uniform=0.15",
    "straight-line": "nearest-lines+along+reach=1",
    "straight-line-only": "nearest-lines+along+reach=1+uniform=0",
    "solved-paths": "solved+along+reach=1+std=0.4",
}

CONTROLS = _by_name(
    Method.simple("guided-birrt", predict=guided),
    # three sets of random nodes show how much results vary between roadmaps
    *(_roadmap(f"roadmap-uniform-{draw}", draw=draw) for draw in range(3)),
    _roadmap("roadmap-wrong-scene", VQ_MPT, costs=other_costs),
    _roadmap("roadmap-no-scene", VQ_MPT, costs=no_costs),
    _roadmap("roadmap-true-edges", VQ_MPT, costs=no_costs, oracle=True),
)

# need weights of the authors' architecture, which are imported or trained, not shipped
PUBLISHED = _by_name(_product("cvq-published", NAMED["cvq-published"]))


# Names of planners elsewhere, and ours of that kind.
_ELSEWHERE = {
    **dict.fromkeys(
        ("rrtconnect", "rrt", "cbirrt", "cbirrt2"),
        "'birrt', or OMPL's 'ompl-projected', the paper's CBiRRT",
    ),
    **dict.fromkeys(("prm", "lazyprm", "prmstar"), "'roadmap'"),
    **dict.fromkeys(("cvqmpt", "vqmpt"), "'cvq-mpt' or 'opt-cvq-mpt'"),
}


def is_removed(name: str) -> bool:
    """Whether a planner of that name was removed; old committed rows may still contain the name."""
    return name == "graph-cvq" or name.startswith(f"{PREFIX}graph") or name in _RENAMED


def planner_named(name: str, model: str | None = None, reach: float | None = None) -> Method:
    """The planner or control of that name, also an external one, see `cvqmpt_lab.external.door`.

    Args:
        name: of the planner.
        model: name or folder of its weights; None for the shipped ones.
        reach: longest extension towards a draw [rad], inf for no limit; None for the planner's own.
    """
    if name in _RENAMED:
        raise InvalidInputError(
            f"{name} was removed; {PREFIX}{_RENAMED[name]} samples in its place"
        )
    if is_removed(name):
        raise InvalidInputError(
            f"{name} was removed; roadmap-cvq plans on the same dictionary's roadmap"
        )
    plain = name.lower().replace("-", "").replace("_", "")
    if plain in _ELSEWHERE and name not in PLANNERS:
        raise InvalidInputError(f"unknown planner {name!r}; did you mean {_ELSEWHERE[plain]}?")
    ours = {**PLANNERS, **CONTROLS, **PUBLISHED}
    refuse_clash(name, ours)
    found = ours.get(name)
    if name.startswith(PREFIX):
        found = _product(name, SamplerChoice.of(name.removeprefix(PREFIX)))
    elif is_external(name):
        planner = external_planner(name)
        found = Method(name, planner.stages, external=planner.made_by, grows=False)
    if found is None:
        known = ["package.module:planner", *ours, f"{PREFIX}random+wide", *entry_point_names()]
        raise UnknownChoiceError("planner", name, known)
    found = found if model is None else found.with_model(model)
    return found if reach is None else found.with_reach(reach)


def default_planner(problem: PlanningProblem) -> tuple[str, str]:
    """The planner for a problem if the user names none, and the reason."""
    if problem.closed_chain:
        return "roadmap", "trees and cells in turns; no roadmap is made of closed chains"
    if any(isinstance(region, TaskSpaceRegionChain) for region in problem.constraint):
        return "birrt", "the hand holds a mechanism, for which no roadmap was measured"
    return (
        "roadmap",
        "less work than birrt on most problems of all arms; birrt and cells where it finds no path",
    )


def require_fit(method: Method, problem: PlanningProblem) -> None:
    """Raise InvalidInputError if a planner cannot serve a problem: why, and which planners can."""
    reason = method.incompatibility(problem)
    if reason:
        others = [
            name
            for name, one in PLANNERS.items()
            if one.weights is None and not one.incompatibility(problem)
        ]
        raise InvalidInputError(f"{method.name}: {reason}; planners that can: {', '.join(others)}")
