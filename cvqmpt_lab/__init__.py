"""Constrained motion planning with learned sampling dictionaries: a reproducibility toolkit for CVQ-MPT."""

from importlib import import_module
from typing import Any

_HOME = {
    "Budget": "search.result",
    "GaussianMixture": "search.query",
    "Method": "planners",
    "PLANNERS": "planners",
    "PlanningProblem": "problem",
    "Scene": "scene.scene",
    "Task": "tasks.task",
    "TaskSpaceRegion": "constraints.task_space_region",
    "certify": "certificate",
    "load_robot": "robot.loading",
    "planner_named": "planners",
    "solve": "pipeline",
    "solve_many": "pipeline",
    "solve_task": "tasks.solve_task",
}
"""Each public name and the module it lives in; a module is imported when a name of it is first used."""

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    """Import a public name from where it lives."""
    if name not in _HOME:
        raise AttributeError(
            f"module {__name__!r} has no attribute {name!r}; public names: {', '.join(_HOME)}"
        )
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    """Names for completion."""
    return [*globals(), *_HOME]
