"""The planners by name."""

from collections.abc import Callable, Mapping

from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.guided import GuidedBiRRT
from cvqmpt_lab.planning.planner import Planner


def _ompl(name: str, manifold: str) -> Callable[[], Planner]:
    def make() -> Planner:
        from cvqmpt_lab.planning.ompl_planners import OmplPlanner  # ompl takes 0.3 s to import

        return OmplPlanner(name, manifold)

    return make


PLANNERS: Mapping[str, Callable[[], Planner]] = {
    "birrt": BiRRT,
    "guided-birrt": GuidedBiRRT,
    "ompl-projected": _ompl("ompl-projected", "projected"),
    "atlas-rrt": _ompl("atlas-rrt", "atlas"),
    "tb-rrt": _ompl("tb-rrt", "tangent-bundle"),
}


def planner_named(name: str) -> Planner:
    """The planner of that name; UnknownChoiceError lists the names."""
    if name not in PLANNERS:
        raise UnknownChoiceError("planner", name, PLANNERS)
    return PLANNERS[name]()
