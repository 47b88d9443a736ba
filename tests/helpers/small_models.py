"""Small VQ-MPT checkpoints with random weights: real networks that predict nothing sensible."""

import dataclasses

import torch
from training_data import kinematics

from cvqmpt_lab.training.profiles import PROFILES
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import (
    DictionaryConfig,
    ModelConfig,
    PointCloudConfig,
    SequenceConfig,
    SetAbstractionConfig,
    TransformerConfig,
)
from cvqmpt_lab.vqmpt.dictionary import Dictionary
from cvqmpt_lab.vqmpt.published_network import PublishedSequenceModel
from cvqmpt_lab.vqmpt.weights import robot_signature

SIZES = TransformerConfig(n_layers=2, n_heads=2, d_k=8, d_v=8, d_model=32, d_inner=48, dropout=0.1)
COMPACT = PROFILES["compact"].model
METADATA = {"kinematics": kinematics()}


def compact_config():
    words = dataclasses.replace(COMPACT.dictionary, transformer=SIZES, n_codes=64)
    return dataclasses.replace(COMPACT, feature_dim=12, dictionary=words)


def published_config():
    return ModelConfig(
        dictionary=DictionaryConfig(transformer=SIZES, n_codes=64),
        point_cloud=PointCloudConfig(
            sa1=SetAbstractionConfig(ratio=0.75, radius=0.4, widths=(8, 12)),
            sa2=SetAbstractionConfig(ratio=0.75, radius=0.8, widths=(10, 32)),
        ),
        sequence=SequenceConfig(context=SIZES, transformer=SIZES, max_length=40),
    )


def random_checkpoint(robot, config=None, *, goal_bias=6.0, metadata=METADATA):
    """A checkpoint whose decisions depend on its input; `goal_bias` is for the goal token."""
    config = published_config() if config is None else config
    torch.manual_seed(0)
    dictionary = Dictionary(config)
    model = PublishedSequenceModel(config) if config.kind == "published" else None
    with torch.no_grad():
        for parameter in (*(model.parameters() if model else ()), *dictionary.decoder.parameters()):
            parameter += 0.1 * torch.randn_like(parameter)
        for head in (dictionary.decoder.mu, dictionary.decoder.l):
            head[0].weight *= 2.0
        dictionary.decoder.diag[0].bias -= 3.0
        if model:
            model.autoregressive.class_pred.weight *= 2.0
            model.autoregressive.class_pred.bias[-1] += goal_bias
            model.eval()
    modules = {"dictionary": dictionary.eval()} | ({"sequence_model": model} if model else {})
    return Checkpoint(config, robot_signature(robot), modules, metadata)
