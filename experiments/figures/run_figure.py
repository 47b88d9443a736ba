"""The paper's figures as runs: a folder of pictures, their numbers and where they come from."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import RunStoreError, UnknownChoiceError
from cvqmpt_lab.models.checkpoint import Checkpoint, load_checkpoint
from cvqmpt_lab.models.weights_folder import checkpoint_sha256
from cvqmpt_lab.prediction.configurations import robot_signature
from cvqmpt_lab.prediction.shipped import shipped_model_folder
from cvqmpt_lab.results.provenance import PROVENANCE_FILE, ProvenanceFile, as_json, provenance
from cvqmpt_lab.robot.loading import robot_from_source
from experiments.figures.drawing import hand_figure, histogram_figure, save_figure
from experiments.figures.hand_poses import hand_change, write_hands
from experiments.figures.histogram import code_changes, write_tables
from experiments.figures.latent_update import FAR, LatentUpdate, UpdateSettings, update_latents
from experiments.suites.table import suite_named

SUITE = "place-task"


@dataclass(frozen=True)
class FigureRequest:
    """What to draw: a figure of `FIGURES`, of one problem, by a model's folder (None: the shipped one)."""

    figure: str
    out: Path
    problem: int = 0
    model: Path | None = None
    settings: UpdateSettings = field(default_factory=UpdateSettings)

    def __post_init__(self) -> None:
        if self.figure not in FIGURES:
            raise UnknownChoiceError("figure", self.figure, FIGURES)


def reproduce_figure(request: FigureRequest, command: Sequence[str]) -> tuple[LatentUpdate, list[Path]]:
    """Predict, update, and write figure, tables and provenance into the request's folder.

    Raises
    ------
    InvalidInputError
        For an unknown problem, or a model that cannot be used.
    RunStoreError
        When the folder cannot be written to or holds other results.
    """
    problem = suite_named(SUITE).problem(request.problem)
    model = request.model or shipped_model_folder()
    checkpoint = _checkpoint(model)
    record = ProvenanceFile(request.out)
    sha256 = checkpoint_sha256(model)
    configuration = as_json(
        "the configuration",
        {
            "figure": request.figure,
            "suite": SUITE,
            "problem": request.problem,
            "model_sha256": sha256,
            "update": asdict(request.settings),
        },
    )
    _prepare(record, configuration)
    update = update_latents(problem, checkpoint, request.settings)
    seeds = [request.settings.seed]
    record.create(configuration, provenance(command, configuration, seeds, sha256))
    return update, [*FIGURES[request.figure](update, request.out), record.path]


def _checkpoint(model: Path) -> Checkpoint:
    return load_checkpoint(model, robot_signature(robot_from_source({"name": "panda"})))


def _prepare(record: ProvenanceFile, configuration: Mapping[str, object]) -> None:
    """Make the folder, unless it holds something that would be overwritten by something else."""
    folder = record.directory
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()) and not record.path.is_file():
            raise RunStoreError(
                f"{folder} holds files without {PROVENANCE_FILE}; choose an empty folder as --out"
            )
    except OSError as error:
        raise RunStoreError(f"cannot write to {folder}: {error.strerror}; use another --out") from error
    if record.path.is_file():
        record.require_equal(configuration)


def _histogram(update: LatentUpdate, folder: Path) -> list[Path]:
    changes = code_changes(update)
    return [
        *save_figure(histogram_figure(changes), folder, "histogram"),
        *write_tables(update, changes, folder),
    ]


def _concept(update: LatentUpdate, folder: Path) -> list[Path]:
    change = hand_change(update, update.representatives()[FAR])
    figure = hand_figure(update.problem, change.panels)
    return [*save_figure(figure, folder, "concept"), write_hands(change, folder / "concept.csv")]


FIGURES: Mapping[str, Callable[[LatentUpdate, Path], list[Path]]] = {
    "histogram": _histogram,
    "concept": _concept,
}
"""Figures by name, each drawn into a folder; they return what they wrote."""


def summary(update: LatentUpdate) -> list[str]:
    """A few lines about an update."""
    before, after = update.g_before.mean(axis=1), update.g_after.mean(axis=1)
    inside = [(g == 0.0).mean() for g in (update.g_before, update.g_after)]
    lines = [
        f"{len(before)} codes to {len(update.prediction.goals)} goals, "
        f"{int(update.optimized.kept.sum())} of them left where they were",
        f"mean F^T F of all codes: {before.mean():.4g} before, {after.mean():.4g} after "
        f"(median {np.median(before):.4g}, {np.median(after):.4g})",
        f"draws on the constraint: {inside[0]:.2%} before, {inside[1]:.2%} after",
    ]
    for role, i in update.representatives().items():
        lines.append(
            f"{role}: code {update.prediction.codes[i]}: {before[i]:.4g} before, {after[i]:.4g} after"
        )
    return lines
