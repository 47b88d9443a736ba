"""The planners by name: the columns of the paper's tables, ours, and controls that isolate one part each."""

from collections.abc import Callable, Mapping
from functools import partial

from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.guided import GuidedBiRRT
from cvqmpt_lab.planning.planner import Planner


def _ompl(name: str, manifold: str) -> Callable[[], Planner]:
    def make() -> Planner:
        from cvqmpt_lab.planning.ompl_planners import OmplPlanner  # ompl takes 0.3 s to import

        return OmplPlanner(name, manifold)

    return make


def _learned(maker: str, *arguments: object, **settings: object) -> Callable[[], Planner]:
    def make() -> Planner:
        from cvqmpt_lab.methods import learned  # torch takes 2 s to import

        return getattr(learned, maker)(*arguments, **settings)

    return make


def _updated(name: str, steps: int = 5) -> Callable[[], Planner]:
    def make() -> Planner:
        from cvqmpt_lab.methods.learned import learned_birrt
        from cvqmpt_lab.prediction.latent_optimizer import LatentSettings

        return learned_birrt(name, update=LatentSettings(steps=steps))

    return make


def _straight_line(name: str, uniform_share: float) -> Planner:
    from cvqmpt_lab.methods.controls import StraightLine

    return StraightLine(name, uniform_share)


PLANNERS: Mapping[str, Callable[[], Planner]] = {
    "birrt": BiRRT,
    "guided-birrt": GuidedBiRRT,
    "ompl-projected": _ompl("ompl-projected", "projected"),
    "atlas-rrt": _ompl("atlas-rrt", "atlas"),
    "tb-rrt": _ompl("tb-rrt", "tangent-bundle"),
    "mpnet": _learned("mpnet"),
    "cvq-mpt": _learned("learned_birrt", "cvq-mpt"),
    "opt-cvq-mpt": _updated("opt-cvq-mpt"),
    "roadmap-cvq": _learned("roadmap_cvq"),
}

CONTROLS: Mapping[str, Callable[[], Planner]] = {
    "straight-line": partial(_straight_line, "straight-line", 0.15),
    "straight-line-only": partial(_straight_line, "straight-line-only", 0.0),
    "roadmap-sampler": _learned("roadmap_sampler", "roadmap-sampler", check=True),
    "roadmap-blind": _learned("roadmap_sampler", "roadmap-blind", check=False),
    "roadmap-head": _learned("roadmap_sampler", "roadmap-head", check=False, head=True),
    "roadmap-update": _learned("roadmap_sampler", "roadmap-update", check=True, update=True),
    "true-codes": _learned("true_codes"),
    "cvq-wrong-cloud": _learned("wrong_cloud", "cvq-wrong-cloud"),
    "cvq-union": _learned("learned_birrt", "cvq-union", decoding="sampled"),
    "cvq-as-predicted": _learned("learned_birrt", "cvq-as-predicted", std_floor=None, uniform_share=0.0),
    "cvq-no-goal-gaussian": _learned("learned_birrt", "cvq-no-goal-gaussian", goal_gaussian=False),
    "cvq-no-uniform": _learned("learned_birrt", "cvq-no-uniform", uniform_share=0.0),
    "opt-1-step": _updated("opt-1-step", 1),
    "opt-20-steps": _updated("opt-20-steps", 20),
}

WITHOUT_WEIGHTS = frozenset(
    {
        "birrt",
        "guided-birrt",
        "ompl-projected",
        "atlas-rrt",
        "tb-rrt",
        "straight-line",
        "straight-line-only",
    }
)


def planner_named(name: str) -> Planner:
    """The planner or control of that name; UnknownChoiceError lists the names."""
    for table in (PLANNERS, CONTROLS):
        if name in table:
            return table[name]()
    raise UnknownChoiceError("planner", name, [*PLANNERS, *CONTROLS])
