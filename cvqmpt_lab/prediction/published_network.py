"""The published architecture at work: its networks run in torch."""

import numpy as np
import torch

from cvqmpt_lab.models.checkpoint import as_modules
from cvqmpt_lab.models.decoding.step_decoder import StepDecoder
from cvqmpt_lab.models.published.sequence_model import PublishedScene, PublishedSequenceModel
from cvqmpt_lab.models.stored import StoredModel
from cvqmpt_lab.prediction.prediction import CodeUnion


class PublishedNetwork:
    """A sequence model of the published kind; see `predictor.SequenceNetwork`."""

    def __init__(self, model: StoredModel) -> None:
        checkpoint = as_modules(model)
        assert isinstance(checkpoint.sequence_model, PublishedSequenceModel)
        self._dictionary, self._model = checkpoint.dictionary, checkpoint.sequence_model

    @torch.inference_mode()
    def encode_scene(self, points: np.ndarray) -> PublishedScene:
        """A cloud (m, 3) float32 [m]."""
        return self._model.encode_scene([torch.tensor(points)])

    @torch.inference_mode()
    def decoder(self, scene: PublishedScene, starts: np.ndarray, goals: np.ndarray) -> StepDecoder:
        """What a search of code sequences asks, for starts and goals (q, joint_dim)."""
        return self._model.decoder(self._dictionary, scene, torch.from_numpy(starts), torch.from_numpy(goals))

    def refinement(
        self, scene: PublishedScene, starts: np.ndarray, goals: np.ndarray, union: CodeUnion
    ) -> None:
        """None: it has no such head."""


@torch.inference_mode()
def trajectory_codes(model: StoredModel, configurations: np.ndarray) -> np.ndarray:
    """Code (t,) int64 of each configuration (t, configuration_dim) of a trajectory, by any encoder."""
    return as_modules(model).dictionary.encode(torch.from_numpy(configurations)[None])[0].numpy()
