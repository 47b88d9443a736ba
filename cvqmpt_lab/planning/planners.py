"""Planners by name: those of the paper's tables, more planners, and controls.

A control differs from a planner in one part, to measure the contribution of this part. Learned
planners and controls are in modules that provide "planners" or "controls" (see
`base.modules.providers`): this file does not depend on them. The first have functions `planners()`
and `unshipped_planners()`, whose weights are not shipped, the others `controls()`; all return
lists of methods. Their function `planner_of(name)` makes a planner from a composed name, or returns
None.
"""

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.base.modules import providers
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegionChain
from cvqmpt_lab.external.names import entry_point_names, is_external, refuse_clash
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.cell_trees import CellSearch
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import Stages
from cvqmpt_lab.search.portfolio import roadmap_planner, spread_nodes


def _ompl(name: str, manifold: str, kpiece: bool = False) -> Method:
    def build(problem: PlanningProblem, model: str) -> Stages:
        from cvqmpt_lab.search.ompl_planners import OmplSearch  # ompl takes 0.3 s to import

        return Stages(search=OmplSearch(manifold, kpiece))

    return Method(name, build, needs_charts=manifold != "projected", grows=False)


def _ompl_uniform(name: str) -> Method:
    """Return the search of `ompl-cvq` with uniform samples."""

    def build(problem: PlanningProblem, model: str) -> Stages:
        from cvqmpt_lab.search.ompl_planners import GOAL_LIMIT, published_search

        return Stages(search=published_search(), goals_apart=True, goal_limits=(GOAL_LIMIT,))

    return Method(name, build, grows=False)


def _by_name(methods: Iterable[Method]) -> dict[str, Method]:
    return {method.name: method for method in methods}


def _provided(part: str, function: str) -> list[Method]:
    """Return the methods that a function of the modules that provide a part returns."""
    return [method for module in providers(part) for method in getattr(module, function)()]


PLANNERS = _by_name(
    (
        Method.simple("birrt"),
        # Algorithm 3 as in the paper, without a limit of extensions; `birrt` has the tuned limit
        Method.simple("birrt-printed", search=BiRRT(reach=math.inf)),
        replace(Method.simple("cells", search=CellSearch()), grows=False),  # for narrow passages
        _ompl("ompl-projected", "projected"),
        _ompl_uniform("ompl-uniform"),
        _ompl("atlas-rrt", "atlas"),
        _ompl("tb-rrt", "tangent-bundle"),
        _ompl("ompl-bkpiece", "projected", kpiece=True),
        roadmap_planner("roadmap", spread_nodes),
        *_provided("planners", "planners"),
    )
)


@cache
def controls() -> dict[str, Method]:
    """Return the controls by name."""
    return _by_name(_provided("controls", "controls"))


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
    ours = PLANNERS
    if name not in ours:
        unshipped = _by_name(_provided("planners", "unshipped_planners"))
        ours = {**PLANNERS, **controls(), **unshipped}
    refuse_clash(name, ours)
    found = ours.get(name) or _composed(name)
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
    """Return the planner that a provider makes from a composed name, or None."""
    for module in (*providers("planners"), *providers("controls")):
        found = module.planner_of(name)
        if found is not None:
            return found
    return None


def default_planner(problem: PlanningProblem) -> tuple[str, str]:
    """Return the default planner for a problem, and the reason for the choice."""
    if problem.closed_chain:
        return "roadmap", "trees and cells in turns; no roadmap is made of closed chains"
    if any(isinstance(region, TaskSpaceRegionChain) for region in problem.constraint):
        return "birrt", "the hand holds a mechanism, for which no roadmap was measured"
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
