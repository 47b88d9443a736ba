"""Sentences of the paper about its numbers, as declarations."""

from dataclasses import dataclass

from paper_tables.measures import REFERENCE

PAPERS_PLANNERS = ("cvq-mpt", "opt-cvq-mpt")
PAPERS_BASELINES = ("ompl-projected", "atlas-rrt", "tb-rrt")
AGAINST = (*PAPERS_BASELINES, REFERENCE)  # and our search with uniform samples


@dataclass(frozen=True)
class Statement:
    """`planner` needs `stated` (a fraction; 0: any) less of `metric` than each baseline.

    Without baselines: at least the fraction `stated` of its runs are what `metric` says (see `judging.SHARES`).
    """

    text: str
    metric: str  # of `measures.VALUES`
    stated: float = 0.0
    planner: str = "opt-cvq-mpt"
    baselines: tuple[str, ...] = ()
    published: str | None = None  # the paper's metric, where ours has another name


def _of_both(
    text: str, metric: str, stated: float = 0.0, published: str | None = None
) -> tuple[Statement, ...]:
    return tuple(Statement(text, metric, stated, planner, AGAINST, published) for planner in PAPERS_PLANNERS)


SOLVED = (
    Statement("solves 97.63 %", "accuracy", 0.9763, "cvq-mpt"),
    Statement("solves 98.42 %", "accuracy", 0.9842, "opt-cvq-mpt"),
)
FASTER = (
    *_of_both("plans in half the time", "time", 0.5),
    *_of_both("plans in half the time at the paper's cost of work", "paper_cost", 0.5, "time"),
)
SHORTER = _of_both("plans paths 35 % shorter", "path_length", 0.35)
FEWER = _of_both("needs fewer vertices", "vertices")
UPDATE = tuple(
    Statement(text, metric, baselines=("cvq-mpt",))
    for metric, text in {
        "projections": "needs fewer projections",
        "newton_iterations": "needs fewer Newton iterations",
        "time": "plans faster",
    }.items()
)
ABOUT_PLACE_TASK = (*SOLVED, *FASTER, *SHORTER, *FEWER, *UPDATE)

PLANNING_TIME = Statement("reduces planning time by 45 %", "planning_time", 0.45, baselines=PAPERS_BASELINES)
EXECUTION_TIME = Statement(
    "reduces execution time by 18 %", "execution_time", 0.18, baselines=PAPERS_BASELINES
)
ABOUT_MULTI_SEQUENCE = (PLANNING_TIME, EXECUTION_TIME)

ABOUT_SENSOR = (
    *_of_both("outperforms in planning time", "time"),
    *_of_both("outperforms in vertices", "vertices"),
    *_of_both("outperforms in path length", "path_length"),
)
"""The paper: "CVQ-MPT and Opt-CV-MPT outperform traditional planners, similar to the Place Task experiment". """
SENSED = tuple(
    Statement(text, metric, 1.0, planner)
    for planner in PAPERS_PLANNERS
    for metric, text in {"accuracy": "solves all scenes", "true_free": "plans paths free in truth"}.items()
)
PREDICTED = "the codes as predicted"
UPDATED = Statement("draws from codes with less G(q)", "g", 0.0, baselines=(PREDICTED,))
