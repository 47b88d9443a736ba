"""Stage 1 of VQ-MPT: learn a dictionary of codes, each of which stands for a Gaussian over joints.

A waypoint q is encoded to a latent z = f(q), which is replaced by the nearest code z_q of the
dictionary and decoded to N(mu, Sigma), Sigma = L D L^T. The loss of trajectories q_1 ... q_T is,
with sg the stopped gradient, the mean over trajectories of the reconstruction

    sum_t [ -log N(q_t | mu_t, Sigma_t) - w H(N(mu_t, Sigma_t)) ],

which selects the best model, and the mean over waypoints of

    beta ||sg(z_q) - z||^2 + ||z_q - sg(z)||^2.

Padding never counts.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from cvqmpt_lab.training.batches import BaseTurn, batch_seed
from cvqmpt_lab.training.dataset import PathDataset, unpacked, with_few_trivial
from cvqmpt_lab.training.stage import OptimizerSettings, Stage
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import ModelConfig, require_sizes
from cvqmpt_lab.vqmpt.dictionary import Dictionary, DictionaryOutput
from cvqmpt_lab.vqmpt.link_positions import LinkPositions


@dataclass(frozen=True, kw_only=True)
class Stage1Settings:
    """How the dictionary is trained."""

    epochs: int = 20
    # Rows of a batch are paths. An encoder of single waypoints takes rows of `row` unrelated ones
    # instead, so that the parts of the loss keep their published proportions.
    batch: int = 64
    row: int = 32
    batches_per_epoch: int | None = None  # at most; None for all paths
    spacing: float | None = None  # of waypoints along a path [rad]; None to take all
    trivial_share: float = 0.15  # of paths whose straight line is free, at most
    turn_base: bool = False  # turn whole paths about the base
    entropy_weight: float = 0.1  # w: keeps Gaussians wide
    # steps between restarts of codes that are hardly used (if `data_initialised`)
    restart_every: int = 200
    restart_epochs: int = 10  # the first epochs, which have restarts
    restart_below: float = 0.02  # share of the mean use below which a code is restarted
    validation_paths: int = 1000  # at most
    optimizer: OptimizerSettings = field(default_factory=lambda: OptimizerSettings(rate=1e-3))

    def __post_init__(self) -> None:
        require_sizes(batch=self.batch, row=self.row, batches_per_epoch=self.batches_per_epoch)


class Stage1Loss(NamedTuple):
    """Parts of the loss, scalars."""

    total: Tensor  # what is minimised
    reconstruction: Tensor  # negative log-likelihood and weighted negative entropy
    quantization: Tensor


def stage1_loss(
    output: DictionaryOutput,
    u: Tensor,
    visible: Tensor,
    commitment: float,
    entropy_weight: float = 0.1,
) -> Stage1Loss:
    """Loss of the module's docstring.

    Args:
        output: the dictionary's, of waypoints u.
        u: (b, t, n) normalised joints.
        visible: (b, t) bool, False where padded.
        commitment: beta.
        entropy_weight: w.
    """
    nll = -torch.where(visible, output.gaussians.log_prob(u), 0.0).sum() / len(u)
    negative_entropy = -torch.where(visible, output.gaussians.entropy(), 0.0).sum() / len(u)
    reconstruction = nll + entropy_weight * negative_entropy
    z, z_q = output.quantized.latent, output.quantized.quantized
    to_code = (z_q.detach() - z).square().sum(-1)
    to_latent = (z_q - z.detach()).square().sum(-1)
    quantization = (commitment * to_code + to_latent)[visible].mean()
    return Stage1Loss(reconstruction + quantization, reconstruction, quantization)


class _Waypoints(Dataset):
    """Batches of unrelated waypoints, (batch, row, n)."""

    def __init__(
        self, stage: "DictionaryStage", epoch: int, paths: np.ndarray, rng: np.random.Generator
    ) -> None:
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

    def __init__(
        self, stage: "DictionaryStage", epoch: int, paths: np.ndarray, rng: np.random.Generator
    ) -> None:
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
    """The dictionary, and the number of uses of each code since the last restart."""

    uses: Tensor

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.dictionary = Dictionary(config)
        self.register_buffer("uses", torch.zeros(config.dictionary.n_codes, dtype=torch.int64))


class DictionaryStage(Stage):
    """Training of a `Dictionary`."""

    selection = "validation_reconstruction"
    # codes are restarted by what one process has seen
    many_processes = False
    module: _Trainee
    dataset: PathDataset

    def __init__(
        self,
        dataset: PathDataset,
        config: ModelConfig,
        settings: Stage1Settings,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on a dataset; raises InvalidInputError where that is impossible."""
        super().__init__(settings.optimizer, seed, device)
        dataset.require_splits()
        self.dataset = dataset.thinned(settings.spacing)
        self.turn = BaseTurn(self.dataset, settings.turn_base)
        self.config, self.settings = config, settings
        self.module = _Trainee(config).to(device)
        robot, chain = self.dataset.robot, self.dataset.chain if config.feature_dim else None
        self._links = LinkPositions(robot.lower, robot.upper, chain, device)
        self._latents = torch.empty(0)

    def prepare(self) -> None:
        """Initialise the codes with encoded waypoints z = f(q)."""
        if not self.config.dictionary.data_initialised:
            return
        batches, latents = self.batches(0), []
        wanted = 2 * self.config.dictionary.n_codes
        with torch.no_grad():
            for index in range(len(batches)):
                batch = self.tensors(batches[index])
                z = self.module.dictionary.encoder(self._links.configurations(batch["u"]))
                latents.append(z[batch["visible"]])
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

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Mean loss of a batch and its parts, see the module."""
        u, visible = batch["u"], batch["visible"]
        output = self.module.dictionary(self._links.configurations(u))
        beta = self.config.dictionary.commitment
        loss = stage1_loss(output, u, visible, beta, self.settings.entropy_weight)
        with torch.no_grad():
            used = output.quantized.codes[visible]
            self.module.uses += torch.bincount(used, minlength=len(self.module.uses))
            self._latents = output.quantized.latent[visible].detach()
        return {
            "loss": loss.total,
            "reconstruction": loss.reconstruction,
            "quantization": loss.quantization,
        }

    def after_step(self, epoch: int, step: int, optimizer: torch.optim.Optimizer) -> None:
        """Move codes that are hardly used to latents of the last batch."""
        settings = self.settings
        if not self.config.dictionary.data_initialised or step % max(settings.restart_every, 1):
            return
        uses = self.module.uses
        if epoch < settings.restart_epochs:
            dead = uses < settings.restart_below * uses.float().mean()
            self.module.dictionary.quantizer.restart_codes(dead, self._latents)
            state = optimizer.state.get(self.module.dictionary.quantizer.embedding.weight, {})
            for name in ("exp_avg", "exp_avg_sq"):
                if name in state:
                    state[name][dead] = 0.0
        uses.zero_()

    def validate(self) -> dict[str, float | None]:
        """Fit of held-out paths, per waypoint [nats], and use of the codes."""
        rows = self.dataset.split("validation")[: self.settings.validation_paths]
        span = torch.tensor(self.dataset.robot.upper) - torch.tensor(self.dataset.robot.lower)
        sums = dict.fromkeys(("nll", "negative_entropy", "std", "changes"), 0.0)
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
            sums["changes"] += float(((codes[:, 1:] != codes[:, :-1]) & visible[:, 1:]).sum())
            used += torch.bincount(codes[visible].cpu(), minlength=len(used))
            waypoints += int(counts.sum())
        reconstruction = sums["nll"] + self.settings.entropy_weight * sums["negative_entropy"]
        return {
            "reconstruction": reconstruction / waypoints,
            "nll": sums["nll"] / waypoints,
            "mean_std_rad": sums["std"] / waypoints,
            "codes_in_use": int((used > 0).sum()),
            "codes_per_path": (sums["changes"] + len(rows)) / len(rows),
        }

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """The dictionary in its present state."""
        self.module.dictionary.quantizer.normalise_codes()
        modules = {"dictionary": self.module.dictionary}
        return Checkpoint(self.config, self.dataset.robot, modules, metadata)
