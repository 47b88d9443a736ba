"""Stage 1: learn the dictionary, from waypoints to codes to Gaussians."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from cvqmpt_lab.training.dataset import PathDataset
from cvqmpt_lab.training.link_positions import LinkPositions
from cvqmpt_lab.training.losses import stage1_loss
from cvqmpt_lab.training.optimizer import OptimizerSettings
from cvqmpt_lab.training.paths import unpacked, with_few_trivial
from cvqmpt_lab.training.run_folder import Progress
from cvqmpt_lab.training.scene_batches import batch_seed
from cvqmpt_lab.training.stage import Batch, Stage
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import ModelConfig, require_sizes
from cvqmpt_lab.vqmpt.dictionary import Dictionary


@dataclass(frozen=True, kw_only=True)
class Stage1Settings:
    """How the dictionary is trained."""

    epochs: int = 20
    batch: int = 64
    """Rows of a batch: paths, or for an encoder of single waypoints rows of `row` unrelated ones, which stand
    for paths so that the parts of the loss keep their published proportions."""
    row: int = 32
    batches_per_epoch: int | None = None
    """At most; None for all paths."""
    spacing: float | None = None
    """Of waypoints along a path [rad]; None to take all."""
    trivial_share: float = 0.15
    """Of paths whose straight line is free, at most."""
    turn_base: bool = False
    """Turn whole paths about the base."""
    entropy_weight: float = 0.1
    restart_every: int = 200
    """Steps between restarts of codes that are hardly used (only where the model is `data_initialised`)."""
    restart_epochs: int = 10
    """The first epochs, which have restarts."""
    restart_below: float = 0.02
    """Share of the mean use below which a code is restarted."""
    validation_paths: int = 1000
    """At most."""
    optimizer: OptimizerSettings = field(default_factory=lambda: OptimizerSettings(rate=1e-3))

    def __post_init__(self) -> None:
        require_sizes(batch=self.batch, row=self.row, batches_per_epoch=self.batches_per_epoch)


class _Waypoints(Dataset):
    """Batches of unrelated waypoints, (batch, row, n)."""

    def __init__(self, stage: "Stage1", epoch: int, paths: np.ndarray, rng: np.random.Generator) -> None:
        self._stage, self._epoch = stage, epoch
        counts = stage.dataset.paths.counts(paths)
        inside = np.arange(counts.sum()) - np.repeat(counts.cumsum() - counts, counts)
        waypoints = np.repeat(stage.dataset.paths.start[paths], counts) + inside
        order = rng.permutation(len(waypoints))
        self._waypoint, self._path = waypoints[order], np.repeat(paths, counts)[order]
        self._size = stage.settings.batch * stage.settings.row

    def __len__(self) -> int:
        whole = max(1, len(self._waypoint) // self._size)
        return min(whole, self._stage.settings.batches_per_epoch or whole)

    def __getitem__(self, batch: int) -> dict[str, np.ndarray]:
        stage = self._stage
        rng = np.random.default_rng(batch_seed(stage.seed, self._epoch, batch))
        places = np.arange(batch * self._size, (batch + 1) * self._size) % len(self._waypoint)
        u = unpacked(stage.dataset.paths.waypoints[self._waypoint[places]])
        u[:, 0] += stage.turn.draw_each(self._path[places], rng).astype(np.float32)
        shape = (stage.settings.batch, stage.settings.row)
        return {"u": u.reshape(*shape, -1), "visible": np.ones(shape, dtype=bool)}


class _Trajectories(Dataset):
    """Batches of whole paths, padded, (batch, t, n)."""

    def __init__(self, stage: "Stage1", epoch: int, paths: np.ndarray, rng: np.random.Generator) -> None:
        self._stage, self._epoch = stage, epoch
        self._paths = rng.permutation(paths)

    def __len__(self) -> int:
        whole = -(-len(self._paths) // self._stage.settings.batch)
        return min(whole, self._stage.settings.batches_per_epoch or whole)

    def __getitem__(self, batch: int) -> dict[str, np.ndarray]:
        stage, size = self._stage, self._stage.settings.batch
        rng = np.random.default_rng(batch_seed(stage.seed, self._epoch, batch))
        paths = self._paths[batch * size : (batch + 1) * size]
        u, counts = stage.dataset.paths.padded(paths)
        u[:, :, 0] += stage.turn.draw_each(paths, rng)[:, None].astype(np.float32)
        return {"u": u, "visible": np.arange(u.shape[1]) < counts[:, None]}


class _Trainee(nn.Module):
    """The dictionary, and how often each code was used since the last restart."""

    uses: Tensor

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.dictionary = Dictionary(config)
        self.register_buffer("uses", torch.zeros(config.dictionary.n_codes, dtype=torch.int64))


class Stage1(Stage):
    """Training of a `Dictionary`."""

    module: _Trainee

    name = "stage1"
    selection = "validation_reconstruction"
    panels: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "loss per row": ("train_loss", "train_reconstruction"),
        "validation, per waypoint": ("validation_reconstruction", "validation_nll"),
        "codes in use": ("validation_codes_in_use",),
    }

    def __init__(
        self,
        dataset: PathDataset,
        config: ModelConfig,
        settings: Stage1Settings,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on a dataset; raises InvalidInputError where that is impossible."""
        super().__init__(dataset, settings.spacing, settings.turn_base, settings.optimizer, seed, device)
        self.config, self.settings = config, settings
        self.module = _Trainee(config).to(device)
        robot, chain = self.dataset.robot, self.dataset.chain if config.feature_dim else None
        self._links = LinkPositions(robot.lower, robot.upper, chain, device)
        self._latents = torch.empty(0)

    def prepare(self) -> None:
        """Put the codes onto encoded waypoints."""
        if not self.config.dictionary.data_initialised:
            return
        batches, latents = self.batches(0), []
        wanted = 2 * self.config.dictionary.n_codes
        with torch.no_grad():
            for index in range(len(batches)):
                batch = batches[index]
                u, visible = (torch.from_numpy(batch[name]).to(self.device) for name in ("u", "visible"))
                latents.append(self.module.dictionary.encoder(self._links.configurations(u))[visible])
                if sum(len(part) for part in latents) >= wanted:
                    break
        every = torch.ones(self.config.dictionary.n_codes, dtype=torch.bool, device=self.device)
        self.module.dictionary.quantizer.restart_codes(every, torch.cat(latents))

    def batches(self, epoch: int) -> "_Waypoints | _Trajectories":
        """Batches of an epoch."""
        rng = np.random.default_rng((self.seed, epoch))
        rows = self.dataset.split("train")
        rows = with_few_trivial(self.dataset.paths, rows, self.settings.trivial_share, rng)
        kind = _Waypoints if self.config.dictionary.encoder == "mlp" else _Trajectories
        return kind(self, epoch, rows, rng)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Published loss of a batch, per row."""
        u, visible = batch["u"], batch["visible"]
        output = self.module.dictionary(self._links.configurations(u))
        loss = stage1_loss(
            output, u, visible, self.config.dictionary.commitment, self.settings.entropy_weight
        )
        with torch.no_grad():
            used = output.quantized.codes[visible]
            self.module.uses += torch.bincount(used, minlength=len(self.module.uses))
            self._latents = output.quantized.latent[visible].detach()
        return {"loss": loss.total, "reconstruction": loss.reconstruction, "quantization": loss.quantization}

    def after_step(self, progress: Progress, optimizer: torch.optim.Optimizer) -> None:
        """Restart codes that are hardly used."""
        settings = self.settings
        if not self.config.dictionary.data_initialised or progress.step % max(settings.restart_every, 1):
            return
        uses = self.module.uses
        if progress.epoch < settings.restart_epochs:
            dead = uses < settings.restart_below * uses.float().mean()
            self.module.dictionary.quantizer.restart_codes(dead, self._latents)
            state = optimizer.state.get(self.module.dictionary.quantizer.embedding.weight, {})
            for name in ("exp_avg", "exp_avg_sq"):
                if name in state:
                    state[name][dead] = 0.0
        uses.zero_()

    def validate(self) -> dict[str, float | None]:
        """Fit of held-out paths, per waypoint [nats], and how the dictionary is used."""
        rows = self.dataset.split("validation")[: self.settings.validation_paths]
        span = torch.tensor(self.dataset.robot.upper) - torch.tensor(self.dataset.robot.lower)
        sums = dict.fromkeys(("nll", "negative_entropy", "std", "codes_per_path"), 0.0)
        used = torch.zeros(self.config.dictionary.n_codes, dtype=torch.int64)
        waypoints = 0
        for first in range(0, len(rows), 64):
            array, counts = self.dataset.paths.padded(rows[first : first + 64])
            u = torch.from_numpy(array).to(self.device)
            visible = (torch.arange(u.shape[1]) < torch.from_numpy(counts)[:, None]).to(self.device)
            output = self.module.dictionary(self._links.configurations(u))
            codes = output.quantized.codes
            sums["nll"] -= float(output.gaussians.log_prob(u)[visible].double().sum())
            sums["negative_entropy"] -= float(output.gaussians.entropy()[visible].double().sum())
            std = output.gaussians.covariance.diagonal(dim1=-2, dim2=-1).sqrt().cpu() * span
            sums["std"] += float(std[visible.cpu()].mean(-1).double().sum())
            changes = (codes[:, 1:] != codes[:, :-1]) & visible[:, 1:]
            sums["codes_per_path"] += float(changes.sum() + len(codes))
            used += torch.bincount(codes[visible].cpu(), minlength=len(used))
            waypoints += int(counts.sum())
        result: dict[str, float | None] = {
            "reconstruction": (sums["nll"] + self.settings.entropy_weight * sums["negative_entropy"])
            / waypoints,
            "nll": sums["nll"] / waypoints,
            "mean_std_rad": sums["std"] / waypoints,
            "codes_in_use": int((used > 0).sum()),
            "codes_per_path": sums["codes_per_path"] / len(rows),
        }
        return result

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """The dictionary as it stands."""
        self.module.dictionary.quantizer.normalise_codes()
        return Checkpoint(self.config, self.dataset.robot, self.module.dictionary, None, metadata)
