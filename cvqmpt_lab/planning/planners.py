"""Planners by name: those of the paper's tables, ours, and controls.

A control differs from a planner in one part, to measure what this part contributes. Modules in
`PLANNER_MODULES` register planners of their own: this file does not know learned samplers.
"""

import math
from collections.abc import Iterable
from dataclasses import replace
from importlib import import_module

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegionChain
from cvqmpt_lab.external.door import (
    entry_point_names,
    external_planner,
    is_external,
    refuse_clash,
)
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.cell_trees import CellSearch
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import Stages
from cvqmpt_lab.search.portfolio import roadmap_planner, spread_nodes

PLANNER_MODULES = tuple(
    import_module(name) for name in ("cvqmpt_lab.vqmpt.planners", "cvqmpt_lab.benchmarks.ablations")
)
"""Modules that add planners: functions `planners()`, `controls()` and `unshipped_planners()` return
lists of methods, where a module has them; `planner_of(name)` makes one of a composed name."""


def _ompl(name: str, manifold: str, kpiece: bool = False) -> Method:
    def build(problem: PlanningProblem, model: str) -> Stages:
        from cvqmpt_lab.search.ompl_planners import OmplSearch  # ompl takes 0.3 s to import

        return Stages(search=OmplSearch(manifold, kpiece))

    return Method(name, build, needs_charts=manifold != "projected", grows=False)


def _by_name(methods: Iterable[Method]) -> dict[str, Method]:
    return {method.name: method for method in methods}


def _registered(function: str) -> list[Method]:
    """Return the methods of all `PLANNER_MODULES` that have a function of this name."""
    return [method for source in PLANNER_MODULES for method in getattr(source, function, list)()]


PLANNERS = _by_name(
    (
        Method.simple("birrt"),
        # Algorithm 3 without a limit of extensions, as it is printed; `birrt` has the best tuning
        Method.simple("birrt-printed", search=BiRRT(reach=math.inf)),
        replace(Method.simple("cells", search=CellSearch()), grows=False),  # for narrow passages
        _ompl("ompl-projected", "projected"),
        _ompl("atlas-rrt", "atlas"),
        _ompl("tb-rrt", "tangent-bundle"),
        _ompl("ompl-bkpiece", "projected", kpiece=True),
        roadmap_planner("roadmap", spread_nodes),
        *_registered("planners"),
    )
)
CONTROLS = _by_name(_registered("controls"))
UNSHIPPED = _by_name(_registered("unshipped_planners"))

# names that other libraries have for planners, and ours of that kind
_NAMES_ELSEWHERE = {
    **dict.fromkeys(
        ("rrtconnect", "rrt", "cbirrt", "cbirrt2"),
        "'birrt', or OMPL's 'ompl-projected', the paper's CBiRRT",
    ),
    **dict.fromkeys(("prm", "lazyprm", "prmstar"), "'roadmap'"),
    **dict.fromkeys(("cvqmpt", "vqmpt"), "'cvq-mpt' or 'opt-cvq-mpt'"),
}


def planner_named(name: str, model: str | None = None, reach: float | None = None) -> Method:
    """The planner or control of that name, also an external one, see `cvqmpt_lab.external`.

    Args:
        name: of the planner.
        model: name or folder of its weights; None for the shipped ones.
        reach: longest extension towards a draw [rad], inf for no limit; None for the planner's own.
    """
    plain = name.lower().replace("-", "").replace("_", "")
    if plain in _NAMES_ELSEWHERE and name not in PLANNERS:
        raise InvalidInputError(
            f"unknown planner {name!r}; did you mean {_NAMES_ELSEWHERE[plain]}?"
        )
    ours = {**PLANNERS, **CONTROLS, **UNSHIPPED}
    refuse_clash(name, ours)
    found = ours.get(name) or _composed(name)
    if found is None and is_external(name):
        planner = external_planner(name)
        found = Method(name, planner.stages, external=planner.made_by, grows=False)
    if found is None:
        known = ["package.module:planner", *ours, "cvq:random+wide", *entry_point_names()]
        raise UnknownChoiceError("planner", name, known)
    found = found if model is None else found.with_model(model)
    return found if reach is None else found.with_reach(reach)


def _composed(name: str) -> Method | None:
    """The planner that one of `PLANNER_MODULES` makes of a name, or None."""
    for source in PLANNER_MODULES:
        found = source.planner_of(name)
        if found is not None:
            return found
    return None


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
