"""Who predicts the codes of a learned sampler: the transformer, the authors' network, a graph search, or controls."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.search.guides import unconstrained_path
from cvqmpt_lab.search.query import Observation, Query
from cvqmpt_lab.vqmpt.learned_sampler import PredictedCodes, union
from cvqmpt_lab.vqmpt.predictor import Predictor
from cvqmpt_lab.vqmpt.sampler import CodeRoadmap, CodeSequences
from cvqmpt_lab.vqmpt.scene_predictor import SceneTransformerPredictor

GOALS = 3  # that a network is asked about; the search gets them all
RANDOM_CODES = 12  # about as many as the other predictors give
SPACING = 0.2  # [rad] between waypoints of a path whose codes are taken


@dataclass(frozen=True, eq=False)
class TransformerCodes:
    """Sequences to the goals with the cheapest ways to them, by beam search (K = 3): the likeliest, or all beams."""

    predictor: SceneTransformerPredictor
    all_beams: bool = False

    def __call__(self, query: Query, observation: Observation) -> PredictedCodes:
        """Look at the cloud, rank the goals, decode."""
        assert observation.cloud is not None
        began = query.deadline.seconds
        scene = self.predictor.encode(observation.cloud, observation.use_cache)
        encoded = query.deadline.seconds
        order = self.predictor.rank(scene, query.start, query.goals)
        goals = query.goals[order[:GOALS]]
        beams = self.predictor.hypotheses(scene, query.start, goals, every=self.all_beams)
        most = None if self.all_beams else 1
        found = [sequence for beam in beams for sequence in beam[:most] if sequence.finished]
        codes = union([sequence.codes for sequence in found])
        detail = f"{len(codes)} codes of {len(found)} sequences to {len(goals)} goals"
        return PredictedCodes(codes, goals, detail, encoded - began, query.deadline.seconds - encoded)


@dataclass(frozen=True, eq=False)
class PublishedCodes:
    """The sequences of the authors' network to the nearest goals, by their beam search; repeated codes count."""

    predictor: Predictor

    def __call__(self, query: Query, observation: Observation) -> PredictedCodes:
        """Predict."""
        assert observation.cloud is not None
        goals = query.nearest_goals(GOALS)
        found = self.predictor.predict(observation.cloud, query.start, goals, observation.use_cache)
        lost = len(found.unfinished)
        detail = f"{len(found.codes)} codes" + (f", none to {lost} of {len(goals)} goals" if lost else "")
        return PredictedCodes(found.codes, goals, detail, found.encode_seconds, found.predict_seconds)


@dataclass(frozen=True, eq=False)
class GraphCodes:
    """The cheapest sequences on the dictionary's roadmap to any goal, by Dijkstra's algorithm on edge costs."""

    roadmap_of: Callable[[Query], CodeRoadmap]  # for the query's robot and what it carries

    def __call__(self, query: Query, observation: Observation) -> PredictedCodes:
        """Cost the edges, search."""
        assert observation.cloud is not None
        began = query.deadline.seconds
        roadmap = self.roadmap_of(query)
        before = roadmap.clearances_read
        roadmap.edge_costs(observation.cloud, observation.use_cache)
        encoded = query.deadline.seconds
        found = CodeSequences(roadmap, observation.cloud, query.start, query.goals).cheapest()
        query.space.count_clearances(roadmap.clearances_read - before)
        codes, goals = union(found), query.nearest_goals(GOALS)
        detail = f"{len(found)} sequences of {len(codes)} codes"
        return PredictedCodes(codes, goals, detail, encoded - began, query.deadline.seconds - encoded)


@dataclass(frozen=True)
class RandomCodes:
    """Codes drawn without looking: what any codes of the dictionary are worth."""

    codes: int  # in the dictionary

    def __call__(self, query: Query, observation: Observation) -> PredictedCodes:
        """Draw."""
        drawn = query.rng.choice(self.codes, min(RANDOM_CODES, self.codes), replace=False)
        return PredictedCodes(drawn, query.nearest_goals(GOALS), f"{len(drawn)} codes at random")


@dataclass(frozen=True, eq=False)
class OracleCodes:
    """Codes of an unconstrained path of the very problem, planned and paid for first: a model that never errs."""

    codes_of: Callable[[np.ndarray], np.ndarray]  # of configurations (b, n) along a path

    def __call__(self, query: Query, observation: Observation) -> PredictedCodes:
        """Plan, shorten, encode."""
        began = query.deadline.seconds
        path, plan = unconstrained_path(query)
        if path is None:
            none = np.empty(0, dtype=np.int64)
            return PredictedCodes(
                none, query.goals[:0], "no unconstrained path", vertices=plan.vertices, failure=plan.status
            )
        codes = np.unique(self.codes_of(path.spaced(SPACING)))
        detail, seconds = f"{len(codes)} codes of an unconstrained path", query.deadline.seconds - began
        return PredictedCodes(codes, path.states[-1:], detail, 0.0, seconds, plan.vertices)
