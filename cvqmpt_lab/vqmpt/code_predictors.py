"""Predictors of a learned sampler: codes, or ways from the start to goals, of a query.

The scene transformer and the authors' architecture predict codes. The others are controls, which
say what a part of a prediction is worth, and bounds.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from cvqmpt_lab.search.anytime import short_path, unconstrained_path
from cvqmpt_lab.search.planner_interface import Observation, Proposal, Query
from cvqmpt_lab.search.result import Timings
from cvqmpt_lab.vqmpt.scene_predictor import SequencePredictor


@dataclass(frozen=True, eq=False)
class CodeProposal(Proposal):
    """A proposal that remembers the codes it is made of."""

    codes: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (c,)
    goals: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))  # (k, n) [rad or m]
    # from the start to each goal (s, n) [rad or m]: over the nodes of a sequence, or a path
    ways: tuple[np.ndarray, ...] = ()


# proposes codes, and uniform samples until these are decoded
CodePredictor = Callable[[Query, Observation], CodeProposal]


def network_codes(
    predictor: SequencePredictor,
    all_beams: bool,
    nodes: np.ndarray,
    query: Query,
    observation: Observation,
    most_goals: int = 3,
) -> CodeProposal:
    """Codes of the sequences to the cheapest goals, by beam search (K = 3).

    Args:
        predictor: a sequence model.
        all_beams: take every hypothesis of the beam, not only the likeliest.
        nodes: (N, n), a configuration for each code [rad or m].
        query: start and goals.
        observation: the cloud.
        most_goals: that the network is asked about; the search gets them all.
    """
    assert observation.cloud is not None
    began = query.deadline.seconds
    scene = predictor.encode(observation.cloud, observation.use_cache)
    encoded = query.deadline.seconds
    goals = predictor.by_cost(scene, query.start, query.goals)[:most_goals]
    beams = predictor.hypotheses(scene, query.start, goals, every=all_beams)
    most = None if all_beams else 1
    by_goal = [
        (sequence, goal)
        for beam, goal in zip(beams, goals, strict=True)
        for sequence in beam[:most]
        if sequence.finished
    ]
    found = [sequence for sequence, _ in by_goal]
    ways = tuple(
        np.vstack([query.start, nodes[list(sequence.codes)], goal]) for sequence, goal in by_goal
    )
    listed = [code for sequence in found for code in sequence.codes]
    if predictor.each_code_once:
        listed = list(dict.fromkeys(listed))
    detail = f"{len(listed)} codes of {len(found)} sequences to {len(goals)} goals"
    timings = Timings(encode=encoded - began, predict=query.deadline.seconds - encoded)
    codes = np.array(listed, dtype=np.int64)
    return CodeProposal(query.uniform, timings, detail, codes=codes, goals=goals, ways=ways)


def random_codes(
    codes: int, query: Query, observation: Observation, count: int = 12
) -> CodeProposal:
    """Random codes of the dictionary: ablation baseline; about as many as predictors give."""
    drawn = query.rng.choice(codes, min(count, codes), replace=False)
    detail, goals = f"{len(drawn)} codes at random", query.nearest_goals(3)
    return CodeProposal(query.uniform, detail=detail, codes=drawn, goals=goals)


def oracle_codes(
    codes_of: Callable[[np.ndarray], np.ndarray],
    query: Query,
    observation: Observation,
    spacing: float = 0.2,
) -> CodeProposal:
    """Codes of an unconstrained path of the same problem, planned first: an upper bound.

    Args:
        codes_of: gives the codes (b,) of configurations (b, n) along a path.
        query: start and goals; planning the path counts.
        observation: not used.
        spacing: between the waypoints whose codes are taken [rad].
    """
    began = query.deadline.seconds
    path, plan = unconstrained_path(query)
    found = CodeProposal(query.uniform, vertices=plan.vertices)
    if path is None:
        return replace(found, detail="no unconstrained path", failure=plan.status)
    codes = np.unique(codes_of(path.spaced(spacing)))
    timings = Timings(predict=query.deadline.seconds - began)
    detail = f"{len(codes)} codes of an unconstrained path"
    ways, goals = (path.states,), path.states[-1:]
    return replace(found, timings=timings, detail=detail, codes=codes, goals=goals, ways=ways)


def solved_way(query: Query, observation: Observation, tries: int = 6) -> CodeProposal:
    """The shortest of six solutions of the problem: a bound. Its time counts, its work does not."""
    aside, found = query.space.again(), CodeProposal(query.uniform)
    paths = []
    for _ in range(tries):
        if query.deadline.spent():
            break
        paths.append(short_path(aside, query, query.deadline.rest())[0])
    solved = [path for path in paths if path is not None]
    if not solved:
        return found
    states = min(solved, key=lambda path: path.length).states
    return replace(found, goals=states[-1:], ways=(states,))


def straight_lines(query: Query, goals: np.ndarray) -> CodeProposal:
    """Straight lines from the start to goals (k, n); nothing is checked."""
    ways = tuple(np.stack([query.start, goal]) for goal in goals)
    return CodeProposal(query.uniform, goals=goals, ways=ways)


def lines_to_nearest_goals(query: Query, observation: Observation) -> CodeProposal:
    """Straight lines to the three nearest goals."""
    return straight_lines(query, query.nearest_goals(3))


def lines_to_predicted_goals(
    predict: CodePredictor, query: Query, observation: Observation
) -> CodeProposal:
    """Straight lines to the goals that a predictor chooses: what its choice of goals is worth."""
    found = predict(query, observation)
    return replace(straight_lines(query, found.goals), timings=found.timings)
