"""Stage 2 of VQ-MPT: learn to predict the codes of a path from the scene's point cloud, start and
goal.

The codes h_1 ... h_n of a path, the dictionary of stage 1 being frozen, end with the goal class
h_{n+1}. With the context M of cloud, start and goal, the loss is the cross entropy of the next code
after every prefix,

    -sum_{i=0}^{n} log p(h_{i+1} | M, h_1 ... h_i)                                mean over
    trajectories

Every path is learned from both ways.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.training.batches import SceneBatchSettings
from cvqmpt_lab.training.dataset import PathDataset
from cvqmpt_lab.training.stage_base import Means, OptimizerSettings, SceneStage
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import ModelConfig
from cvqmpt_lab.vqmpt.dictionary import Dictionary
from cvqmpt_lab.vqmpt.transformer import PublishedSequenceModel, prefix_lengths


@dataclass(frozen=True, kw_only=True)
class Stage2Settings:
    """How the sequence model is trained."""

    epochs: int = 20
    batches: SceneBatchSettings = field(default_factory=SceneBatchSettings)
    # of the matrix products; losses are always float32
    precision: Literal["float32", "bf16"] = "float32"
    optimizer: OptimizerSettings = field(default_factory=lambda: OptimizerSettings(rate=1e-3))


class CodeSequences(NamedTuple):
    """Sequences (b, ...) without consecutive repeats, at most t codes of each."""

    codes: Tensor  # (b, t) int64, padded with code 0
    targets: Tensor  # (b, t + 1) int64: the next code after each prefix, at last the goal class
    visible: Tensor  # (b, t + 1) bool: False where there is nothing to predict


def code_sequences(codes: Tensor, counts: Tensor, most: int, goal_class: int) -> CodeSequences:
    """Both directions of paths given by the codes (p, w) int64, padded, of their waypoints; counts
    (p,) of waypoints.

    Sequences of more than `most` codes are cut and do not predict their end. Returns 2 p sequences:
    path 0 forwards, path 0 backwards, path 1 forwards, ...
    """
    p, w = codes.shape
    real = torch.arange(w, device=codes.device) < counts[:, None]
    begins = real.clone()
    begins[:, 1:] &= codes[:, 1:] != codes[:, :-1]
    run = (begins.cumsum(1) - 1).clamp(min=0)
    lengths = begins.sum(1)
    packed = codes.new_zeros(p, w + 1).scatter_(1, torch.where(real, run, w), codes)[:, :w]
    place = torch.arange(w, device=codes.device)
    backwards = packed.gather(1, (lengths[:, None] - 1 - place) % w)
    both = torch.stack((packed, backwards), 1).flatten(0, 1)
    lengths = lengths.repeat_interleave(2)
    t = min(int(lengths.max()), most)
    step = torch.arange(w + 1, device=codes.device)
    targets = torch.cat((both, both[:, :1]), 1).masked_fill(step == lengths[:, None], goal_class)
    visible = step <= lengths[:, None]
    both = both.masked_fill(place >= lengths[:, None], 0)
    return CodeSequences(both[:, :t], targets[:, : t + 1], visible[:, : t + 1])


def sequence_loss(logits: Tensor, targets: Tensor, trajectories: int) -> Tensor:
    """Loss of the module's docstring: logits (r, n_classes) after each prefix, targets (r,) int64."""
    return F.cross_entropy(logits, targets, reduction="sum") / trajectories


class _Examples(NamedTuple):
    """A batch of p paths, both ways, up to w waypoints each."""

    start: Tensor  # (2 p, configuration_dim)
    goal: Tensor  # (2 p, configuration_dim)
    sequences: CodeSequences
    weight: Tensor  # (2 p,) bool: False for paths that fill a scene up


class _Predictions(NamedTuple):
    """What a model says about a batch."""

    logits: Tensor  # (r, classes), of every code that counts
    targets: Tensor  # (r,) int64
    row: Tensor  # (r,) int64: the sequence that each prediction belongs to


