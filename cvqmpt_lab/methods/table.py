"""The methods by name: the columns of the paper's tables, ours, and controls that isolate one part each."""

from collections.abc import Callable, Mapping
from types import ModuleType

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.methods.method import Method, Stages, Weights
from cvqmpt_lab.planning.around_path import AroundPath, StraightLine, UnconstrainedPath
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


def _cvq(name: str, update: int | None = None, wrong: bool = False, **settings: object) -> Method:
    """CVQ-MPT with predictor settings of its own; Opt-CVQ-MPT after `update` steps."""
    return _learned(name, lambda learned: learned.predicted(name, update, wrong, **settings))


def _roadmap_mixture(name: str, **options: bool) -> Method:
    return _learned(name, lambda learned: learned.roadmap_mixture(name, **options))


def _straight_line(name: str, uniform_share: float) -> Method:
    return Method.simple(name, predict=StraightLine(AroundPath(name, uniform_share=uniform_share)))


def _by_name(*methods: Method) -> Mapping[str, Method]:
    return {method.name: method for method in methods}


PLANNERS = _by_name(
    Method.simple("birrt"),
    Method.simple("guided-birrt", predict=UnconstrainedPath(AroundPath("guide").mixture)),
    _ompl("ompl-projected", "projected"),
    _ompl("atlas-rrt", "atlas"),
    _ompl("tb-rrt", "tangent-bundle"),
    _learned("mpnet", lambda learned: learned.mpnet, "mpnet"),
    _cvq("cvq-mpt"),
    _cvq("opt-cvq-mpt", update=5),
    _learned("roadmap-cvq", lambda learned: learned.roadmap_path()),
)

CONTROLS = _by_name(
    _straight_line("straight-line", 0.15),
    _straight_line("straight-line-only", 0.0),
    _roadmap_mixture("roadmap-sampler", check=True),
    _roadmap_mixture("roadmap-blind", check=False),
    _roadmap_mixture("roadmap-head", check=False, head=True),
    _roadmap_mixture("roadmap-update", check=True, update=True),
    _learned("roadmap-wrong-cloud", lambda learned: learned.roadmap_path(wrong=True)),
    _learned("true-codes", lambda learned: learned.true_codes("true-codes")),
    _cvq("cvq-wrong-cloud", wrong=True),
    _cvq("cvq-union", decoding="sampled"),
    _cvq("cvq-as-predicted", std_floor=None, uniform_share=0.0),
    _learned("cvq-as-published", lambda learned: learned.as_published("cvq-as-published")),
    _cvq("cvq-no-goal-gaussian", goal_gaussian=False),
    _cvq("cvq-no-uniform", uniform_share=0.0),
    _cvq("opt-1-step", update=1),
    _cvq("opt-20-steps", update=20),
)

WITHOUT_WEIGHTS = tuple(name for name, method in {**PLANNERS, **CONTROLS}.items() if method.weights is None)


def planner_named(name: str, model: str | None = None) -> Method:
    """The planner or control of that name, on the weights of a name or folder, or the shipped ones.

    Raises
    ------
    UnknownChoiceError
        Listing the names.
    InvalidInputError
        When a model is given to a method without weights.
    """
    found = PLANNERS.get(name) or CONTROLS.get(name)
    if found is None:
        raise UnknownChoiceError("planner", name, [*PLANNERS, *CONTROLS])
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
