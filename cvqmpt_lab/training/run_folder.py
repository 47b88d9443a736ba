"""A training's folder: settings, a state to continue from, curves, and the best model.

::

    training.json       what the training is; must be equal to continue
    state.safetensors   weights, optimizer, where it stands; replaced at once or not at all
    curves.csv, .png    a line per epoch
    model/              checkpoint of the epoch with the best validation
"""

import csv
import importlib.util
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from cvqmpt_lab.codec.plain import differences
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_json_object, require_regular_file, write_bytes
from cvqmpt_lab.vqmpt.checkpoint import load_tensors
from cvqmpt_lab.vqmpt.weights import TRAINED_FOLDER

SETTINGS_FILE = "training.json"
STATE_FILE = "state.safetensors"
CURVES_FILE = "curves.csv"
PICTURE_FILE = "curves.png"


@dataclass
class Progress:
    """Where a training stands."""

    epoch: int = 0
    """The next to run."""
    batch: int = 0
    """The next to run."""
    step: int = 0
    """Optimizer steps so far."""
    seconds: float = 0.0
    sums: dict[str, float] = field(default_factory=dict)
    """Of the losses in the unfinished epoch."""
    rows: list[dict[str, float | None]] = field(default_factory=list)
    """Curves so far."""
    best: float | None = None
    """The least selecting value so far."""


class RunFolder:
    """One training's folder; see the module."""

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        """Begin in an empty folder, or continue what has equal settings.

        Raises
        ------
        InvalidInputError
            When the folder holds something else, or a training with other settings (naming the first).
        """
        self.path = Path(folder)
        self.settings = json.loads(json.dumps(settings))
        if (self.path / SETTINGS_FILE).is_file():
            self._require_equal(read_json_object(require_regular_file(self.path / SETTINGS_FILE)))
            return
        try:
            if self.path.exists() and any(self.path.iterdir()):
                raise InvalidInputError(
                    f"{self.path} is not empty and holds no training to continue; choose another --out"
                )
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InvalidInputError(
                f"cannot use {self.path}: {error.strerror}; choose another --out"
            ) from error
        write_bytes(self.path / SETTINGS_FILE, (json.dumps(self.settings, indent=2) + "\n").encode())

    def _require_equal(self, earlier: Mapping[str, Any]) -> None:
        found = differences(earlier, self.settings)
        if found:
            raise InvalidInputError(
                f"{self.path} holds another training ({min(found, key=len)}); use the same or choose another --out"
            )

    @property
    def model(self) -> Path:
        """Where the best checkpoint goes."""
        return self.path / TRAINED_FOLDER

    def save_state(self, progress: Progress, module: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        """Write everything needed to continue."""
        tensors = {f"module/{name}": _plain(tensor) for name, tensor in module.state_dict().items()}
        for index, state in optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer/{index}/{name}": _plain(value) for name, value in state.items()}
        header = {"progress": json.dumps(vars(progress))}
        write_bytes(self.path / STATE_FILE, safetensors.torch.save(tensors, header))

    def load_state(self, module: nn.Module, optimizer: torch.optim.Optimizer) -> Progress | None:
        """Fill module and optimizer from the last state; None when there is none yet.

        Raises
        ------
        InvalidInputError
            When the file is damaged or does not fit.
        """
        path = self.path / STATE_FILE
        if not path.is_file():
            return None
        try:
            with safe_open(path, "pt") as file:
                progress = Progress(**json.loads((file.metadata() or {})["progress"]))
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
            raise InvalidInputError(f"{path} is damaged: {error}; choose another --out") from error
        weights = {n.removeprefix("module/"): t for n, t in tensors.items() if n.startswith("module/")}
        load_tensors(module, weights, str(path))
        of_parameters: dict[int, dict[str, Tensor]] = {}
        for name, tensor in tensors.items():
            if name.startswith("optimizer/"):
                _, index, key = name.split("/")
                of_parameters.setdefault(int(index), {})[key] = tensor
        groups = optimizer.state_dict()["param_groups"]
        optimizer.load_state_dict({"state": of_parameters, "param_groups": groups})
        return progress

    def save_curves(self, rows: list[dict[str, float | None]], panels: Mapping[str, tuple[str, ...]]) -> None:
        """Write the curves as a table and, if matplotlib is there, as a picture."""
        buffer = io.StringIO()
        writer = csv.DictWriter(
            buffer, list(dict.fromkeys(name for row in rows for name in row)), lineterminator="\n"
        )
        writer.writeheader()
        writer.writerows(rows)
        write_bytes(self.path / CURVES_FILE, buffer.getvalue().encode())
        if importlib.util.find_spec("matplotlib") is not None:
            write_bytes(self.path / PICTURE_FILE, _picture(rows, panels))


def _plain(value: Any) -> Tensor:
    return torch.as_tensor(value).detach().cpu().contiguous().clone()


def _picture(rows: list[dict[str, float | None]], panels: Mapping[str, tuple[str, ...]]) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = {
        title: [n for n in names if any(r.get(n) is not None for r in rows)]
        for title, names in panels.items()
    }
    shown = {title: names for title, names in shown.items() if names}
    figure = Figure(figsize=(5.0 * max(len(shown), 1), 4.0), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for axes, (title, names) in zip(
        figure.subplots(1, max(len(shown), 1), squeeze=False)[0], shown.items(), strict=False
    ):
        for name in names:
            known = [(row["epoch"], row[name]) for row in rows if row.get(name) is not None]
            axes.plot(*zip(*known, strict=True), marker=".", label=name)
        axes.set(title=title, xlabel="epoch")
        axes.legend()
    buffer = io.BytesIO()
    canvas.print_png(buffer)
    return buffer.getvalue()
