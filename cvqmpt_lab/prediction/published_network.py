"""The published architecture at work: its networks run in torch."""

import numpy as np
import torch

from cvqmpt_lab.models.checkpoint import as_modules
from cvqmpt_lab.models.decoding.step_decoder import StepDecoder
from cvqmpt_lab.models.published.sequence_model import PublishedScene
from cvqmpt_lab.models.stored import StoredModel


class PublishedNetwork:
    """A sequence model of the published kind as prediction uses it."""

    def __init__(self, model: StoredModel) -> None:
        """Take the weights over; raises InvalidInputError when they do not fit their configuration."""
        checkpoint = as_modules(model)
        assert checkpoint.sequence_model is not None
        self._dictionary, self._model = checkpoint.dictionary, checkpoint.sequence_model

    @torch.inference_mode()
    def encode_scene(self, points: np.ndarray) -> PublishedScene:
        """A cloud (m, 3) float32 [m]."""
        return self._model.encode_scene([torch.tensor(points)])

    @torch.inference_mode()
    def decoder(self, scene: PublishedScene, starts: np.ndarray, goals: np.ndarray) -> StepDecoder:
        """What a search of code sequences asks, for starts and goals (q, joint_dim)."""
        return self._model.decoder(self._dictionary, scene, torch.from_numpy(starts), torch.from_numpy(goals))


@torch.inference_mode()
def trajectory_codes(model: StoredModel, configurations: np.ndarray) -> np.ndarray:
    """Code (t,) int64 of each configuration (t, configuration_dim) of a trajectory, by any encoder."""
    return as_modules(model).dictionary.encode(torch.from_numpy(configurations)[None])[0].numpy()
