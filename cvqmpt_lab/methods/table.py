"""The methods by name: the columns of the paper's tables, ours, and controls that isolate one part each."""

from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.methods.method import Method, Stages, Weights
from cvqmpt_lab.planning.around_path import AroundPath, SolvedPaths, StraightLine, UnconstrainedPath
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot


def _ompl(name: str, manifold: str) -> Method:
    def build(robot: Robot, weights: Weights | None) -> Stages:
        from cvqmpt_lab.planning.ompl_planners import OmplSearch  # ompl takes 0.3 s to import

        return Stages(search=OmplSearch(manifold))

    return Method(name, build, needs_constraint=True)


def _learned(name: str, of: Callable[[ModuleType], Callable[..., Stages]], kind: str = "vq_mpt") -> Method:
    """A method whose builder is looked up in the module of learned stages when it is first used."""

    def build(robot: Robot, weights: Weights | None) -> Stages:
        from cvqmpt_lab.methods import learned  # torch takes 2 s to import

        return of(learned)(robot, weights)

    return Method(name, build, Weights(kind))


def _sequences(name: str, cloud: str | None = None, **options: Any) -> Method:
    """CVQ-MPT by sequences on the dictionary's graph; cloud: name of a function of `methods.loaded`."""

    def build(robot: Robot, weights: Weights | None) -> Stages:
        from cvqmpt_lab.methods import loaded, sequences

        assert weights is not None
        shown = None if cloud is None else getattr(loaded, cloud)
        return sequences.sequences(name, cloud=shown, **options)(robot, weights)

    return Method(name, build, Weights("vq_mpt"))


def _straight_line(name: str, uniform_share: float) -> Method:
    return Method.simple(name, predict=StraightLine(AroundPath(name, uniform_share=uniform_share)))


def _by_name(*methods: Method) -> Mapping[str, Method]:
    return {method.name: method for method in methods}


PLANNERS = _by_name(
    Method.simple("birrt"),
    _ompl("ompl-projected", "projected"),
    _ompl("atlas-rrt", "atlas"),
    _ompl("tb-rrt", "tangent-bundle"),
    _learned("mpnet", lambda learned: learned.mpnet, "mpnet"),
    _sequences("cvq-mpt"),
    _sequences("opt-cvq-mpt", early=True),
    _learned("roadmap-cvq", lambda learned: learned.roadmap_path()),
)

CONTROLS = _by_name(
    Method.simple("guided-birrt", predict=UnconstrainedPath(AroundPath("guide").mixture)),
    _straight_line("straight-line", 0.15),
    _straight_line("straight-line-only", 0.0),
    _learned("roadmap-wrong-cloud", lambda learned: learned.roadmap_path(wrong=True)),
    _learned("roadmap-no-cloud", lambda learned: learned.roadmap_path(blind=True)),
    _learned("roadmap-true-edges", lambda learned: learned.roadmap_path(told=True)),
    Method.simple("solved-paths", predict=SolvedPaths(AroundPath("solved-paths", std=0.25))),
    _learned("true-codes", lambda learned: learned.true_codes("true-codes")),
    _sequences("cvq-wrong-cloud", cloud="another_scene"),
    _sequences("cvq-no-cloud", cloud="no_cloud"),
    _sequences("cvq-no-uniform", uniform_share=0.0),
    _sequences("opt-algorithm-2", update=5),
)

PUBLISHED = _by_name(_learned("cvq-as-published", lambda learned: learned.as_published("cvq-as-published")))
"""On imported weights of the authors' architecture alone."""

REMOVED = {
    "cvq-route": "roadmap-cvq",
    "opt-cvq-route": "roadmap-cvq",
    "cvq-cheapest": "cvq-mpt",
    "cvq-constraint-trained": "opt-cvq-mpt",
    "route-constraint-trained": "roadmap-cvq",
    "route-wrong-cloud": "roadmap-wrong-cloud",
    "route-no-cloud": "roadmap-no-cloud",
    "route-cheapest": "roadmap-cvq",
    "roadmap-blind": "roadmap-no-cloud",
    "roadmap-sampler": "roadmap-cvq",
    "roadmap-update": "opt-algorithm-2",
}
"""Planners and controls that are gone, and what replaces each."""

WITHOUT_WEIGHTS = tuple(name for name, method in {**PLANNERS, **CONTROLS}.items() if method.weights is None)


def planner_named(name: str, model: str | None = None) -> Method:
    """The planner or control of that name, on the weights of a name or folder, or the shipped ones.

    Raises
    ------
    UnknownChoiceError
        Listing the names.
    InvalidInputError
        When a model is given to a method without weights, or the planner was removed.
    """
    found = PLANNERS.get(name) or CONTROLS.get(name) or PUBLISHED.get(name)
    if name in REMOVED:
        raise InvalidInputError(f"planner {name} was removed; use {REMOVED[name]}")
    if found is None:
        raise UnknownChoiceError("planner", name, [*PLANNERS, *CONTROLS, *PUBLISHED])
    return found if model is None else found.with_model(model)


def require_fit(method: Method, problem: PlanningProblem) -> None:
    """Refuse a problem that a method cannot serve.

    Raises
    ------
    InvalidInputError
        Saying why, and which planners can.
    """
    reason = method.unfit(problem)
    if reason:
        others = [name for name in PLANNERS if name in WITHOUT_WEIGHTS and not PLANNERS[name].unfit(problem)]
        raise InvalidInputError(f"{method.name}: {reason}; planners that can: {', '.join(others)}")
