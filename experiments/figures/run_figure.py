"""The paper's figures as runs: a folder of pictures, their numbers and where they come from."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.errors import RunStoreError
from cvqmpt_lab.files import make_folder
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import PROVENANCE_FILE, ProvenanceFile, provenance
from cvqmpt_lab.vqmpt.weights import SHIPPED, resolve_model, weights_digest
from experiments.figures.code_update import (
    CodeUpdate,
    UpdateSettings,
    histogram_figure,
    update_codes,
    write_tables,
)
from experiments.figures.drawing import save_figure
from experiments.figures.row_figures import draw_cost
from experiments.figures.scene_pictures import concept_figure, write_hands
from experiments.figures.training_curves import draw_training

SUITE = "place-task"
MODEL = "vq_mpt"


def reproduce_figure(
    figure: str,
    out: Path,
    command: Sequence[str],
    problems: Sequence[int] = (0,),
    model: str | None = None,
    settings: UpdateSettings | None = None,
) -> tuple[list[CodeUpdate], list[Path]]:
    """Predict and update on problems, and write a figure of `FIGURES`, tables and provenance into a
    folder.

    model: its name or folder (None: the shipped one). RunStoreError: the folder holds other
        results.
    """
    posed = [suite_named(SUITE).solvable(index) for index in problems]
    settings, folder = settings or UpdateSettings(), resolve_model(model or MODEL, SHIPPED[MODEL])
    configuration: dict[str, Any] = {
        "figure": figure,
        "suite": SUITE,
        "problems": list(problems),
        "update": asdict(settings),
    }
    session = provenance(command, [settings.seed], {MODEL: weights_digest(folder)})
    record = _record(out, configuration, session)
    updates = [
        update_codes(each, str(folder), settings)
        for each in posed
        if isinstance(each, PlanningProblem)
    ]
    record.create(configuration, session)
    return updates, [*FIGURES[figure](updates, out), record.path]


def _record(
    out: Path, configuration: Mapping[str, Any], session: Mapping[str, Any]
) -> ProvenanceFile:
    """Where the provenance goes; RunStoreError when the folder holds results of something else."""
    record = ProvenanceFile(make_folder(out))
    if record.path.is_file():
        record.require_same(configuration, session)
    elif any(out.iterdir()):
        raise RunStoreError(
            f"{out} holds files without {PROVENANCE_FILE}; use an empty folder as --out"
        )
    return record


def _histogram(updates: Sequence[CodeUpdate], folder: Path) -> list[Path]:
    return [
        *save_figure(histogram_figure(updates), folder, "histogram"),
        *write_tables(updates, folder),
    ]


def _concept(updates: Sequence[CodeUpdate], folder: Path) -> list[Path]:
    (update,) = updates
    table = write_hands(update, folder / "concept.csv")
    return [*save_figure(concept_figure(update), folder, "concept"), table]


# figures by name, drawn into a folder: of updates, and of a folder of rows
FIGURES: Mapping[str, Callable[[Sequence[CodeUpdate], Path], list[Path]]] = {
    "histogram": _histogram,
    "concept": _concept,
}
ROW_FIGURES: Mapping[str, Callable[[Path, Path], list[Path]]] = {
    "cost": draw_cost,
    "training": draw_training,
}


def summary(updates: Sequence[CodeUpdate]) -> list[str]:
    """A few lines about updates; medians over problems, so that each counts once."""
    codes = [len(update.codes) for update in updates]
    lines = [f"{len(updates)} problems, {sum(codes)} codes, {min(codes)} to {max(codes)} a problem"]
    for what, last in (("codes", True), ("all that is sampled, goals included", False)):
        g = {
            when: [u.g(when)[: len(u.codes) if last else None] for u in updates]
            for when in ("before", "after")
        }
        mean = {when: np.median([values.mean() for values in found]) for when, found in g.items()}
        norm = {
            when: np.median([np.median(np.sqrt(values)) for values in found])
            for when, found in g.items()
        }
        lines.append(
            f"{what}: mean F^T F {mean['before']:.3g} before, {mean['after']:.3g} after; "
            f"median |F| {norm['before']:.3g} before, {norm['after']:.3g} after"
        )
    return lines
