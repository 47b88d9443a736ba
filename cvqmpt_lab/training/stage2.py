"""Stage 2: learn to predict the codes of a path from cloud, start and goal, with the dictionary frozen."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.checkpoint import Checkpoint, SequenceModel, build_sequence_model
from cvqmpt_lab.models.compact.sequence_model import CompactScene, CompactSequenceModel
from cvqmpt_lab.models.config import ModelConfig
from cvqmpt_lab.models.dictionary.dictionary import Dictionary
from cvqmpt_lab.models.published.sequence_model import PublishedSequenceModel, prefix_samples
from cvqmpt_lab.training.dataset import PathDataset
from cvqmpt_lab.training.losses import binary_loss, refinement_loss, sequence_loss
from cvqmpt_lab.training.measures import Measures
from cvqmpt_lab.training.optimizer import OptimizerSettings
from cvqmpt_lab.training.scene_batches import SceneBatchSettings
from cvqmpt_lab.training.sequences import CodeSequences, code_sequences
from cvqmpt_lab.training.stage import Batch, SceneStage


@dataclass(frozen=True, kw_only=True)
class Stage2Settings:
    """How the sequence model is trained."""

    epochs: int = 20
    batches: SceneBatchSettings = field(default_factory=SceneBatchSettings)
    refinement: float = 1.0
    """Weight of that head's loss, where the model has it."""
    collision: float = 1.0
    """Likewise."""
    connectivity: float = 1.0
    """Likewise."""
    precision: Literal["float32", "bf16"] = "float32"
    """Of the model's matrix products; losses are always float32."""
    optimizer: OptimizerSettings = field(default_factory=lambda: OptimizerSettings(rate=1e-3))


@dataclass(frozen=True, eq=False)
class _Examples:
    """A batch of p paths, both ways, up to w waypoints each."""

    start: Tensor
    """(2 p, configuration_dim)."""
    goal: Tensor
    """(2 p, configuration_dim)."""
    end_codes: Tensor
    """(2 p, 2) int64: of start and goal."""
    u: Tensor
    """(2 p, w, n), forward."""
    sequences: CodeSequences
    weight: Tensor
    """(2 p,) bool: False for paths that fill a scene up."""


@dataclass(frozen=True, eq=False)
class _Predictions:
    """What a model says about a batch."""

    logits: Tensor
    """(r, classes), of every code that counts."""
    targets: Tensor
    """(r,) int64."""
    row: Tensor
    """(r,) int64: the sequence that each prediction belongs to."""
    scene: CompactScene | None = None
    """What heads look at; None for models without heads."""
    refinement_nll: Tensor | None = None
    """Of waypoints, mean [nats]; None for models without that head."""


@dataclass(frozen=True, eq=False)
class _HeadOutput:
    """What a head says about labelled configurations or motions."""

    name: str
    logits: Tensor
    """(s, c)."""
    labels: Tensor
    """(s, c) bool: free."""
    weight: float
    """Of its loss."""


