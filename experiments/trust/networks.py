"""What the shipped networks compute in numpy, computed in torch: codes, Gaussians, what eyes say."""

from functools import cache

import numpy as np
import torch
from torch.nn import functional as F

from cvqmpt_lab.methods.loaded import EYES
from cvqmpt_lab.planning.small_network import SmallNetwork
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.vqmpt.checkpoint import as_modules
from cvqmpt_lab.vqmpt.codebook import CodeDecoder, CodeEncoder, ModelConfigurations, load_vq_mpt
from cvqmpt_lab.vqmpt.dictionary import Dictionary
from cvqmpt_lab.vqmpt.weights import Arrays, StoredModel

FAR = 1e-4
"""Numbers of order 1 that differ by more differ by more than rounding in 32 bits."""
LARGEST = 3.0
"""Of what small networks are asked, which are lengths [rad, m] and prices."""


@cache
def _model() -> tuple[StoredModel, Dictionary]:
    stored = load_vq_mpt(panda())
    return stored, as_modules(stored).dictionary


@torch.inference_mode()
def networks_differ(problem: PlanningProblem, states: int, seed: int) -> list[str]:
    """Random configurations, code vectors and questions on which the two differ."""
    rng, (stored, dictionary) = np.random.default_rng(seed), _model()
    of = ModelConfigurations(stored, problem.robot).of(problem.robot.random_configurations(rng, states))
    z = rng.standard_normal((states, stored.config.dictionary.code_dim)).astype(np.float32)
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    theirs, ours = dictionary.decode(torch.from_numpy(z)), CodeDecoder(stored).decode(z)
    apart = {
        "code of configuration": CodeEncoder.of(stored)(of)
        != dictionary.encode(torch.from_numpy(of)[None])[0].numpy(),
        "mean of code": np.abs(ours.mean - theirs.mean.numpy()).max(1) > FAR,
        "covariance of code": np.abs(ours.covariance - theirs.covariance.numpy()).max((1, 2)) > FAR,
    }
    network = SmallNetwork.of(stored.parts[EYES])
    asked = rng.uniform(0.0, LARGEST, (states, network.inputs))
    answers = _in_torch(stored.parts[EYES], torch.from_numpy(asked).float()).numpy()
    apart["answer of the eyes"] = np.abs(network(asked) - answers) > FAR * np.maximum(1.0, np.abs(answers))
    return [f"{what} {k} differs" for what, which in apart.items() for k in np.flatnonzero(which)]


def _in_torch(arrays: Arrays, asked: torch.Tensor) -> torch.Tensor:
    """Answers (b,) of a small network to questions (b, i)."""
    weights = {name: torch.from_numpy(array) for name, array in arrays.items()}
    hidden = F.linear(asked, weights["first"], weights["first_bias"]).relu()
    hidden = F.linear(hidden, weights["second"], weights["second_bias"]).relu()
    return F.linear(hidden, weights["last"][None], weights["last_bias"])[:, 0]
