"""Planners by name, which `planners` declares.

This file does not depend on learned samplers.
"""

from dataclasses import replace
from importlib import import_module

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegionChain
from cvqmpt_lab.external.names import entry_point_names, is_external, refuse_clash
from cvqmpt_lab.planning.by_name import declared
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.cell_trees import CellSearch
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import Stages
from cvqmpt_lab.search.portfolio import roadmap_planner, spread_nodes

# modules with a function `planner_of`, which makes a planner from a composed name, or returns None
PLANNER_MODULES = ("cvqmpt_lab.vqmpt.learned_planners", "cvqmpt_lab.benchmarks.ablations")


def trees(name: str, reach: float | None = None) -> Method:
    """Return Algorithm 3; reach: its longest extension [rad], None: the tuned one."""
    return Method.simple(name, search=None if reach is None else BiRRT(reach=reach))


def cells(name: str) -> Method:
    """Return the search of narrow passages."""
    return replace(Method.simple(name, search=CellSearch()), grows=False)


def spread_roadmap(name: str) -> Method:
    """Return the roadmap of evenly spread configurations."""
    return roadmap_planner(name, spread_nodes)


def ompl(name: str, manifold: str, kpiece: bool = False) -> Method:
    """Return a planner of OMPL.

    Args:
        name: name of the planner.
        manifold: "projected", "atlas" or "tangent-bundle".
        kpiece: whether it is BKPIECE1, not RRTConnect.
    """

    def build(problem: PlanningProblem, model: str) -> Stages:
        from cvqmpt_lab.search.ompl_planners import OmplSearch  # ompl takes 0.3 s to import

        return Stages(search=OmplSearch(manifold, kpiece))

    return Method(name, build, needs_charts=manifold != "projected")


def ompl_uniform(name: str) -> Method:
    """Return the search of `ompl-cvq` with uniform samples."""

    def build(problem: PlanningProblem, model: str) -> Stages:
        from cvqmpt_lab.search.ompl_planners import GOAL_LIMIT, published_search

        return Stages(search=published_search(), goals_apart=True, goal_limits=(GOAL_LIMIT,))

    return Method(name, build)


PLANNERS: dict[str, Method] = {name: one.make(name) for name, one in declared().items()}

# names of planners in other libraries, and the similar planners here
_NAMES_ELSEWHERE = {
    **dict.fromkeys(
        ("rrtconnect", "rrt", "cbirrt", "cbirrt2"),
        "'birrt', or OMPL's 'ompl-projected', the paper's CBiRRT",
    ),
    **dict.fromkeys(("prm", "lazyprm", "prmstar"), "'roadmap'"),
    **dict.fromkeys(("cvqmpt", "vqmpt"), "'cvq-mpt' or 'opt-cvq-mpt'"),
}


def planner_named(name: str, model: str | None = None, reach: float | None = None) -> Method:
    """Return the planner or control of a name, also an external one, see `cvqmpt_lab.external`.

    Args:
        name: name of the planner.
        model: name or folder of its weights; None: the shipped ones.
        reach: longest extension towards a sample [rad]; inf: no limit; None: the planner's default.
    """
    plain = name.lower().replace("-", "").replace("_", "")
    if plain in _NAMES_ELSEWHERE and name not in PLANNERS:
        raise InvalidInputError(
            f"unknown planner {name!r}; did you mean {_NAMES_ELSEWHERE[plain]}?"
        )
    others = declared("control", "unshipped")
    ours = (*PLANNERS, *others)
    refuse_clash(name, ours)
    found = others[name].make(name) if name in others else PLANNERS.get(name) or _composed(name)
    if found is None and is_external(name):
        from cvqmpt_lab.external.door import external_planner  # not needed for planners of ours

        planner = external_planner(name)
        found = Method(name, planner.stages, external=planner.made_by, grows=False)
    if found is None:
        known = ["package.module:planner", *ours, "cvq:random+wide", *entry_point_names()]
        raise UnknownChoiceError("planner", name, known)
    found = found if model is None else found.with_model(model)
    return found if reach is None else found.with_reach(reach)


def _composed(name: str) -> Method | None:
    """Return the planner that one of `PLANNER_MODULES` makes from a composed name, or None."""
    for module in PLANNER_MODULES:
        found = import_module(module).planner_of(name)
        if found is not None:
            return found
    return None


def default_planner(problem: PlanningProblem) -> tuple[str, str]:
    """Return the default planner for a problem, and the reason for the choice."""
    if problem.closed_chain:
        return "roadmap", "trees and cells in turns; no roadmap is made of closed chains"
    if any(isinstance(region, TaskSpaceRegionChain) for region in problem.constraint):
        return (
            "birrt",
            "the hand holds a mechanism, where roadmap was measured on ten problems only",
        )
    return (
        "roadmap",
        "less work than birrt on most problems; if it finds no path, birrt and cells search on",
    )


def require_fit(method: Method, problem: PlanningProblem) -> None:
    """Refuse a planner that cannot solve a problem; the error names planners that can."""
    reason = method.incompatibility(problem)
    if reason:
        others = [
            name
            for name, one in PLANNERS.items()
            if one.weights is None and not one.incompatibility(problem)
        ]
        raise InvalidInputError(f"{method.name}: {reason}; planners that can: {', '.join(others)}")
