"""Stage 2: learn to predict the codes of a path from cloud, start and goal, with the dictionary frozen."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.checkpoint import Checkpoint, SequenceModel, build_sequence_model, save_checkpoint
from cvqmpt_lab.models.compact.sequence_model import CompactScene, CompactSequenceModel
from cvqmpt_lab.models.config import ModelConfig
from cvqmpt_lab.models.dictionary.dictionary import Dictionary
from cvqmpt_lab.models.published.sequence_model import PublishedSequenceModel, prefix_samples
from cvqmpt_lab.training.augmentation import Augmentation
from cvqmpt_lab.training.dataset import PathDataset
from cvqmpt_lab.training.link_positions import LinkPositions
from cvqmpt_lab.training.loop import Batch, OptimizerSettings
from cvqmpt_lab.training.losses import binary_loss, refinement_loss, sequence_loss
from cvqmpt_lab.training.run_folder import Progress
from cvqmpt_lab.training.scene_batches import SceneBatches, SceneBatchSettings, other_scenes
from cvqmpt_lab.training.sequences import CodeSequences, code_sequences


@dataclass(frozen=True, kw_only=True)
class Stage2Settings:
    """How the sequence model is trained.

    Attributes
    ----------
    refinement, collision, connectivity: weights of those heads' losses, where the model has them.
    precision: of the model's matrix products; losses are always float32.
    """

    epochs: int = 20
    batches: SceneBatchSettings = field(default_factory=SceneBatchSettings)
    refinement: float = 1.0
    collision: float = 1.0
    connectivity: float = 1.0
    precision: Literal["float32", "bf16"] = "float32"
    optimizer: OptimizerSettings = field(default_factory=lambda: OptimizerSettings(rate=1e-3))


@dataclass(frozen=True, eq=False)
class _Examples:
    """A batch of paths, both ways: ends (2 p, d), codes of ends (2 p, 2), joints (2 p, w, n), sequences."""

    start: Tensor
    goal: Tensor
    end_codes: Tensor
    u: Tensor
    sequences: CodeSequences
    weight: Tensor


@dataclass(frozen=True, eq=False)
class _Predictions:
    """What a model says about a batch: logits (r, classes) against targets (r,), and what heads need.

    row: (r,), the sequence that each prediction belongs to.
    """

    logits: Tensor
    targets: Tensor
    row: Tensor
    scene: CompactScene | None = None
    refinement_nll: Tensor | None = None


class Stage2:
    """Training of a sequence model; a `loop.Stage`."""

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
            When the dictionary belongs to another robot, takes other features, or the dataset lacks labels
            or paths.
        """
        dataset.require_splits()
        self.config = _combined(dataset, dictionary, config)
        spacing = settings.batches.spacing
        self.dataset = dataset if spacing is None else dataset.thinned(spacing)
        self.settings, self.seed, self.optimizer = settings, seed, settings.optimizer
        self._augmentation = Augmentation(
            self.dataset, turn_base=settings.batches.turn_base, mirror=settings.batches.mirror
        )
        self.dictionary: Dictionary = dictionary.dictionary.to(device).eval().requires_grad_(False)
        robot = dataset.robot
        chain = dataset.chain if self.config.feature_dim else None
        self._links = LinkPositions(robot.lower, robot.upper, chain, device)
        self._device = device
        torch.manual_seed(seed)
        self.module: nn.Module = build_sequence_model(self.config).to(device)
        if isinstance(self.module, CompactSequenceModel):
            with torch.no_grad():
                means = self.dictionary.code_gaussians().mean
                self.module.set_code_configurations(self._links.configurations(means))
        self._validation = SceneBatches.for_validation(self.dataset, settings.batches, seed)

    def prepare(self) -> None:
        """Nothing."""

    def batches(self, epoch: int) -> SceneBatches:
        """Batches of an epoch."""
        return SceneBatches.of_epoch(
            self.dataset, self.settings.batches, self._augmentation, self.seed, epoch
        )

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Cross entropy per path and the heads' losses, weighted."""
        examples = self._examples(batch)
        predictions = self._predict(batch["cloud"], examples)
        paths = examples.weight.sum().clamp(min=1)
        every = torch.ones_like(predictions.targets, dtype=torch.bool)
        losses = {"cross_entropy": sequence_loss(predictions.logits, predictions.targets, every, int(paths))}
        total = losses["cross_entropy"]
        losses["cross_entropy"] = (
            losses["cross_entropy"] * paths / max(len(predictions.targets), 1)
        )  # per code
        if predictions.refinement_nll is not None:
            losses["refinement"] = predictions.refinement_nll
            total = total + self.settings.refinement * losses["refinement"]
        if predictions.scene is not None:
            for name, logits, labels, weight in self._head_outputs(
                batch, predictions.scene, own_waypoints=True
            ):
                losses[name] = binary_loss(logits, labels)
                total = total + weight * losses[name]
        return {"loss": total, **losses}

    def after_step(self, progress: Progress, optimizer: torch.optim.Optimizer) -> None:
        """Nothing."""

    def validate(self) -> dict[str, float | None]:
        """Values on held-out scenes with their own cloud, and with the cloud of another scene."""
        own, wrong = _Sums(), _Sums()
        for index in range(len(self._validation)):
            arrays = self._validation[index]
            batch = {name: torch.from_numpy(array).to(self._device) for name, array in arrays.items()}
            examples, others = self._examples(batch), other_scenes(arrays["scene"])
            families = self.dataset.scenes.family[arrays["scene"]]
            own.add(*self._evaluate(batch, batch["cloud"], examples, families))
            if others is not None:
                wrong.add(*self._evaluate(batch, batch["cloud"][others], examples, families))
        result: dict[str, float | None] = {}
        of_wrong = wrong.means()
        for name, value in own.means().items():
            result |= {name: value, f"wrong_cloud_{name}": of_wrong.get(name)}
        return result

    def save(self, folder: Path, metadata: Mapping[str, Any]) -> None:
        """Write dictionary and sequence model as a checkpoint."""
        model: SequenceModel = self.module  # type: ignore[assignment]
        save_checkpoint(folder, Checkpoint(self.config, self.dataset.robot, self.dictionary, model, metadata))

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
        with torch.autocast(self._device.type, torch.bfloat16, enabled=bf16):
            if isinstance(self.module, CompactSequenceModel):
                return self._predict_compact(self.module, cloud, examples)
            return self._predict_published(self.module, cloud, examples)  # type: ignore[arg-type]

    def _predict_compact(
        self, model: CompactSequenceModel, cloud: Tensor, examples: _Examples
    ) -> _Predictions:
        sequences = examples.sequences
        scene = model.encode_scene(cloud)
        output = model(scene, examples.start, examples.goal, sequences.codes, examples.end_codes)
        counted = sequences.visible & examples.weight[:, None]
        nll = None
        if model.refinement is not None:
            with torch.autocast(self._device.type, enabled=False):
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
        self, batch: Batch, scene: CompactScene, *, own_waypoints: bool
    ) -> list[tuple[str, Tensor, Tensor, float]]:
        """Name, logits, labels and weight of each head that is trained; waypoints count as free, too."""
        model, outputs = self.module, []
        assert isinstance(model, CompactSequenceModel)
        if model.collision is not None and "probe_u" in batch:
            u, free = batch["probe_u"], batch["probe_free"]
            if own_waypoints:
                place = (torch.rand(len(batch["u"]), device=u.device) * batch["counts"]).long()
                place = torch.minimum(place, batch["counts"] - 1)
                waypoints = batch["u"][torch.arange(len(place), device=u.device), place]
                waypoints = waypoints.view(len(u), -1, u.shape[-1])
                u = torch.cat((u, waypoints), 1)
                free = torch.cat((free, torch.ones_like(waypoints[..., 0], dtype=torch.bool)), 1)
            logits = model.free_logits(scene, self._links.configurations(u)).float()
            outputs.append(("free", logits, free, self.settings.collision))
        if model.connectivity is not None and "edge_u" in batch:
            ends = self._links.configurations(batch["edge_u"])
            logits = model.connected_logits(scene, ends[:, :, 0], ends[:, :, 1]).float()
            outputs.append(("connected", logits, batch["edge_free"], self.settings.connectivity))
        return outputs

    def _evaluate(
        self, batch: Batch, cloud: Tensor, examples: _Examples, families: np.ndarray
    ) -> tuple[dict[str, tuple[float, float]], dict[str, tuple[Tensor, Tensor]]]:
        """Sums and counts of mean values; logits and labels of heads."""
        predictions = self._predict(cloud, examples)
        entropy = F.cross_entropy(predictions.logits, predictions.targets, reduction="none").cpu().double()
        sums = {"cross_entropy": (float(entropy.sum()), float(len(entropy)))}
        rows_of_scene = len(examples.weight) // len(families)
        family = families[predictions.row.cpu().numpy() // rows_of_scene]
        for number in np.unique(family).tolist():
            chosen = entropy[torch.from_numpy(family == number)]
            sums[f"cross_entropy_{self.dataset.families[number]}"] = (float(chosen.sum()), float(len(chosen)))
        if predictions.refinement_nll is not None:
            waypoints = float((examples.sequences.in_run & examples.weight[:, None]).sum())
            sums["refinement_nll"] = (float(predictions.refinement_nll) * waypoints, waypoints)
        labelled = {}
        if predictions.scene is not None:
            for name, logits, labels, _ in self._head_outputs(batch, predictions.scene, own_waypoints=False):
                labelled[f"{name}_auc"] = (logits.cpu().flatten(), labels.cpu().flatten())
        return sums, labelled


class _Sums:
    """Means over several batches, and the area under the curve of labelled logits."""

    def __init__(self) -> None:
        self._sums: dict[str, list[float]] = {}
        self._labelled: dict[str, list[tuple[Tensor, Tensor]]] = {}

    def add(
        self, sums: Mapping[str, tuple[float, float]], labelled: Mapping[str, tuple[Tensor, Tensor]]
    ) -> None:
        for name, (value, count) in sums.items():
            earlier = self._sums.setdefault(name, [0.0, 0.0])
            earlier[0] += value
            earlier[1] += count
        for name, pair in labelled.items():
            self._labelled.setdefault(name, []).append(pair)

    def means(self) -> dict[str, float | None]:
        result: dict[str, float | None] = {n: v / c if c else None for n, (v, c) in self._sums.items()}
        for name, pairs in self._labelled.items():
            logits, labels = (torch.cat(part).numpy() for part in zip(*pairs, strict=True))
            result[name] = area_under_curve(logits, labels)
        return result


def area_under_curve(scores: np.ndarray, labels: np.ndarray) -> float | None:
    """Probability that a true one scores above a false one; None when there are not both."""
    positive = int(labels.sum())
    if positive in (0, len(labels)):
        return None
    _, inverse, counts = np.unique(scores, return_inverse=True, return_counts=True)
    ranks = (counts.cumsum() - 0.5 * (counts - 1))[inverse]  # ties share their mean rank
    wins = ranks[labels].sum() - 0.5 * positive * (positive + 1)
    return float(wins / (positive * (len(labels) - positive)))


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
