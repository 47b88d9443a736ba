"""Work that a process does once, before times are measured: weights, kernels, robot arrays."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cvqmpt_lab.base.jit import compile_in_processes
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, upright_box
from cvqmpt_lab.planning.pipeline import with_drawn_goals
from cvqmpt_lab.planning.planners import planner_named, require_fit
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import panda
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.birrt import BiRRT, plant, remove_subtree
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import Observation, Proposal, Query, search
from cvqmpt_lab.search.result import Budget, JointPath
from cvqmpt_lab.search.shortcut import simplify
from cvqmpt_lab.search.space import ConstrainedSpace, direct_motion


def compile_kernels(progress: Callable[[int, int], object]) -> float:
    """Compile every kernel, on all cores, unless that was done before; call planners' kernels.

    Args:
        progress: called with the number of functions that are compiled, and that of all; not
            called where all are on disk.

    Returns:
        Wall time [s].
    """
    began = time.perf_counter()
    compile_in_processes(progress)
    robot = panda()
    # configuration with an upright hand [rad]
    start = np.array(
        [0.99468491, 0.49509914, -1.24378071, -2.26869377, 1.93524067, 1.26551103, -1.58268202]
    )
    pose = TaskSpaceRegion(robot.pose(start), np.eye(4), np.zeros((6, 2)))
    problem = PlanningProblem(
        "warm-up",
        robot,
        Scene("empty", ()),
        start,
        np.empty((0, robot.dof)),
        (upright_box(),),
        goal_region=pose,
    )
    warm_up(problem, planner_named("birrt"), "compiled")  # goals, trees and shortcuts
    problem = problem.changed(goals=start[None])
    for name in ("roadmap", "opt-cvq-mpt"):
        _through_stages(problem, planner_named(name), "compiled")
    space = ConstrainedSpace.of(problem)  # functions that planners in Python call for one state
    space.project(start)
    space.valid(start)
    space.residual_and_jacobian(start)
    direct_motion(space, start, start)
    return time.perf_counter() - began


def warm_up(problem: PlanningProblem, method: Method, backend: str) -> None:
    """Run every stage of a planner once, in an empty scene with a random cloud.

    Nothing of the problem itself is computed or cached: solving it afterwards takes as long as in a
    process that has planned before. The certificate, which is not timed, is left out.

    Args:
        problem: states the robot, its load and the constraint.
        method: the planner.
        backend: of state checks, "compiled" or "exact".

    Raises:
        InvalidInputError: the planner cannot serve the problem.
    """
    require_fit(method, problem)
    # an external planner may use `birrt`; the time of its other preparations is measured
    if method.external:
        method = planner_named("birrt")
    empty = with_drawn_goals(replace(problem, scene=Scene("empty", ())))
    goals = empty.goals if len(empty.goals) else problem.start[None]
    _through_stages(empty.changed(goals=goals), method, backend)


def _through_stages(problem: PlanningProblem, method: Method, backend: str) -> None:
    """Predict and update with a random cloud, search and shorten, for a problem with goals."""
    rng = np.random.default_rng(0)
    stages = method.stages(problem)
    space = ConstrainedSpace.of(problem, backend)
    few = Budget(iterations=20)
    query = Query.of(space, problem.start, problem.goals, few, rng)
    proposal = stages.predict(query, Observation(rng.uniform(-1.0, 1.0, (2048, 3))))
    if stages.update is not None:
        stages.update(query, proposal)
    # the prediction may have used up the budget
    query = Query.of(space, problem.start, problem.goals, few, rng)
    search(stages.search or BiRRT(), query, Proposal(query.uniform))
    still = JointPath(np.array([problem.start, problem.start]))
    simplify(space, still, rng, attempts=16)
    trees = plant(problem.start, problem.goals, capacity=8)
    # a search calls it only after a failed fine check
    remove_subtree(trees, 0, 0)
