"""What the model believes about configurations, from the cloud alone."""

import numpy as np
import torch

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.checkpoint import Checkpoint
from cvqmpt_lab.models.compact.sequence_model import CompactSequenceModel
from cvqmpt_lab.prediction.configurations import ModelConfigurations
from cvqmpt_lab.robot.robot import Robot


@torch.inference_mode()
def free_probability(
    checkpoint: Checkpoint, robot: Robot, cloud: np.ndarray, configurations: np.ndarray
) -> np.ndarray:
    """P(free) (b,) of configurations (b, n) [rad] in the scene of a cloud (m, 3) [m].

    Raises
    ------
    InvalidInputError
        When the model has no collision head.
    """
    model = checkpoint.sequence_model
    if not isinstance(model, CompactSequenceModel) or model.collision is None:
        raise InvalidInputError("this model has no collision head; train one with sequence.collision_head")
    scene = model.encode_scene([torch.from_numpy(np.array(cloud, dtype=np.float32))])
    of = torch.from_numpy(ModelConfigurations(checkpoint, robot).of(configurations))
    return torch.sigmoid(model.free_logits(scene, of[None]))[0].numpy()
