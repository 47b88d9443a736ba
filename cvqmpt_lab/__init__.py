"""Toolkit to reproduce CVQ-MPT: motion planning under constraints with learned sampling."""

from importlib import import_module
from typing import Any

_HOME = {
    "Articulation": "scene.scene",
    "Attachment": "scene.scene",
    "Box": "scene.shapes",
    "Budget": "search.result",
    "certify": "certificate.certificate",
    "ConvexMesh": "scene.shapes",
    "Cylinder": "scene.shapes",
    "draw": "show.picture",
    "film_solution": "show.picture",
    "GaussianMixture": "search.planner_interface",
    "JointPath": "search.result",
    "load_robot": "robot.load",
    "Margin": "planning.margins",
    "Method": "planning.planners",
    "OccupancyMap": "scene.shapes",
    "Placement": "base.poses",
    "planner_named": "planning.planners",
    "PLANNERS": "planning.planners",
    "PlanningProblem": "problem",
    "PointCloud": "scene.shapes",
    "pose": "base.poses",
    "read_cloud": "scene.cloud_files",
    "read_mesh": "scene.mesh_files",
    "read_scene": "scene.scene_files",
    "region": "constraints.named",
    "robot_from_source": "robot.load",
    "save_trajectory": "trajectory.trajectory",
    "Scene": "scene.scene",
    "SceneObject": "scene.scene",
    "solve": "planning.pipeline",
    "solve_many": "planning.pipeline",
    "solve_task": "tasks.solve",
    "solve_with_margin": "planning.margins",
    "Sphere": "scene.shapes",
    "Task": "tasks.task",
    "TaskSpaceRegion": "constraints.task_space_region",
    "TaskSpaceRegionChain": "constraints.task_space_region",
    "time_path": "trajectory.timing",
    "TimingSettings": "trajectory.timing",
    "upright": "constraints.task_space_region",
    "upright_box": "constraints.task_space_region",
}
"""Each public name and the module it lives in;
a module is imported when a name of it is first used.
"""

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    """Import a public name from where it lives."""
    if name not in _HOME:
        raise AttributeError(
            f"module {__name__!r} has no attribute {name!r}; public names: {', '.join(_HOME)}"
        )
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    """The public names, and nothing else."""
    return __all__
