"""Figure of trainings of sequence models: held-out cross entropy against sequences seen, by cloud.

A model that sees the scene is better with its own cloud than with another scene's or none; a blind
one is not.
"""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_bytes, read_json_object
from experiments.figures.drawing import save_figure, write_csv

TABLE = "training"
CLOUDS = {"own": ("", "-"), "wrong": ("wrong_cloud_", "--"), "none": ("no_cloud_", ":")}
SHOWN = {"own": "own cloud", "wrong": "another scene's", "none": "no cloud"}
MEASURES = {"ways": "over the ways on", "all": "over all codes"}
COLOURS = {
    "transformer": ("#1f6fb4", "#7fb0dc", "#3aa3a0"),
    "published": ("#d1662a", "#8c6d1f", "#b8336a"),
}
Row = Mapping[str, object]


def draw_training(folder: Path, out: Path) -> list[Path]:
    """Draw the trainings in a folder (`*/curves.csv`), or its training.csv; that table goes beside
    the picture.

    InvalidInputError: there is neither.
    """
    found = [row for path in sorted(folder.glob("*/curves.csv")) for row in _curve(path)]
    table = folder / f"{TABLE}.csv"
    if not found and table.is_file():
        found = list(csv.DictReader(read_bytes(table).decode().splitlines()))
    if not found:
        raise InvalidInputError(
            f"{folder} has no curves of cvqmpt train transformer or published; name the folder "
            f"above those of --out"
        )
    return [*save_figure(training_figure(found), out, TABLE), write_csv(out / table.name, found)]


def _curve(path: Path) -> list[Row]:
    """Rows of one training; none of one that learns no sequences from labels."""
    settings = read_json_object(path.parent / "training.json")
    stage = settings["stage"]
    if stage not in COLOURS:
        return []
    batch = settings["profile"][stage]["scenes"] * settings["profile"][stage]["paths"]
    lines = csv.DictReader(read_bytes(path).decode().splitlines())
    return [
        {
            "training": path.parent.name,
            "stage": stage,
            "sequences": int(line["step"]) * batch,
            "seconds": float(line["seconds"]),
            **{
                f"{cloud}_{which}": float(line[f"validation_{prefix}cross_entropy_{which}"])
                for cloud, (prefix, _) in CLOUDS.items()
                for which in MEASURES
            },
        }
        for line in lines
    ]


def training_figure(rows: Sequence[Row]) -> Figure:
    """One pair of axes for each cross entropy; a colour for each training, a dash for each cloud."""
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    names = list(dict.fromkeys(str(row["training"]) for row in rows))
    for axes, (which, words) in zip(figure.subplots(1, 2), MEASURES.items(), strict=True):
        turns = dict.fromkeys(COLOURS, 0)
        for name in names:
            own = [row for row in rows if row["training"] == name]
            stage = str(own[0]["stage"])
            colour = COLOURS[stage][turns[stage] % len(COLOURS[stage])]
            turns[stage] += 1
            x = [1e-6 * float(str(row["sequences"])) for row in own]
            for cloud, (_, dash) in CLOUDS.items():
                y = [float(str(row[f"{cloud}_{which}"])) for row in own]
                axes.plot(x, y, dash, color=colour, marker=".", label=f"{name}, {SHOWN[cloud]}")
        axes.set(
            title=f"cross entropy {words}", xlabel="sequences seen [million]", ylabel="nats a code"
        )
        axes.set_ylim(bottom=0.0)
        axes.grid(visible=True, color="0.92", linewidth=0.6)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=min(len(names), 3),
        frameon=False,
        fontsize="small",
    )
    return figure
