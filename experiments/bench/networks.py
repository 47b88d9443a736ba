"""What the networks of `cvq-mpt` and `opt-cvq-mpt` take, by the clock of this process."""

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from cvqmpt_lab.methods.learned import GOALS
from cvqmpt_lab.methods.observation import Observer
from cvqmpt_lab.prediction.cloud_encoder import checked_cloud
from cvqmpt_lab.prediction.compact_network import CompactNetwork
from cvqmpt_lab.prediction.latent_optimizer import LatentOptimizer
from cvqmpt_lab.prediction.predictor import Predictor
from cvqmpt_lab.prediction.weights import load_vq_mpt
from cvqmpt_lab.problem import PlanningProblem
from experiments.bench.timing import Figure, calibration, spread

REPEATS = 5


def bench_networks(problems: list[PlanningProblem]) -> list[Figure]:
    """A cloud encoded, sequences to the nearest goals predicted in a known scene, their codes updated."""
    robot = problems[0].robot
    model, observer, rng = load_vq_mpt(robot), Observer(), np.random.default_rng(0)
    network, predictor = CompactNetwork(model), Predictor(model, robot)
    optimizer = LatentOptimizer(predictor)
    encode: list[float] = []
    predict: list[float] = []
    update: list[float] = []
    for problem in problems:
        cloud = checked_cloud(observer(problem))
        near = np.linalg.norm(problem.goals - problem.start, axis=1)
        goals = problem.goals[np.argsort(near)[:GOALS]]
        prediction = predictor.predict(cloud, problem.start, goals, rng)
        for _ in range(REPEATS):
            encode.append(_milliseconds(partial(network.encode_scene, cloud)))
            predict.append(_milliseconds(partial(predictor.predict, cloud, problem.start, goals, rng)))
            update.append(_milliseconds(partial(optimizer.optimize, prediction, problem.manifold, rng)))
    return [
        calibration(),
        spread(f"encoding a cloud of {len(cloud)} points", np.array(encode), "ms"),
        spread(f"prediction of sequences to {GOALS} goals", np.array(predict), "ms"),
        spread(f"latent update, {optimizer.settings.steps} steps", np.array(update), "ms"),
    ]


def _milliseconds(call: Callable[[], object]) -> float:
    began = time.process_time()
    call()
    return 1e3 * (time.process_time() - began)
