"""The scanned scenes measured in other ways, one thing varied at a time."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

from cvqmpt_lab.results.row import phase_problem
from experiments.suites.place_task import UnsolvableProblem
from experiments.suites.scanned_scenes import SCENES
from experiments.suites.sensor import SensedProblem, Sensing, sensor_problem

LEVELS: Mapping[str, Sequence[Any]] = {
    "noise": (0.0, 2.0, 4.0),
    "cameras": (1, 4),
    "pixels": (40_000, 10_000, 2_500),
    "resolution": (0.01, 0.04),
    "padding": (0.0, 0.01, 0.03, 0.04),
}
"""What else is tried of each field of `Sensing`, beside its default."""
PLANNERS = ("birrt", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq")
"""Uniform samples, then learned ones."""


def variants() -> tuple[Sensing, ...]:
    """The default, then everything that differs from it in one field."""
    default = Sensing()
    others = (
        replace(default, **{name: level})
        for name, levels in LEVELS.items()
        for level in levels
        if level != getattr(default, name)
    )
    return (default, *others)


PROBLEMS = range(len(SCENES) * len(variants()))


def setting(sensing: Sensing) -> str:
    """All fields of a `Sensing` in words, as the table of the rows reads them."""
    values = ((item.name, getattr(sensing, item.name)) for item in fields(sensing))
    return " ".join(f"{name}={'all' if value is None else format(value, 'g')}" for name, value in values)


def robustness_problem(index: int) -> SensedProblem | UnsolvableProblem:
    """Variant index // 10 of scene index % 10; its rows are named like a phase, by scene and setting."""
    sensing, number = variants()[index // len(SCENES)], index % len(SCENES)
    item = sensor_problem(number, sensing)
    name = phase_problem(str(index), number + 1, setting(sensing))
    if isinstance(item, UnsolvableProblem):
        return replace(item, name=name)
    return replace(item, problem=replace(item.problem, name=name))