class Stage2(SceneStage):
    """Training of a sequence model."""

    name = "stage2"
    selection = "validation_cross_entropy"
    panels: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "loss per path": ("train_loss",),
        "validation cross entropy per code": (
            "validation_cross_entropy",
            "validation_wrong_cloud_cross_entropy",
        ),
        "P(free): area under the curve": ("validation_free_auc", "validation_wrong_cloud_free_auc"),
        "refined Gaussian, per waypoint": (
            "validation_refinement_nll",
            "validation_wrong_cloud_refinement_nll",
        ),
    }

    module: SequenceModel

    def __init__(
        self,
        dataset: PathDataset,
        dictionary: Checkpoint,
        config: ModelConfig,
        settings: Stage2Settings,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on a dataset with a trained dictionary, whose part of the configuration counts.

        Raises
        ------
        InvalidInputError
            When the dictionary belongs to another robot, takes other features, or the dataset lacks paths.
        """
        super().__init__(dataset, settings, seed, device)
        self.config, self.settings = _combined(dataset, dictionary, config), settings
        self.dictionary: Dictionary = dictionary.dictionary.to(device).eval().requires_grad_(False)
        self._links = self.link_positions(self.config.feature_dim)
        self.module = build_sequence_model(self.config).to(device)
        if isinstance(self.module, CompactSequenceModel):
            with torch.no_grad():
                means = self.dictionary.code_gaussians().mean
                self.module.set_code_configurations(self._links.configurations(means))

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Cross entropy per path and the heads' losses, weighted."""
        examples = self._examples(batch)
        predictions = self._predict(batch["cloud"], examples)
        paths, codes = int(examples.weight.sum().clamp(min=1)), len(predictions.targets)
        total = sequence_loss(predictions.logits, predictions.targets, paths)
        losses = {"cross_entropy": total * paths / max(codes, 1)}  # shown per code
        if predictions.refinement_nll is not None:
            losses["refinement"] = predictions.refinement_nll
            total = total + self.settings.refinement * losses["refinement"]
        for head in self._head_outputs(batch, predictions.scene, own_waypoints=True):
            losses[head.name] = binary_loss(head.logits, head.labels)
            total = total + head.weight * losses[head.name]
        return {"loss": total, **losses}

    def validate(self) -> dict[str, float | None]:
        """Values on held-out scenes with their own cloud, and with the cloud of another scene."""
        measures = {"": Measures(), "wrong_cloud_": Measures()}
        for held_out in self.held_out():
            examples = self._examples(held_out.batch)
            families = self.dataset.scenes.family[held_out.scene]
            for prefix, cloud in held_out.clouds.items():
                self._measure(measures[prefix], held_out.batch, cloud, examples, families)
        own, wrong = (each.values() for each in measures.values())
        result: dict[str, float | None] = {}
        for name, value in own.items():
            result |= {name: value, f"wrong_cloud_{name}": wrong.get(name)}
        return result

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """Dictionary and sequence model as they stand."""
        return Checkpoint(self.config, self.dataset.robot, self.dictionary, self.module, metadata)

    @torch.no_grad()
    def _examples(self, batch: Batch) -> _Examples:
        u, counts = batch["u"], batch["counts"]
        configurations = self._links.configurations(u)
        codes = self._codes(configurations, counts)
        most = self.config.sequence.max_length - 1
        sequences = code_sequences(codes, counts, most, self.config.goal_class)
        last = configurations[torch.arange(len(u), device=u.device), counts - 1]
        ends = torch.stack((configurations[:, 0], last), 1)
        end_codes = self.dictionary.encode(ends.flatten(0, 1)[:, None]).view(-1, 2)
        both = torch.stack((ends, ends.flip(1)), 1).flatten(0, 1)
        return _Examples(
            both[:, 0],
            both[:, 1],
            torch.stack((end_codes, end_codes.flip(1)), 1).flatten(0, 1),
            u.repeat_interleave(2, 0),
            sequences,
            batch["weight"].repeat_interleave(2),
        )

    def _codes(self, configurations: Tensor, counts: Tensor) -> Tensor:
        """Codes (p, w) of padded paths, each encoded as if alone."""
        if self.config.dictionary.encoder == "mlp":
            return self.dictionary.encode(configurations)
        codes = torch.zeros(configurations.shape[:2], dtype=torch.int64, device=configurations.device)
        for count in counts.unique().tolist():  # this encoder sees padding; equal lengths need none
            rows = (counts == count).nonzero()[:, 0]
            codes[rows, :count] = self.dictionary.encode(configurations[rows, :count])
        return codes

    def _predict(self, cloud: Tensor, examples: _Examples) -> _Predictions:
        bf16 = self.settings.precision == "bf16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=bf16):
            if isinstance(self.module, CompactSequenceModel):
                return self._predict_compact(self.module, cloud, examples)
            return self._predict_published(self.module, cloud, examples)

    def _predict_compact(
        self, model: CompactSequenceModel, cloud: Tensor, examples: _Examples
    ) -> _Predictions:
        sequences = examples.sequences
        scene = model.encode_scene(cloud)
        output = model(scene, examples.start, examples.goal, sequences.codes, examples.end_codes)
        counted = sequences.visible & examples.weight[:, None]
        nll = None
        if model.refinement is not None:
            with torch.autocast(self.device.type, enabled=False):
                gaussians = self.dictionary.code_gaussians(sequences.codes)
                refined = model.refine(output.states.float(), gaussians)
                rows = torch.arange(len(sequences.run), device=cloud.device)[:, None]
                in_run = sequences.in_run & examples.weight[:, None]
                nll = refinement_loss(refined[rows, sequences.run], examples.u, in_run)
        row = counted.nonzero()[:, 0]
        return _Predictions(output.logits.float()[counted], sequences.targets[counted], row, scene, nll)

    def _predict_published(
        self, model: PublishedSequenceModel, cloud: Tensor, examples: _Examples
    ) -> _Predictions:
        sequences = examples.sequences
        context = model.encode_context(model.encode_scene(cloud), examples.start, examples.goal)
        rows, lengths, targets = [], [], []
        for row in examples.weight.nonzero()[:, 0].tolist():
            known = sequences.codes[row, : int(sequences.visible[row].sum()) - 1]
            samples = prefix_samples(known, self.config.goal_class)
            rows += [row] * len(samples.lengths)
            lengths.append(samples.lengths)
            targets.append(sequences.targets[row, samples.lengths])
        logits = model.prefix_logits(
            context[rows], sequences.codes[rows], self.dictionary.quantizer, torch.cat(lengths)
        )
        return _Predictions(logits.float(), torch.cat(targets), torch.tensor(rows))

    def _head_outputs(
        self, batch: Batch, scene: CompactScene | None, *, own_waypoints: bool
    ) -> Iterator[_HeadOutput]:
        """What each head that is trained says; `own_waypoints` of paths count as free, too."""
        model = self.module
        if scene is None or not isinstance(model, CompactSequenceModel):
            return
        if model.collision is not None and "probe_u" in batch:
            u, free = batch["probe_u"], batch["probe_free"]
            if own_waypoints:
                waypoints = _drawn_waypoints(batch).view(len(u), -1, u.shape[-1])
                u = torch.cat((u, waypoints), 1)
                free = torch.cat((free, torch.ones_like(waypoints[..., 0], dtype=torch.bool)), 1)
            logits = model.free_logits(scene, self._links.configurations(u)).float()
            yield _HeadOutput("free", logits, free, self.settings.collision)
        if model.connectivity is not None and "edge_u" in batch:
            ends = self._links.configurations(batch["edge_u"])
            logits = model.connected_logits(scene, ends[:, :, 0], ends[:, :, 1]).float()
            yield _HeadOutput("connected", logits, batch["edge_free"], self.settings.connectivity)

    def _measure(
        self, measures: Measures, batch: Batch, cloud: Tensor, examples: _Examples, families: np.ndarray
    ) -> None:
        """Take in what the model says with these clouds; families (s,) of the scenes."""
        predictions = self._predict(cloud, examples)
        entropy = F.cross_entropy(predictions.logits, predictions.targets, reduction="none").cpu().double()
        measures.add("cross_entropy", float(entropy.sum()), len(entropy))
        rows_of_scene = len(examples.weight) // len(families)
        family = families[predictions.row.cpu().numpy() // rows_of_scene]
        for number in np.unique(family).tolist():
            chosen = entropy[torch.from_numpy(family == number)]
            measures.add(f"cross_entropy_{self.dataset.families[number]}", float(chosen.sum()), len(chosen))
        if predictions.refinement_nll is not None:
            waypoints = float((examples.sequences.in_run & examples.weight[:, None]).sum())
            measures.add("refinement_nll", float(predictions.refinement_nll) * waypoints, waypoints)
        for head in self._head_outputs(batch, predictions.scene, own_waypoints=False):
            measures.add_labelled(f"{head.name}_auc", head.logits, head.labels)


def _drawn_waypoints(batch: Batch) -> Tensor:
    """A waypoint (p, n) of each path, drawn at random."""
    u, counts = batch["u"], batch["counts"]
    place = (torch.rand(len(u), device=u.device) * counts).long()
    return u[torch.arange(len(u), device=u.device), torch.minimum(place, counts - 1)]


def _combined(dataset: PathDataset, dictionary: Checkpoint, config: ModelConfig) -> ModelConfig:
    """The model's configuration: the trained dictionary's, with this stage's parts."""
    dictionary.robot.require_same(dataset.robot)
    trained = dictionary.config
    if (trained.kind, trained.feature_dim) != (config.kind, config.feature_dim):
        raise InvalidInputError(
            f"the dictionary is of kind {trained.kind!r} with {trained.feature_dim} features, the configuration "
            f"of kind {config.kind!r} with {config.feature_dim}; train it with the same profile and data"
        )
    return replace(trained, point_cloud=config.point_cloud, sequence=config.sequence)
