"""What more training data is worth: a sequence network learned from ever more scenes, what it predicts and plans."""

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_text
from cvqmpt_lab.methods.loaded import seen_dictionary
from cvqmpt_lab.methods.method import Method, Stages, Weights
from cvqmpt_lab.methods.table import planner_named
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.planning.code_proposals import PredictedSequences
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.small_network import SmallNetwork
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.statistics import Interval, geometric_mean_interval
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.training.roadmap_shards import read_roadmap_shards
from experiments.bench.sequences import entropies
from experiments.figures.drawing import save_figure
from experiments.figures.histogram import write_csv
from experiments.figures.lines import Line, Panel, panels_figure
from experiments.labels.sequence_examples import PATHS, Steps, training_steps
from paper_tables.comparison import REFERENCE

LEARNING_CURVE = "learning-curve"
CURVE_FILE = "learning_curve.csv"
BOUNDS = ("_low", "_high")
SIZES = (1, 4, 16, 64, 256, 1024)
"""Scenes to learn from."""
HELD_OUT = 35  # scenes
BATCH, UPDATES = 256, 2000  # of every training, so that each is equally long
METHODS = ("cvq-mpt", "cvq-route")
CUTOFF = Budget(seconds=10.0)


def measure_learning_curve(
    data: Path, problems: Sequence[PlanningProblem], folder: Path, report: Callable[[int, int], None]
) -> Path:
    """Learn from the first scenes of a folder of roadmap labels, as many as `SIZES`, and write `CURVE_FILE`.

    Raises
    ------
    InvalidInputError
        When the dataset has too few scenes.
    """
    robot, shards, rng = problems[0].robot, read_roadmap_shards(data), np.random.default_rng(0)
    seen = seen_dictionary(Weights("vq_mpt"), robot)
    held_out = Steps.together(training_steps(seen, robot, shards, HELD_OUT, PATHS, rng, validate=True))
    steps: list[Steps] = []
    for one in training_steps(seen, robot, shards, max(SIZES), PATHS, rng):
        steps.append(one)
        report(len(steps), max(SIZES))
    if len(steps) < max(SIZES):
        raise InvalidInputError(f"{data} holds {len(steps)} scenes to train on; {max(SIZES)} are asked for")
    reference = _work(REFERENCE, problems)
    rows = []
    for size in SIZES:
        network = _learned(Steps.together(steps[:size]))
        row: dict[str, object] = {"scenes": size, "cross entropy [nats]": entropies(network, held_out).mean()}
        for name in METHODS:
            ratio = np.array(_work(_with_network(name, network), problems)) / reference
            found, title = (
                geometric_mean_interval(ratio, np.random.default_rng(0)),
                f"work of {name} / {REFERENCE}",
            )
            row |= {title: found.estimate, title + BOUNDS[0]: found.low, title + BOUNDS[1]: found.high}
        rows.append(row)
    return write_csv(folder / CURVE_FILE, rows)


def _learned(steps: Steps) -> SmallNetwork:
    from cvqmpt_lab.training.small_network import SmallNetworkSettings, train_sequences  # torch: not to plan

    settings = SmallNetworkSettings(batch=BATCH, epochs=-(-UPDATES * BATCH // len(steps.count)))
    return SmallNetwork.of(train_sequences(steps.features, steps.count, steps.right, 0, settings))


def _with_network(name: str, network: SmallNetwork) -> Method:
    """A method of predicted sequences, the network another one."""
    method = planner_named(name)

    def build(robot: Robot, weights: Weights | None) -> Stages:
        stages = method.build(robot, weights)
        assert isinstance(stages.predict, PredictedSequences)
        return replace(stages, predict=replace(stages.predict, network=network))

    return replace(method, build=build)


def _work(method: Method | str, problems: Sequence[PlanningProblem]) -> list[int]:
    """Projections and state checks of each problem; a search without a path counts what it has done."""
    found = [solve(problem, method, CUTOFF, 0, clearance=False).plan.counters for problem in problems]
    return [one.projections + one.state_checks for one in found]


def draw_learning_curve(folder: Path) -> list[Path]:
    """Draw `CURVE_FILE` of a folder: its first column against every other one, a panel each.

    Columns X_low and X_high are the interval of X.

    Raises
    ------
    InvalidInputError
        When there is no such file, or a cell is no number.
    """
    path = folder / CURVE_FILE
    rows = list(csv.DictReader(io.StringIO(read_text(path))))
    if not rows:
        raise InvalidInputError(
            f"{path} has no rows; write a header and a line for each size of training set"
        )
    try:
        columns = {name: [float(row[name]) for row in rows] for name in rows[0]}
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{path}: {error}; every cell must be a number") from None
    size, *others = columns
    panels = [
        Panel(name, size, "", [Line(name, columns[size], _intervals(columns, name))], log=(True, False))
        for name in others
        if not name.endswith(BOUNDS)
    ]
    return save_figure(panels_figure(panels, len(panels), legend=False), folder, "learning_curve")


def _intervals(columns: dict[str, list[float]], name: str) -> list[Interval]:
    low, high = (columns.get(name + end) for end in BOUNDS)
    return [
        Interval(value, low[k] if low else None, high[k] if high else None, 1)
        for k, value in enumerate(columns[name])
    ]
