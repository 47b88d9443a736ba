"""What the paper says about Table I, judged by rows of the place task."""

from collections.abc import Mapping, Sequence
from operator import attrgetter

from cvqmpt_lab.results.row import ResultRow
from paper_tables.comparison import REFERENCE, Value, paper_cost
from paper_tables.paper_numbers import PublishedValue
from paper_tables.statements import Statement, Verdict, judged, judged_share

PAPERS_PLANNERS = ("cvq-mpt", "opt-cvq-mpt")
AGAINST = ("ompl-projected", "atlas-rrt", "tb-rrt", REFERENCE)
"""The paper's own baselines, and our search with uniform samples."""

VALUES: Mapping[str, Value] = {
    "time": attrgetter("t_total_s"),
    "paper_cost": paper_cost,
    "vertices": attrgetter("vertices"),
    "path_length": attrgetter("path_length_rad"),
    "projections": attrgetter("n_projections"),
    "newton_iterations": attrgetter("n_newton_iterations"),
}
FASTER, SHORTER, FEWER = (
    tuple(
        Statement(text, metric, stated, planner, AGAINST, published)
        for text, metric, stated, published in texts
        for planner in PAPERS_PLANNERS
    )
    for texts in (
        (
            ("plans in half the time", "time", 0.5, None),
            ("plans in half the time at the paper's cost of work", "paper_cost", 0.5, "time"),
        ),
        (("plans paths 35 % shorter", "path_length", 0.35, None),),
        (("needs fewer vertices", "vertices", 0.0, None),),
    )
)
ALGORITHM_2 = "opt-algorithm-2"
UPDATE, PAPERS_UPDATE = (
    tuple(
        Statement(text, metric, 0.0, planner, ("cvq-mpt",))
        for text, metric in (
            ("needs fewer projections", "projections"),
            ("needs fewer Newton iterations", "newton_iterations"),
            ("plans faster", "time"),
        )
    )
    for planner in ("opt-cvq-mpt", ALGORITHM_2)
)
"""Of codes put on the manifold before they are judged, and of the paper's update."""
SOLVED = (
    Statement("solves 97.63 %", "accuracy", 0.9763, "cvq-mpt"),
    Statement("solves 98.42 %", "accuracy", 0.9842, "opt-cvq-mpt"),
)


def solved_verdicts(rows: Sequence[ResultRow]) -> tuple[Verdict, ...]:
    """Verdicts on success."""
    return tuple(verdict for item in SOLVED for verdict in judged_share(item, rows, attrgetter("solved")))


def place_verdicts(rows: Sequence[ResultRow], published: Sequence[PublishedValue]) -> tuple[Verdict, ...]:
    """Verdicts on everything that the paper says about its table."""
    return (*solved_verdicts(rows), *judged((*FASTER, *SHORTER, *FEWER, *UPDATE), rows, published, VALUES))
