"""Forward kinematics in torch, differentiable: positions of points fixed to a serial chain."""

import torch
from torch import Tensor

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.config import SerialChain


class LinkPositions:
    """Configurations as models take them: u = (q - q_min) / (q_max - q_min), link positions."""

    def __init__(
        self,
        lower: tuple[float, ...],
        upper: tuple[float, ...],
        chain: SerialChain | None,
        device: torch.device | str = "cpu",
    ) -> None:
        self._lower = torch.tensor(lower, dtype=torch.float32, device=device)
        self._range = torch.tensor(upper, dtype=torch.float32, device=device) - self._lower
        self._chain = chain
        if chain is not None:
            self._rotation = torch.tensor(chain.rotation, dtype=torch.float32, device=device)
            self._translation = torch.tensor(chain.translation, dtype=torch.float32, device=device)
            self._offsets = torch.tensor(chain.offsets, dtype=torch.float32, device=device)

    def configurations(self, u: Tensor) -> Tensor:
        """Configurations (..., n + 3 k) of normalised joints u (..., n); differentiable."""
        if self._chain is None:
            return u
        return torch.cat((u, self.positions(self._lower + u * self._range)), dim=-1)

    def positions(self, q: Tensor) -> Tensor:
        """Positions (..., 3 k) [m, robot base frame] of joints q (..., n) [rad or m]."""
        if self._chain is None:
            raise InvalidInputError("link positions need the dataset's kinematics; it has none")
        flat = q.reshape(-1, q.shape[-1])
        cosine, sine = flat.cos(), flat.sin()
        x, y, z = (self._rotation[0, :, axis].expand(len(flat), 3) for axis in range(3))
        origin = self._translation[0].expand(len(flat), 3)
        places: dict[int, Tensor] = {}
        last = max(self._chain.points)
        for joint in range(last + 1):
            if joint:
                step, shift = self._rotation[joint], self._translation[joint]
                origin = origin + x * shift[0] + y * shift[1] + z * shift[2]
                x, y, z = (x * step[0, i] + y * step[1, i] + z * step[2, i] for i in range(3))
            if joint in self._chain.sliders:
                origin = origin + z * flat[:, joint, None]
            else:
                c, s = cosine[:, joint, None], sine[:, joint, None]
                x, y = x * c + y * s, y * c - x * s
            for point in (k for k, frame in enumerate(self._chain.points) if frame == joint):
                offset = self._offsets[point]
                places[point] = origin + x * offset[0] + y * offset[1] + z * offset[2]
        stacked = torch.cat([places[point] for point in range(len(places))], dim=-1)
        return stacked.reshape(*q.shape[:-1], -1)
