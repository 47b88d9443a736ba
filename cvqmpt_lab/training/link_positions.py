"""Positions of points on a serial chain, for many configurations at once: features that models take."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cvqmpt_lab.errors import InvalidInputError


@dataclass(frozen=True, eq=False)
class SerialChain:
    """Joints in a row, each turning about its own z axis, and points fixed to their links.

    frame_j = frame_(j-1) (rotation_j, translation_j) Rz(q_j), the first in the robot's base.
    """

    rotation: np.ndarray
    """(n, 3, 3), from one joint's frame to the next."""
    translation: np.ndarray
    """(n, 3) [m], likewise."""
    points: np.ndarray
    """(k,) int64, the frame that each point moves with."""
    offsets: np.ndarray
    """(k, 3) [m], where in that frame."""

    @classmethod
    def from_json(cls, data: Mapping[str, Any], joints: int, where: str) -> "SerialChain":
        """Read lists ``rotation``, ``translation``, ``points`` and ``offsets``.

        Raises
        ------
        InvalidInputError
            Naming, after `where`, the field that is missing or of another shape.
        """
        if not isinstance(data, Mapping):
            raise InvalidInputError(f"{where} is {type(data).__name__}; it must be an object")
        count = len(data["points"]) if isinstance(data.get("points"), list) else 0
        shapes = {
            "rotation": (joints, 3, 3),
            "translation": (joints, 3),
            "points": (count,),
            "offsets": (count, 3),
        }
        arrays = {}
        for name, shape in shapes.items():
            try:
                array = np.asarray(data[name], dtype=np.float64)
            except (KeyError, TypeError, ValueError):
                array = np.empty(0)
            if array.shape != shape or count == 0 or not np.isfinite(array).all():
                raise InvalidInputError(
                    f"{where}.{name} must be numbers of shape {shape}, at least one point"
                )
            arrays[name] = array
        points = arrays["points"].astype(np.int64)
        if points.min() < 0 or points.max() >= joints:
            raise InvalidInputError(f"{where}.points are frames 0 to {joints - 1}, not {points.tolist()}")
        return cls(arrays["rotation"], arrays["translation"], points, arrays["offsets"])

    def to_json(self) -> dict[str, Any]:
        """What `from_json` reads."""
        return {
            name: getattr(self, name).tolist() for name in ("rotation", "translation", "points", "offsets")
        }

    @property
    def feature_dim(self) -> int:
        """Numbers that `LinkPositions` gives for a configuration."""
        return 3 * len(self.points)

    @property
    def turns_about_base(self) -> bool:
        """The first joint's axis is the base's z axis, so that turning it turns the whole robot."""
        on_axis = np.abs(self.translation[0, :2]).max() < 1e-6
        return bool(on_axis and np.allclose(self.rotation[0, :, 2], (0.0, 0.0, 1.0), atol=1e-6))


class LinkPositions:
    """Configurations as the models take them: normalised joints, then link positions, if any."""

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
        """Positions (..., 3 k) [m, robot base frame] of joints q (..., n) [rad]."""
        if self._chain is None:
            raise InvalidInputError("link positions need the dataset's kinematics; it has none")
        flat = q.reshape(-1, q.shape[-1])
        cosine, sine = flat.cos(), flat.sin()
        x, y, z = (self._rotation[0, :, axis].expand(len(flat), 3) for axis in range(3))
        origin = self._translation[0].expand(len(flat), 3)
        places: dict[int, Tensor] = {}
        last = int(self._chain.points.max())
        for joint in range(last + 1):
            if joint:
                step, shift = self._rotation[joint], self._translation[joint]
                origin = origin + x * shift[0] + y * shift[1] + z * shift[2]
                x, y, z = (x * step[0, i] + y * step[1, i] + z * step[2, i] for i in range(3))
            c, s = cosine[:, joint, None], sine[:, joint, None]
            x, y = x * c + y * s, y * c - x * s
            for point in np.flatnonzero(self._chain.points == joint).tolist():
                offset = self._offsets[point]
                places[point] = origin + x * offset[0] + y * offset[1] + z * offset[2]
        stacked = torch.cat([places[point] for point in range(len(places))], dim=-1)
        return stacked.reshape(*q.shape[:-1], -1)