class Stage2(SceneStage):
    """Training of a sequence model."""

    selection = "validation_cross_entropy"
    module: PublishedSequenceModel

    def __init__(
        self,
        dataset: PathDataset,
        dictionary: Checkpoint,
        config: ModelConfig,
        settings: Stage2Settings,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on a dataset with a trained dictionary, whose part of the configuration
        counts.

        InvalidInputError: the dictionary is of another robot or kind, or the dataset lacks paths.
        """
        super().__init__(dataset, settings.batches, settings.optimizer, seed, device)
        dictionary.robot.require_same(dataset.robot)
        words = dictionary.config
        if words.kind != config.kind:
            raise InvalidInputError(
                f"the dictionary is of kind {words.kind!r}, the configuration of kind "
                f"{config.kind!r}; train it "
                "with the same profile"
            )
        self.config = replace(words, point_cloud=config.point_cloud, sequence=config.sequence)
        self.settings = settings
        self.dictionary: Dictionary = dictionary.dictionary.to(device).eval().requires_grad_(False)
        self.module = PublishedSequenceModel(self.config).to(device)

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Cross entropy per path, and per code to be shown."""
        examples = self._examples(batch)
        predictions = self._predict(batch["cloud"], examples)
        paths, codes = int(examples.weight.sum().clamp(min=1)), len(predictions.targets)
        total = sequence_loss(predictions.logits, predictions.targets, paths)
        return {"loss": total, "cross_entropy": total * paths / max(codes, 1)}

    def validate(self) -> dict[str, float | None]:
        """Values on held-out scenes with their own cloud, and with the cloud of another scene."""
        means = {"": Means(), "wrong_cloud_": Means()}
        for batch, clouds in self.held_out():
            examples = self._examples(batch)
            families = self.dataset.scenes.family[batch["scene"].cpu().numpy()]
            for prefix, cloud in clouds.items():
                self._measure(means[prefix], cloud, examples, families)
        every = {prefix: each.values() for prefix, each in means.items()}
        return {prefix + name: every[prefix].get(name) for name in every[""] for prefix in every}

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """Dictionary and sequence model as they stand."""
        return Checkpoint(self.config, self.dataset.robot, self.dictionary, self.module, metadata)

    @torch.no_grad()
    def _examples(self, batch: dict[str, Tensor]) -> _Examples:
        u, counts = batch["u"], batch["counts"]
        codes = self._codes(u, counts)
        sequences = code_sequences(
            codes, counts, self.config.stage2[1].max_length - 1, self.config.goal_class
        )
        last = u[torch.arange(len(u), device=u.device), counts - 1]
        ends = torch.stack((u[:, 0], last), 1)
        both = torch.stack((ends, ends.flip(1)), 1).flatten(0, 1)
        return _Examples(both[:, 0], both[:, 1], sequences, batch["weight"].repeat_interleave(2))

    def _codes(self, u: Tensor, counts: Tensor) -> Tensor:
        """Codes (p, w) of padded paths, each encoded as if alone."""
        codes = torch.zeros(u.shape[:2], dtype=torch.int64, device=u.device)
        for count in counts.unique().tolist():  # the encoder sees padding; equal lengths need none
            rows = (counts == count).nonzero()[:, 0]
            codes[rows, :count] = self.dictionary.encode(u[rows, :count])
        return codes

    def _predict(self, cloud: Tensor, examples: _Examples) -> _Predictions:
        bf16 = self.settings.precision == "bf16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=bf16):
            sequences, model = examples.sequences, self.module
            context = model.encode_context(model.encode_scene(cloud), examples.start, examples.goal)
            rows, lengths, targets = [], [], []
            for row in examples.weight.nonzero()[:, 0].tolist():
                counted = prefix_lengths(int(sequences.visible[row].sum()) - 1).to(cloud.device)
                rows += [row] * len(counted)
                lengths.append(counted)
                targets.append(sequences.targets[row, counted])
            logits = model.prefix_logits(
                context[rows], sequences.codes[rows], self.dictionary.quantizer, torch.cat(lengths)
            )
            return _Predictions(logits.float(), torch.cat(targets), torch.tensor(rows))

    def _measure(
        self, means: Means, cloud: Tensor, examples: _Examples, families: np.ndarray
    ) -> None:
        """Take in what the model says with these clouds; families (s,) of the scenes."""
        predictions = self._predict(cloud, examples)
        entropy = (
            F.cross_entropy(predictions.logits, predictions.targets, reduction="none")
            .cpu()
            .double()
        )
        means.add("cross_entropy", float(entropy.sum()), len(entropy))
        rows_of_scene = len(examples.weight) // len(families)
        family = families[predictions.row.cpu().numpy() // rows_of_scene]
        for number in np.unique(family).tolist():
            chosen = entropy[torch.from_numpy(family == number)]
            means.add(
                f"cross_entropy_{self.dataset.families[number]}", float(chosen.sum()), len(chosen)
            )
