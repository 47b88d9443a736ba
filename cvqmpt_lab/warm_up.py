"""What a process does once before any clock starts:
load weights, compile or load kernels, make the robot's arrays.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, upright
from cvqmpt_lab.jit import compile_all, compiled_before
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planners import Method, planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import panda
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.birrt import BiRRT, plant, remove_child_of_segment
from cvqmpt_lab.search.planner_interface import Observation, Proposal, Query, search
from cvqmpt_lab.search.result import Budget, JointPath
from cvqmpt_lab.search.shortcut import SimplifySettings, simplify
from cvqmpt_lab.search.space import ConstrainedSpace, direct_motion

ITERATIONS = 20
SHORTCUTS = 16
POINTS = 2048  # of the made-up cloud
START = (0.99468491, 0.49509914, -1.24378071, -2.26869377, 1.93524067, 1.26551103, -1.58268202)
"""An upright hand that touches nothing in the kitchen [rad]."""


def compile_kernels(announce: Callable[[str], None]) -> float:
    """Compile every kernel and call those that planners call; seconds it took.

    The first time two processes share the work.

    announce: called before anything is compiled, which takes about a minute.
    """
    began = time.perf_counter()
    if not compiled_before(everything=True):
        from concurrent.futures import ProcessPoolExecutor  # `plan` does without
        from multiprocessing import get_context

        announce("compiling kernels, about a minute, once per machine and version ...")
        with ProcessPoolExecutor(1, get_context("spawn")) as helper:
            others = helper.submit(compile_all, 1, 2)
            compile_all(0, 2)
            others.result()
        compile_all()
    start, robot = np.array(START), panda()
    pose = TaskSpaceRegion(robot.pose(start), np.eye(4), np.zeros((6, 2)))
    problem = PlanningProblem(
        "warm-up", robot, kitchen(), start, np.empty((0, robot.dof)), (upright(),), goal_region=pose
    )
    warm_up(problem, planner_named("birrt"), "compiled")  # goals, trees and shortcuts
    problem = problem.with_goals(start[None])
    for name in ("roadmap", "opt-cvq-mpt"):
        _propose(problem, planner_named(name), "compiled")
    space = ConstrainedSpace(problem)  # what planners in Python ask state by state
    space.project(start)
    space.valid(start)
    space.residual_and_jacobian(start)
    direct_motion(space, start, start)
    return time.perf_counter() - began


def warm_up(
    problem: PlanningProblem,
    method: Method,
    backend: str,
    announce: Callable[[str], None] | None = None,
) -> None:
    """Take a problem's robot through every stage of a method once, in an empty scene and with a
    made-up cloud.

    Nothing of the problem itself is computed or remembered, so that solving it afterwards takes,
    and reports, what it takes in a process that has planned before. The certificate is left out:
    nobody is charged for it.

    announce: called before anything is compiled, which takes a while.
    """
    if method.external:  # which may use ours; whatever else it prepares, it is charged for
        method = planner_named("birrt")
    if announce is not None and not compiled_before():
        announce("compiling kernels, once per machine and version ...")
    empty, _ = with_sampled_goals(replace(problem, scene=Scene("empty", ())))
    goals = empty.goals if len(empty.goals) else problem.start[None]
    _propose(empty.with_goals(goals), method, backend)
    _search(empty.with_goals(goals), method, backend)


def _propose(problem: PlanningProblem, method: Method, backend: str) -> None:
    """What a method does before it searches, with a made-up cloud, for a problem with goals."""
    rng = np.random.default_rng(0)
    stages = method.stages(problem)
    query = Query.of(ConstrainedSpace(problem, backend), Budget(iterations=ITERATIONS), rng)
    proposal = stages.predict(query, Observation(rng.uniform(-1.0, 1.0, (POINTS, 3)), 0.0))
    if stages.update is not None:
        stages.update(query, proposal)


def _search(problem: PlanningProblem, method: Method, backend: str) -> None:
    """What a method does once it searches, with uniform samples, for a problem with goals."""
    rng = np.random.default_rng(0)
    space = ConstrainedSpace(problem, backend)
    query = Query.of(space, Budget(iterations=ITERATIONS), rng)
    search(method.stages(problem).search or BiRRT(), query, Proposal(query.uniform))
    simplify(
        space, JointPath(np.array([problem.start, problem.start])), rng, SimplifySettings(SHORTCUTS)
    )
    trees = plant(problem.start, problem.goals, capacity=8)
    # else only after a failed fine check
    remove_child_of_segment(trees, np.zeros((2, 2), dtype=np.int64), 0)
