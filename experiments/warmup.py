"""Compiling or loading every kernel before anything is timed."""

import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from cvqmpt_lab.kernels.objects import GROUPS, compiled_before, make_ready
from cvqmpt_lab.methods.table import planner_named
from cvqmpt_lab.planning.direct_motion import direct_motion
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.rehearsal import rehearse, rehearse_proposal
from experiments.suites.place_task import place_problem


def compile_kernels(announce: Callable[[str], None]) -> float:
    """Compile every kernel and touch those that planners call; seconds it took.

    The first time two processes share the work.

    announce: told beforehand when something is not compiled yet, because that takes about a minute.
    """
    began = time.perf_counter()
    if not compiled_before(tuple(GROUPS)):
        announce("compiling kernels, about a minute, once per machine and version ...")
        with ProcessPoolExecutor(1, get_context("spawn")) as helper:
            others = helper.submit(make_ready, [group for group in GROUPS if group != "plan"])
            make_ready(("plan",))
            others.result()
    _trees()
    _others()
    return time.perf_counter() - began


def _trees() -> None:
    """Goals, trees and shortcuts."""
    rehearse(_problem(), planner_named("birrt"), "compiled")


def _others() -> None:
    """Roadmaps, networks, and what planners in Python ask state by state."""
    problem = _problem()
    problem = problem.with_goals(problem.start[None])
    rehearse_proposal(problem, planner_named("roadmap-cvq"), "compiled")
    rehearse_proposal(problem, planner_named("opt-cvq-route"), "compiled")
    space, q = ConstrainedSpace(problem), np.array(problem.start)
    space.project(q)
    space.valid(q)
    space.residual_and_jacobian(q)
    direct_motion(space, q, q)


def _problem() -> PlanningProblem:
    problem = place_problem(0)
    assert isinstance(problem, PlanningProblem)
    return problem
