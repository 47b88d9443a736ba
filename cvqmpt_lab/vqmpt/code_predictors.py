"""Who predicts the codes of a learned sampler: the transformer, the authors' network, or controls.

Each is given what it predicts with, then what it is asked.
"""

from collections.abc import Callable

import numpy as np

from cvqmpt_lab.search.controls import unconstrained_path
from cvqmpt_lab.search.planner_interface import Observation, Query
from cvqmpt_lab.vqmpt.learned_sampler import PredictedCodes, union
from cvqmpt_lab.vqmpt.predictor import Predictor
from cvqmpt_lab.vqmpt.scene_predictor import SceneTransformerPredictor

GOALS = 3  # that a network is asked about; the search gets them all
RANDOM_CODES = 12  # about as many as the other predictors give
SPACING = 0.2  # [rad] between waypoints of a path whose codes are taken


def transformer_codes(
    predictor: SceneTransformerPredictor, all_beams: bool, query: Query, observation: Observation
) -> PredictedCodes:
    """Sequences to the goals with the cheapest ways to them, by beam search (K = 3):
    the likeliest, or all beams.
    """
    assert observation.cloud is not None
    began = query.deadline.seconds
    scene = predictor.encode(observation.cloud, observation.use_cache)
    encoded = query.deadline.seconds
    order = predictor.rank(scene, query.start, query.goals)
    goals = query.goals[order[:GOALS]]
    beams = predictor.hypotheses(scene, query.start, goals, every=all_beams)
    most = None if all_beams else 1
    found = [sequence for beam in beams for sequence in beam[:most] if sequence.finished]
    codes = union([sequence.codes for sequence in found])
    detail = f"{len(codes)} codes of {len(found)} sequences to {len(goals)} goals"
    return PredictedCodes(codes, goals, detail, encoded - began, query.deadline.seconds - encoded)


def published_codes(predictor: Predictor, query: Query, observation: Observation) -> PredictedCodes:
    """The sequences of the authors' network to the nearest goals, by their beam search;
    repeated codes count.
    """
    assert observation.cloud is not None
    goals = query.nearest_goals(GOALS)
    found = predictor.predict(observation.cloud, query.start, goals, observation.use_cache)
    lost = len(found.unfinished)
    detail = f"{len(found.codes)} codes" + (
        f", none to {lost} of {len(goals)} goals" if lost else ""
    )
    return PredictedCodes(found.codes, goals, detail, found.encode_seconds, found.predict_seconds)


def random_codes(codes: int, query: Query, observation: Observation) -> PredictedCodes:
    """Some of the dictionary's codes, drawn without looking: what any are worth."""
    drawn = query.rng.choice(codes, min(RANDOM_CODES, codes), replace=False)
    return PredictedCodes(drawn, query.nearest_goals(GOALS), f"{len(drawn)} codes at random")


def oracle_codes(
    codes_of: Callable[[np.ndarray], np.ndarray], query: Query, observation: Observation
) -> PredictedCodes:
    """Codes of an unconstrained path of the very problem, planned and paid for first: a model that
    never errs.

    codes_of: gives those of configurations (b, n) along a path.
    """
    began = query.deadline.seconds
    path, plan = unconstrained_path(query)
    if path is None:
        none = np.empty(0, dtype=np.int64)
        return PredictedCodes(
            none,
            query.goals[:0],
            "no unconstrained path",
            vertices=plan.vertices,
            failure=plan.status,
        )
    codes = np.unique(codes_of(path.spaced(SPACING)))
    detail, seconds = f"{len(codes)} codes of an unconstrained path", query.deadline.seconds - began
    return PredictedCodes(codes, path.states[-1:], detail, 0.0, seconds, plan.vertices)
