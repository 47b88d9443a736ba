"""What the shipped networks compute in numpy, computed in torch: states along sequences, codes, what is free."""

from functools import cache

import numpy as np
import torch

from cvqmpt_lab.methods.observation import Observer
from cvqmpt_lab.models.checkpoint import Checkpoint, as_modules
from cvqmpt_lab.models.compact.sequence_model import CompactSequenceModel
from cvqmpt_lab.models.stored import StoredModel
from cvqmpt_lab.prediction.code_encoder import CodeEncoder
from cvqmpt_lab.prediction.collision_head import CollisionHead
from cvqmpt_lab.prediction.compact_network import CompactNetwork
from cvqmpt_lab.prediction.configurations import ModelConfigurations
from cvqmpt_lab.prediction.weights import load_vq_mpt
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import panda

LENGTH = 20
"""Codes of a sequence."""
FAR = 1e-4
"""Numbers of order 1 that differ by more differ by more than rounding in 32 bits."""


@cache
def _model() -> tuple[StoredModel, Checkpoint]:
    stored = load_vq_mpt(panda())
    return stored, as_modules(stored)


@torch.inference_mode()
def networks_differ(problem: PlanningProblem, states: int, seed: int) -> list[str]:
    """Random sequences and configurations, in the cloud that cameras see of a problem, on which the two differ."""
    rng, cloud = np.random.default_rng(seed), Observer()(problem).astype(np.float32)
    (stored, modules), rows = _model(), -(-states // LENGTH)
    q = problem.robot.random_configurations(rng, 2 * rows)
    of = ModelConfigurations(stored, problem.robot).of(q)
    codes = rng.integers(stored.config.dictionary.n_codes, size=(rows, LENGTH))
    model, ends = modules.sequence_model, torch.from_numpy(of)
    assert isinstance(model, CompactSequenceModel)
    scene, of_ends = model.encode_scene([torch.from_numpy(cloud)]), modules.dictionary.encode(ends[None])[0]
    start_goal_codes = of_ends.view(2, rows).T
    theirs = model(scene, ends[:rows], ends[rows:], torch.from_numpy(codes), start_goal_codes).states.numpy()
    network = CompactNetwork(stored)
    ours = network.states(network.encode_scene(cloud), of[:rows], of[rows:], codes)
    free = torch.sigmoid(model.free_logits(scene, ends[None]))[0].numpy()
    apart = {
        "states of sequence": np.abs(ours - theirs).max(axis=(1, 2)) > FAR,
        "code of configuration": CodeEncoder.of(stored)(of) != of_ends.numpy(),
        "probability of configuration": np.abs(
            CollisionHead(stored, problem.robot).free_probability(cloud, q) - free
        )
        > FAR,
    }
    return [f"{what} {k} differs" for what, which in apart.items() for k in np.flatnonzero(which)]
