"""Stage 1 of VQ-MPT: training of the dictionary, whose codes are decoded to Gaussians over joints.

A waypoint q is encoded to a latent z = f(q). It is replaced by the nearest code z_q of the
dictionary, which is decoded to N(mu, Sigma), Sigma = L D L^T. The loss of trajectories q_1 ... q_T
is the sum of the reconstruction loss, the mean over trajectories of

    sum_t [ -log N(q_t | mu_t, Sigma_t) - w H(N(mu_t, Sigma_t)) ],

and of the quantization loss, the mean over waypoints of

    beta ||sg(z_q) - z||^2 + ||z_q - sg(z)||^2,

where sg stops the gradient. Padding is not counted. The model with the smallest reconstruction loss
in validation is kept.
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
from cvqmpt_lab.vqmpt.config import ModelConfig, NotNegative, Positive, Share, Size
from cvqmpt_lab.vqmpt.dictionary import Dictionary, Gaussians, LinkPositions, Quantized


@dataclass(frozen=True, kw_only=True)
class Stage1Settings:
    """How the dictionary is trained."""

    epochs: Size = 20
    batch: Size = 64  # rows of a batch, which are paths
    # An encoder of single waypoints gets rows of this many random waypoints instead of paths. So
    # the parts of the loss keep their published proportions.
    row: Size = 32
    batches_per_epoch: Size | None = None  # maximum number; None for all paths
    spacing: Positive | None = None  # distance of waypoints along a path [rad]; None for all
    trivial_share: Share = 0.15  # maximum share of paths whose straight line is free
    turn_base: bool = False  # whether paths are rotated about the base at random
    entropy_weight: NotNegative = 0.1  # w, which keeps Gaussians wide
    # number of steps between restarts of rarely used codes (if `data_initialised`)
    restart_every: int = 200
    restart_epochs: int = 10  # number of first epochs that have restarts
    restart_below: NotNegative = 0.02  # codes used less than this share of the mean are restarted
    validation_paths: Size = 1000  # maximum number
    optimizer: OptimizerSettings = field(default_factory=lambda: OptimizerSettings(rate=1e-3))


def stage1_loss(
    gaussians: Gaussians,
    quantized: Quantized,
    u: Tensor,
    visible: Tensor,
    commitment: float,
    entropy_weight: float = 0.1,
) -> dict[str, Tensor]:
    """Compute the loss of the module's docstring.

    Args:
        gaussians: decoded Gaussians (b, t) of the waypoints.
        quantized: latents (b, t) of the waypoints.
        u: (b, t, n), normalised joints of the waypoints.
        visible: (b, t) bool, False for padding.
        commitment: beta.
        entropy_weight: w.

    Returns:
        ``loss`` and its parts ``reconstruction`` and ``quantization``, scalars.
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
    uses: Tensor  # (n_codes,) number of waypoints of each code since the last restart

    def __init__(
        self,
        dataset: PathDataset,
        config: ModelConfig,
        settings: Stage1Settings,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on a dataset.

        Args:
            dataset: paths.
            config: sizes of the dictionary.
            settings: how to train.
            seed: seed of all random numbers.
            device: device to train on.

        Raises:
            InvalidInputError: there are no paths for training or none for validation.
        """
        super().__init__(settings.optimizer, seed, device)
        dataset.require_splits()
        self.dataset = dataset.thinned(settings.spacing)
        self._turn = BaseTurn(self.dataset, settings.turn_base)
        self.config, self.settings = config, settings
        self.dictionary = Dictionary(config)
        self.register_buffer("uses", torch.zeros(config.dictionary.n_codes, dtype=torch.int64))
        self.to(device)
        chain = dataset.chain if config.feature_dim else None
        self._links = LinkPositions(dataset.robot.lower, dataset.robot.upper, chain, device)
        self._latents = torch.empty(0)  # of the last batch

    def prepare(self) -> None:
        """Initialise the codes with encoded waypoints z = f(q), if `data_initialised`."""
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
        all_codes = torch.ones(codes, dtype=torch.bool, device=self.device)
        self.dictionary.quantizer.restart_codes(all_codes, torch.cat(latents))

    def batches(self, epoch: int) -> Batches:
        """Return batches (batch, t, n) of padded paths, or (batch, row, n) of single waypoints."""
        settings = self.settings
        rng = np.random.default_rng((self.seed, epoch))
        rows = self.dataset.with_few_trivial(
            self.dataset.split("train"), settings.trivial_share, rng
        )
        most = settings.batches_per_epoch
        if self.config.dictionary.encoder == "mlp":
            start = self.dataset.arrays["path_start"]
            of_paths = [np.arange(start[row], start[row + 1]) for row in rows]
            order = rng.permutation(np.concatenate(of_paths))
            size = settings.batch * settings.row
            # the rest of the waypoints is left out; too few for a batch are repeated
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
        """Compute the loss of a batch and its parts, see `stage1_loss`."""
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
        """Replace rarely used codes by latents of the last batch, every `restart_every` steps."""
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
        """Compute losses of held-out paths, per waypoint [nats], and use of the codes."""
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
        """Return the dictionary with its present weights."""
        self.dictionary.quantizer.normalise_codes()
        modules = {"dictionary": self.dictionary}
        return Checkpoint(self.config, self.dataset.robot, modules, metadata)
