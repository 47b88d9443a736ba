"""Compiling or loading every kernel before anything is timed."""

import time
from collections.abc import Callable

import numpy as np

from cvqmpt_lab.kernels.compiling import compiled_before
from cvqmpt_lab.methods.method import Method
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.planning.direct_motion import direct_motion
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.roadmap import Roadmap
from cvqmpt_lab.planning.roadmap_proposals import RoadmapPath
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from experiments.suites.place_task import place_problem


def compile_kernels(announce: Callable[[str], None]) -> float:
    """Touch every kernel a planner may call, once; seconds it took.

    announce: told beforehand when nothing is compiled yet, because that takes about a minute.
    """
    began = time.perf_counter()
    if not compiled_before():
        announce("compiling kernels, about a minute, once per machine and version ...")
    problem = place_problem(0)
    assert isinstance(problem, PlanningProblem)
    solve(
        problem,
        "birrt",
        Budget(iterations=1000),
        seed=0,
        clearance=False,
    )
    nodes = problem.robot.random_configurations(np.random.default_rng(0), 64)
    roadmap = RoadmapPath(Roadmap.of(nodes, np.tile(np.eye(problem.robot.dof), (len(nodes), 1, 1))))
    through = Method.simple("roadmap", predict=roadmap)
    solve(problem, through, Budget(iterations=20), seed=0, clearance=False)
    space = ConstrainedSpace(problem)
    q = np.array(problem.start)
    space.project(q)
    space.valid(q)
    space.residual_and_jacobian(q)
    direct_motion(space, q, q)
    return time.perf_counter() - began
