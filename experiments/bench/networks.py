"""What `cvq-mpt` takes to see a scene and predict sequences, and the paper's update of their codes (CPU time)."""

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from cvqmpt_lab.methods.loaded import seen_dictionary
from cvqmpt_lab.methods.sequences import STEPS
from cvqmpt_lab.methods.table import planner_named
from cvqmpt_lab.planning.code_graph import SeenGraph
from cvqmpt_lab.planning.proposal import Observation
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from experiments.bench.timing import Figure, calibration, spread

REPEATS = 5
ENOUGH = Budget(seconds=60.0)


def bench_networks(problems: list[PlanningProblem]) -> list[Figure]:
    """A cloud looked at as if new, sequences to all goals predicted in a known scene, their codes updated."""
    method, rng = planner_named("opt-algorithm-2"), np.random.default_rng(0)
    see: list[float] = []
    predict: list[float] = []
    update: list[float] = []
    for problem in problems:
        stages, space = method.stages(problem), ConstrainedSpace(problem)
        assert stages.observe is not None and stages.update is not None and method.weights is not None
        cloud = stages.observe(problem)
        seen = seen_dictionary(method.weights, problem.robot, problem.attachments)
        for _ in range(REPEATS):
            see.append(_milliseconds(partial(_look, seen, cloud)))
            query = Query.of(space, ENOUGH, rng)
            predict.append(_milliseconds(partial(stages.predict, query, Observation(cloud))))
            proposal = stages.predict(query, Observation(cloud))
            update.append(_milliseconds(partial(stages.update, query, proposal)))
    return [
        calibration(),
        spread(f"a new cloud of {len(cloud)} points seen", np.array(see), "ms"),
        spread("prediction of sequences to all goals", np.array(predict), "ms"),
        spread(f"latent update, {STEPS} steps", np.array(update), "ms"),
    ]


def _look(seen: SeenGraph, cloud: np.ndarray) -> None:
    seen.eyes.look(cloud, anew=True)
    seen.prices(cloud, anew=True)


def _milliseconds(call: Callable[[], object]) -> float:
    began = time.process_time()
    call()
    return 1e3 * (time.process_time() - began)
