"""Toolkit to reproduce CVQ-MPT: motion planning under constraints with learned sampling."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cvqmpt_lab.base.arithmetic import pin
from cvqmpt_lab.base.modules import provide

pin()  # before numpy or numba is imported
# parts that files of lower layers use, by who provides them, see `base.modules`
provide(
    {
        "checks of functions": ("cvqmpt_lab.planning.usable:checked_functions",),
        "checks of lengths": ("cvqmpt_lab.planning.usable:check_lengths",),
        "drawn start": ("cvqmpt_lab.planning.usable:drawn_start",),
        "function of an address": ("cvqmpt_lab.constraints.function_files:function_of",),
        "world": ("cvqmpt_lab.collision.world:World",),
    }
)

# Editors and type checkers read these imports; at run time `__getattr__` does them when needed.
if TYPE_CHECKING:
    from cvqmpt_lab.base.modules import allow_code
    from cvqmpt_lab.base.poses import Placement, pose
    from cvqmpt_lab.benchmarks.suite import suite_named
    from cvqmpt_lab.certificate.certificate import certify
    from cvqmpt_lab.constraints.function import FunctionConstraint, torch_constraint
    from cvqmpt_lab.constraints.function_files import load_function
    from cvqmpt_lab.constraints.named import region
    from cvqmpt_lab.constraints.task_space_region import (
        TaskSpaceRegion,
        TaskSpaceRegionChain,
        upright,
        upright_box,
    )
    from cvqmpt_lab.features.motion.judge import judge
    from cvqmpt_lab.features.motion.motion_check import certified_motion
    from cvqmpt_lab.features.motion.timing import TimingSettings, time_path
    from cvqmpt_lab.features.motion.trajectory import (
        JointState,
        Motion,
        read_motion,
        save_trajectory,
    )
    from cvqmpt_lab.features.physics.execute import execute_motion
    from cvqmpt_lab.features.pictures.picture import draw, film_solution
    from cvqmpt_lab.features.pictures.web_page import save_page
    from cvqmpt_lab.features.plan import Plan, Request, plan
    from cvqmpt_lab.features.tasks.solve import solve_task
    from cvqmpt_lab.features.tasks.task import Task
    from cvqmpt_lab.planning.margins import Margin
    from cvqmpt_lab.planning.pipeline import solve, solve_many
    from cvqmpt_lab.planning.planners import PLANNERS, planner_named
    from cvqmpt_lab.problem import PlanningProblem
    from cvqmpt_lab.robot.load import load_robot, robot_from_source
    from cvqmpt_lab.scene.cloud_files import read_cloud
    from cvqmpt_lab.scene.mesh_files import read_mesh
    from cvqmpt_lab.scene.scene import Articulation, Attachment, Scene, SceneObject
    from cvqmpt_lab.scene.scene_files import read_scene
    from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, OccupancyMap, PointCloud, Sphere
    from cvqmpt_lab.search.method import Method
    from cvqmpt_lab.search.planner_interface import GaussianMixture, Proposal
    from cvqmpt_lab.search.result import Budget, JointPath
    from cvqmpt_lab.vqmpt.codebook import dictionary_gaussians
    from cvqmpt_lab.vqmpt.weights import load_vq_mpt

__all__ = [
    "PLANNERS",
    "Articulation",
    "Attachment",
    "Box",
    "Budget",
    "ConvexMesh",
    "Cylinder",
    "FunctionConstraint",
    "GaussianMixture",
    "JointPath",
    "JointState",
    "Margin",
    "Method",
    "Motion",
    "OccupancyMap",
    "Placement",
    "Plan",
    "PlanningProblem",
    "PointCloud",
    "Proposal",
    "Request",
    "Scene",
    "SceneObject",
    "Sphere",
    "Task",
    "TaskSpaceRegion",
    "TaskSpaceRegionChain",
    "TimingSettings",
    "allow_code",
    "certified_motion",
    "certify",
    "dictionary_gaussians",
    "draw",
    "execute_motion",
    "film_solution",
    "judge",
    "load_function",
    "load_robot",
    "load_vq_mpt",
    "plan",
    "planner_named",
    "pose",
    "read_cloud",
    "read_mesh",
    "read_motion",
    "read_scene",
    "region",
    "robot_from_source",
    "save_page",
    "save_trajectory",
    "solve",
    "solve_many",
    "solve_task",
    "suite_named",
    "time_path",
    "torch_constraint",
    "upright",
    "upright_box",
]

__version__: str  # looked up when it is first used
_NAMES: dict[str, tuple[str, ...]] = {
    "base.modules": ("allow_code",),
    "base.poses": ("Placement", "pose"),
    "benchmarks.suite": ("suite_named",),
    "certificate.certificate": ("certify",),
    "features.motion.judge": ("judge",),
    "features.motion.motion_check": ("certified_motion",),
    "features.plan": ("Plan", "Request", "plan"),
    "constraints.function": ("FunctionConstraint", "torch_constraint"),
    "constraints.function_files": ("load_function",),
    "constraints.named": ("region",),
    "constraints.task_space_region": (
        "TaskSpaceRegion",
        "TaskSpaceRegionChain",
        "upright",
        "upright_box",
    ),
    "features.physics.execute": ("execute_motion",),
    "planning.margins": ("Margin",),
    "planning.pipeline": ("solve", "solve_many"),
    "planning.planners": ("PLANNERS", "planner_named"),
    "problem": ("PlanningProblem",),
    "robot.load": ("load_robot", "robot_from_source"),
    "scene.cloud_files": ("read_cloud",),
    "scene.mesh_files": ("read_mesh",),
    "scene.scene": ("Articulation", "Attachment", "Scene", "SceneObject"),
    "scene.scene_files": ("read_scene",),
    "scene.shapes": ("Box", "ConvexMesh", "Cylinder", "OccupancyMap", "PointCloud", "Sphere"),
    "search.method": ("Method",),
    "search.planner_interface": ("GaussianMixture", "Proposal"),
    "search.result": ("Budget", "JointPath"),
    "features.pictures.picture": ("draw", "film_solution"),
    "features.pictures.web_page": ("save_page",),
    "features.tasks.solve": ("solve_task",),
    "features.tasks.task": ("Task",),
    "features.motion.timing": ("TimingSettings", "time_path"),
    "features.motion.trajectory": ("JointState", "Motion", "read_motion", "save_trajectory"),
    "vqmpt.codebook": ("dictionary_gaussians",),
    "vqmpt.weights": ("load_vq_mpt",),
}
"""Public names by the module that defines them; it is imported when one of them is first used."""

_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}


_REMOVED = {"solve_with_margin": "call plan(problem, Request(planner, budget, seed, margin))"}
"""Names of earlier versions, and what to do instead."""


if not TYPE_CHECKING:  # with it, type checkers would accept any name

    def __getattr__(name: str) -> Any:
        """Import a public name from the module that defines it; look up the version."""
        if name == "__version__":
            from importlib.metadata import version

            return version("cvqmpt-lab")
        if name in _REMOVED:
            raise AttributeError(f"{__name__}.{name} was removed: {_REMOVED[name]}")
        if name not in _MODULE_OF:
            known = ", ".join(sorted(__all__, key=str.lower))
            raise AttributeError(
                f"module {__name__!r} has no attribute {name!r}; public names: {known}"
            )
        return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names, and nothing else."""
    return __all__
