"""Predictors of a learned sampler: codes of a query, or polylines from its start to goals.

The scene transformer and the authors' architecture predict codes. The other predictors are
ablations, which replace a part of the prediction, and bounds.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cvqmpt_lab.search.anytime import short_path, unconstrained_path
from cvqmpt_lab.search.planner_interface import Observation, Proposal, Query
from cvqmpt_lab.search.result import Timings
from cvqmpt_lab.vqmpt.sequence_predictor import SequencePredictor


@dataclass(frozen=True, eq=False)
class CodeProposal(Proposal):
    """A proposal with the codes that its distribution is made of."""

    codes: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (c,)
    goals: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))  # (k, n) [rad or m]
    # (s, n) [rad or m] each, from the start to a goal: nodes of a sequence, or states of a path
    polylines: tuple[np.ndarray, ...] = ()
    # (m, 3) [m], with which draws are compared; None: they are not
    cloud: np.ndarray | None = None


# predicts codes; the distribution is uniform until the codes are decoded
CodePredictor = Callable[[Query, Observation], CodeProposal]


def ranked_goals(
    predictor: SequencePredictor, query: Query, observation: Observation
) -> tuple[Any, np.ndarray, Timings]:
    """Return the encoded scene, the goals by predicted cost, and the times of both.

    Args:
        predictor: a sequence model.
        query: start and goals.
        observation: the cloud.
    """
    assert observation.cloud is not None
    began = query.deadline.seconds
    scene = predictor.encode(observation.cloud, observation.use_cache)
    encoded = query.deadline.seconds
    goals = predictor.by_cost(scene, query.start, query.goals)
    return scene, goals, Timings(encoded - began, query.deadline.seconds - encoded)


def network_codes(
    predictor: SequencePredictor,
    all_beams: bool,
    nodes: np.ndarray,
    query: Query,
    observation: Observation,
    most_goals: int = 3,
) -> CodeProposal:
    """Predict sequences of codes to the cheapest goals, by beam search (K = 3).

    Args:
        predictor: a sequence model.
        all_beams: use all hypotheses of the beam, not only the likeliest.
        nodes: (N, n) [rad or m], a configuration for each code.
        query: start and goals.
        observation: the cloud.
        most_goals: maximum number of goals for which sequences are predicted; the search gets all.
    """
    scene, ranked, timings = ranked_goals(predictor, query, observation)
    began, goals = query.deadline.seconds, ranked[:most_goals]
    beams = predictor.hypotheses(scene, query.start, goals, every=all_beams)
    most = None if all_beams else 1
    codes: list[int] = []
    polylines = []
    for beam, goal in zip(beams, goals, strict=True):
        for sequence in beam[:most]:
            if sequence.finished:
                codes += sequence.codes
                polylines.append(np.vstack([query.start, nodes[list(sequence.codes)], goal]))
    if not predictor.published:
        codes = list(dict.fromkeys(codes))
    return CodeProposal(
        query.uniform,
        timings + Timings(predict=query.deadline.seconds - began),
        f"codes: {len(codes)}, sequences: {len(polylines)}, goals: {len(goals)}",
        codes=np.array(codes, dtype=np.int64),
        goals=goals,
        polylines=tuple(polylines),
    )


def random_codes(
    codes: int, query: Query, observation: Observation, count: int = 12
) -> CodeProposal:
    """Draw random codes of the dictionary, as an ablation of the prediction.

    Args:
        codes: number of codes of the dictionary.
        query: start and goals.
        observation: not used.
        count: number of codes to draw, about as many as predictors give.
    """
    drawn = query.rng.choice(codes, min(count, codes), replace=False)
    detail, goals = f"codes at random: {len(drawn)}", query.nearest_goals(3)
    return CodeProposal(query.uniform, detail=detail, codes=drawn, goals=goals)


def oracle_codes(
    codes_of: Callable[[np.ndarray], np.ndarray],
    query: Query,
    observation: Observation,
    spacing: float = 0.2,
) -> CodeProposal:
    """Plan an unconstrained path of the same problem and return its codes: an upper bound.

    Args:
        codes_of: returns the codes (b,) of configurations (b, n).
        query: start and goals; its budget includes the planning of the path.
        observation: not used.
        spacing: distance between the waypoints that are encoded [rad].
    """
    began = query.deadline.seconds
    path, plan = unconstrained_path(query)
    found = CodeProposal(query.uniform, vertices=plan.vertices)
    if path is None:
        return replace(found, detail="no unconstrained path", failure=plan.status)
    codes = np.unique(codes_of(path.spaced(spacing)))
    timings = Timings(predict=query.deadline.seconds - began)
    detail = f"codes of an unconstrained path: {len(codes)}"
    goals = path.states[-1:]
    return replace(
        found, timings=timings, detail=detail, codes=codes, goals=goals, polylines=(path.states,)
    )


def solved_path(query: Query, observation: Observation, tries: int = 6) -> CodeProposal:
    """Solve the problem `tries` times and return the shortest path: a bound.

    The time of these searches counts, their work (checks and projections) does not.
    """
    space = query.space.again()
    paths = []
    for _ in range(tries):
        if query.deadline.spent():
            break
        path, _ = short_path(space, query, query.deadline.rest())
        if path is not None:
            paths.append(path)
    if not paths:
        return CodeProposal(query.uniform)
    states = min(paths, key=lambda path: path.length).states
    return CodeProposal(query.uniform, goals=states[-1:], polylines=(states,))


def straight_lines(query: Query, goals: np.ndarray) -> CodeProposal:
    """Return straight lines from the start to goals (k, n); collisions are not checked."""
    lines = tuple(np.stack([query.start, goal]) for goal in goals)
    return CodeProposal(query.uniform, goals=goals, polylines=lines)


def lines_to_nearest_goals(query: Query, observation: Observation) -> CodeProposal:
    """Return straight lines to the three nearest goals."""
    return straight_lines(query, query.nearest_goals(3))


def lines_to_predicted_goals(
    predict: CodePredictor, query: Query, observation: Observation
) -> CodeProposal:
    """Return straight lines to the goals that a predictor chooses: ablation of its codes."""
    found = predict(query, observation)
    return replace(straight_lines(query, found.goals), timings=found.timings)
