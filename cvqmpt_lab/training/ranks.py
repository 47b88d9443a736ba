"""Processes that train one model together, as `torchrun` starts them: each on batches of its own, with mean gradients.

Gradients travel by gloo through main memory, so that it is the same on CPUs and GPUs, on one machine or several.
"""

import os
from collections.abc import Iterable
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import nn


@dataclass(frozen=True)
class Ranks:
    """Which of them this process is; alone unless `torchrun` started it."""

    rank: int = 0
    """The first one, 0, writes and reports."""
    count: int = 1

    @classmethod
    def joined(cls) -> "Ranks":
        """Meet the other processes, if there are any, and take a GPU of one's own, if there is one."""
        if int(os.environ.get("WORLD_SIZE", "1")) == 1:
            return cls()
        if not dist.is_initialized():
            dist.init_process_group("gloo")
        if torch.cuda.is_available():
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]) % torch.cuda.device_count())
        return cls(dist.get_rank(), dist.get_world_size())

    @property
    def is_first(self) -> bool:
        """Whether this process writes and reports."""
        return self.rank == 0

    def wait(self) -> None:
        """Until all are here."""
        if self.count > 1:
            dist.barrier()

    def share_weights(self, module: nn.Module) -> None:
        """Give all of them the weights of the first."""
        if self.count > 1:
            for tensor in module.state_dict().values():
                there = tensor.cpu()
                dist.broadcast(there, src=0)
                tensor.copy_(there)

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace gradients by their mean over all processes; who has none counts as zero, unless nobody has one."""
        if self.count == 1:
            return
        every = [parameter for parameter in parameters if parameter.requires_grad]
        has = torch.tensor([float(parameter.grad is not None) for parameter in every])
        parts = [(torch.zeros_like(p) if p.grad is None else p.grad).flatten().cpu() for p in every]
        flat = self._sum(torch.cat([has, *parts]))
        means = (flat[len(every) :] / self.count).split([parameter.numel() for parameter in every])
        for parameter, anywhere, mean in zip(every, flat[: len(every)], means, strict=True):
            parameter.grad = mean.view_as(parameter).to(parameter.device) if anywhere else None

    def mean(self, *values: float) -> list[float]:
        """Means over all processes; of truths, positive where any is true."""
        if self.count == 1:
            return [float(value) for value in values]
        return (self._sum(torch.tensor(values, dtype=torch.float64)) / self.count).tolist()

    def _sum(self, values: torch.Tensor) -> torch.Tensor:
        dist.all_reduce(values)
        return values
