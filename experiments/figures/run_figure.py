"""The paper's figures as runs: a folder of pictures, their numbers and where they come from."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.errors import RunStoreError
from cvqmpt_lab.files import make_folder
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import PROVENANCE_FILE, ProvenanceFile, provenance
from cvqmpt_lab.vqmpt.weights import SHIPPED, resolve_model, weights_digest
from experiments.figures.code_update import (
    FAR,
    CodeUpdate,
    UpdateSettings,
    code_changes,
    histogram_figure,
    update_codes,
    write_tables,
)
from experiments.figures.drawing import save_figure
from experiments.figures.equal_time import NAME, RESTARTED, SECONDS, draw_equal_time
from experiments.figures.row_figures import draw_cost, draw_difficulty, draw_robustness
from experiments.figures.scene_pictures import hand_figure, hands_of_code, write_hands
from experiments.run import weights_of
from experiments.suites.suite import suite_named

SUITE = "place-task"
MODEL = "vq_mpt"


def reproduce_figure(
    figure: str,
    out: Path,
    command: Sequence[str],
    problem: int = 0,
    model: str | None = None,
    settings: UpdateSettings | None = None,
) -> tuple[CodeUpdate, list[Path]]:
    """Predict, update, and write a figure of `FIGURES`, tables and provenance into a folder.

    model: its name or folder (None: the shipped one). RunStoreError: the folder holds other results.
    """
    posed = suite_named(SUITE).solvable(problem)
    assert isinstance(posed, PlanningProblem)
    settings, folder = settings or UpdateSettings(), resolve_model(model or MODEL, SHIPPED[MODEL])
    configuration: dict[str, Any] = {
        "figure": figure,
        "suite": SUITE,
        "problem": problem,
        "update": asdict(settings),
    }
    session = provenance(command, [settings.seed], {MODEL: weights_digest(folder)})
    record = _record(out, configuration, session)
    update = update_codes(posed, str(folder), settings)
    record.create(configuration, session)
    return update, [*FIGURES[figure](update, out), record.path]


def compare_at_equal_time(out: Path, problems: int, command: Sequence[str]) -> list[Path]:
    """Run methods on the first problems of the place task until time is up; figure, table and provenance in a folder.

    RunStoreError: the folder holds other results.
    """
    configuration = {"figure": NAME, "suite": SUITE, "problems": problems, "seconds": SECONDS}
    session = provenance(command, [0], weights_of(RESTARTED))
    record = _record(out, configuration, session)
    asked = [suite_named(SUITE).solvable(index) for index in range(problems)]
    written = draw_equal_time([each for each in asked if isinstance(each, PlanningProblem)], out)
    record.create(configuration, session)
    return [*written, record.path]


def _record(out: Path, configuration: Mapping[str, Any], session: Mapping[str, Any]) -> ProvenanceFile:
    """Where the provenance goes; RunStoreError when the folder holds results of something else."""
    record = ProvenanceFile(make_folder(out))
    if record.path.is_file():
        record.require_same(configuration, session)
    elif any(out.iterdir()):
        raise RunStoreError(f"{out} holds files without {PROVENANCE_FILE}; use an empty folder as --out")
    return record


def _histogram(update: CodeUpdate, folder: Path) -> list[Path]:
    changes = code_changes(update)
    return [
        *save_figure(histogram_figure(changes), folder, "histogram"),
        *write_tables(update, changes, folder),
    ]


def _concept(update: CodeUpdate, folder: Path) -> list[Path]:
    far = update.representatives()[FAR]
    sides = hands_of_code(update, far)
    figure = hand_figure(update.problem, [side.panel for side in sides])
    table = write_hands(int(update.codes[far]), sides, folder / "concept.csv")
    return [*save_figure(figure, folder, "concept"), table]


# figures by name, drawn into a folder: of an update, and of a folder of rows
FIGURES: Mapping[str, Callable[[CodeUpdate, Path], list[Path]]] = {
    "histogram": _histogram,
    "concept": _concept,
}
ROW_FIGURES: Mapping[str, Callable[[Path], list[Path]]] = {
    "robustness": draw_robustness,
    "cost": draw_cost,
    "difficulty": draw_difficulty,
}


def summary(update: CodeUpdate) -> list[str]:
    """A few lines about an update."""
    before, after = update.g_before.mean(axis=1), update.g_after.mean(axis=1)
    inside = [(g == 0.0).mean() for g in (update.g_before, update.g_after)]
    centres = [np.median(g) for g in (update.centre_before, update.centre_after)]
    lines = [
        f"{len(before)} codes to {len(update.problem.goals)} goals, {int(update.kept.sum())} of them left in place",
        f"F^T F at the means: median {centres[0]:.4g} before, {centres[1]:.4g} after",
        f"mean F^T F of all draws: {before.mean():.4g} before, {after.mean():.4g} after",
        f"draws on the constraint: {inside[0]:.2%} before, {inside[1]:.2%} after",
    ]
    for role, i in update.representatives().items():
        lines.append(f"{role}: code {update.codes[i]}: {before[i]:.4g} before, {after[i]:.4g} after")
    return lines
