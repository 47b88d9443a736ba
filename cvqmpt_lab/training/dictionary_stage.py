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
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cvqmpt_lab.training.dataset import BaseTurn, PathDataset
from cvqmpt_lab.training.stage import Batches, OptimizerSettings, Stage
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import ModelConfig, Size
from cvqmpt_lab.vqmpt.dictionary import Dictionary, Gaussians, LinkPositions, Quantized


@dataclass(frozen=True, kw_only=True)
class Stage1Settings:
    """How the dictionary is trained."""

    epochs: int = 20
    # Rows of a batch are paths. An encoder of single waypoints takes rows of `row` unrelated ones
    # instead, so that the parts of the loss keep their published proportions.
    batch: Size = 64
    row: Size = 32
    batches_per_epoch: Size | None = None  # at most; None for all paths
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


def stage1_loss(
    gaussians: Gaussians,
    quantized: Quantized,
    u: Tensor,
    visible: Tensor,
    commitment: float,
    entropy_weight: float = 0.1,
) -> dict[str, Tensor]:
    """Loss of the module's docstring, and its parts reconstruction and quantization: scalars.

    Args:
        gaussians: the dictionary's, of waypoints u.
        quantized: likewise.
        u: (b, t, n) normalised joints.
        visible: (b, t) bool, False where padded.
        commitment: beta.
        entropy_weight: w.
    """
    nll = -torch.where(visible, gaussians.log_prob(u), 0.0).sum() / len(u)
    negative_entropy = -torch.where(visible, gaussians.entropy(), 0.0).sum() / len(u)
    reconstruction = nll + entropy_weight * negative_entropy
    z, z_q = quantized.latent, quantized.quantized
    to_code = (z_q.detach() - z).square().sum(-1)
    to_latent = (z_q - z.detach()).square().sum(-1)
    quantization = (commitment * to_code + to_latent)[visible].mean()
    return {
        "loss": reconstruction + quantization,
        "reconstruction": reconstruction,
        "quantization": quantization,
    }


class DictionaryStage(Stage):
    """Training of a `Dictionary`."""

    selection = "validation_reconstruction"
    dataset: PathDataset
    uses: Tensor  # of each code since the last restart

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
        self._turn = BaseTurn(self.dataset, settings.turn_base)
        self.config, self.settings = config, settings
        self.dictionary = Dictionary(config)
        self.register_buffer("uses", torch.zeros(config.dictionary.n_codes, dtype=torch.int64))
        self.to(device)
        robot, chain = self.dataset.robot, self.dataset.chain if config.feature_dim else None
        self._links = LinkPositions(robot.lower, robot.upper, chain, device)
        self._latents = torch.empty(0)

    def prepare(self) -> None:
        """Initialise the codes with encoded waypoints z = f(q)."""
        if not self.config.dictionary.data_initialised:
            return
        codes, latents = self.config.dictionary.n_codes, []
        with torch.no_grad():
            for arrays in self.batches(0):
                batch = self.tensors(arrays)
                z = self.dictionary.encoder(self._links.configurations(batch["u"]))
                latents.append(z[batch["visible"]])
                if sum(map(len, latents)) >= 2 * codes:
                    break
        every = torch.ones(codes, dtype=torch.bool, device=self.device)
        self.dictionary.quantizer.restart_codes(every, torch.cat(latents))

    def batches(self, epoch: int) -> Batches:
        """Batches (batch, t, n) of whole paths, padded, or (batch, row, n) of single waypoints."""
        rng, settings = np.random.default_rng((self.seed, epoch)), self.settings
        rows = self.dataset.with_few_trivial(
            self.dataset.split("train"), settings.trivial_share, rng
        )
        most = settings.batches_per_epoch
        if self.config.dictionary.encoder == "mlp":
            start = self.dataset.arrays["path_start"]
            of_paths = [np.arange(start[row], start[row + 1]) for row in rows]
            order = rng.permutation(np.concatenate(of_paths))
            size = settings.batch * settings.row
            # the last waypoints are left out, or all repeated up to one batch
            batches = np.resize(order, (max(1, len(order) // size), size))
            return Batches(batches[:most], self._waypoints, self.seed, epoch)
        order = rng.permutation(rows)
        parts = np.split(order, range(settings.batch, len(order), settings.batch))
        return Batches(parts[:most], self._trajectories, self.seed, epoch)

    def _waypoints(self, rows: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
        paths = np.searchsorted(self.dataset.arrays["path_start"], rows, side="right") - 1
        u = self.dataset.joints(rows)
        u[:, 0] += self._turn.draw_each(paths, rng)
        shape = (self.settings.batch, self.settings.row)
        return {"u": u.reshape(*shape, -1), "visible": np.ones(shape, dtype=bool)}

    def _trajectories(self, paths: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
        batch = self._padded(paths)
        batch["u"][:, :, 0] += self._turn.draw_each(paths, rng)[:, None]
        return batch

    def _padded(self, paths: np.ndarray) -> dict[str, np.ndarray]:
        u, counts = self.dataset.padded(paths)
        return {"u": u, "visible": np.arange(u.shape[1]) < counts[:, None]}

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Mean loss of a batch and its parts, see the module."""
        u, visible = batch["u"], batch["visible"]
        gaussians, quantized = self.dictionary(self._links.configurations(u))
        with torch.no_grad():
            used = quantized.codes[visible]
            self.uses += torch.bincount(used, minlength=len(self.uses))
            self._latents = quantized.latent[visible].detach()
        beta = self.config.dictionary.commitment
        weight = self.settings.entropy_weight
        return stage1_loss(gaussians, quantized, u, visible, beta, weight)

    def after_step(self, epoch: int, step: int, optimizer: torch.optim.Optimizer) -> None:
        """Move codes that are hardly used to latents of the last batch."""
        settings = self.settings
        if not self.config.dictionary.data_initialised or step % max(settings.restart_every, 1):
            return
        uses = self.uses
        if epoch < settings.restart_epochs:
            dead = uses < settings.restart_below * uses.float().mean()
            self.dictionary.quantizer.restart_codes(dead, self._latents)
            state = optimizer.state.get(self.dictionary.quantizer.embedding.weight, {})
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
            batch = self.tensors(self._padded(rows[first : first + 64]))
            u, visible = batch["u"], batch["visible"]
            gaussians, quantized = self.dictionary(self._links.configurations(u))
            codes = quantized.codes
            sums["nll"] -= float(gaussians.log_prob(u)[visible].double().sum())
            sums["negative_entropy"] -= float(gaussians.entropy()[visible].double().sum())
            std = gaussians.covariance.diagonal(dim1=-2, dim2=-1).sqrt().cpu() * span
            sums["std"] += float(std[visible.cpu()].mean(-1).double().sum())
            sums["changes"] += float(((codes[:, 1:] != codes[:, :-1]) & visible[:, 1:]).sum())
            used += torch.bincount(codes[visible].cpu(), minlength=len(used))
            waypoints += int(visible.sum())
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
        self.dictionary.quantizer.normalise_codes()
        modules = {"dictionary": self.dictionary}
        return Checkpoint(self.config, self.dataset.robot, modules, metadata)
