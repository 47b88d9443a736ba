"""What a process pays once, paid before any clock starts: weights, machine code, the robot's arrays."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cvqmpt_lab.kernels.objects import compiled_before
from cvqmpt_lab.kernels.search.tree_growth import plant, remove_child_of_segment
from cvqmpt_lab.methods.method import Method
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planning.proposal import Observation, Proposal
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import Budget, JointPath
from cvqmpt_lab.planning.search import search
from cvqmpt_lab.planning.simplify import SimplifySettings, simplify
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Scene

ITERATIONS = 20
SHORTCUTS = 16
POINTS = 2048


def rehearse(
    problem: PlanningProblem, method: Method, backend: str, announce: Callable[[str], None] | None = None
) -> None:
    """Take a problem's robot through every stage of a method once, in an empty scene and with a made-up cloud.

    Nothing of the problem itself is computed or remembered, so that solving it afterwards takes, and reports, what
    it takes in a process that has planned before. The certificate is left out: nobody is charged for it.

    announce: told beforehand when nothing is compiled yet, because that takes a while.
    """
    if announce is not None and not compiled_before():
        announce("compiling kernels, once per machine and version ...")
    empty, _ = with_sampled_goals(replace(problem, scene=Scene("empty", ())))
    goals = empty.goals if len(empty.goals) else problem.start[None]
    rehearse_proposal(empty.with_goals(goals), method, backend)
    rehearse_search(empty.with_goals(goals), method, backend)


def rehearse_proposal(problem: PlanningProblem, method: Method, backend: str) -> None:
    """What a method does before it searches, with a made-up cloud, for a problem with goals."""
    rng = np.random.default_rng(0)
    stages = method.stages(problem)
    query = Query.of(ConstrainedSpace(problem, backend), Budget(iterations=ITERATIONS), rng)
    proposal = stages.predict(query, Observation(rng.uniform(-1.0, 1.0, (POINTS, 3)), 0.0))
    if stages.update is not None:
        stages.update(query, proposal)


def rehearse_search(problem: PlanningProblem, method: Method, backend: str) -> None:
    """What a method does once it searches, with uniform samples, for a problem with goals."""
    rng = np.random.default_rng(0)
    space = ConstrainedSpace(problem, backend)
    query = Query.of(space, Budget(iterations=ITERATIONS), rng)
    search(method.stages(problem).search, query, Proposal(query.uniform))
    simplify(space, JointPath(np.array([problem.start, problem.start])), rng, SimplifySettings(SHORTCUTS))
    trees = plant(problem.start, problem.goals, capacity=8)
    remove_child_of_segment(trees, np.zeros((2, 2), dtype=np.int64), 0)  # else only after a failed fine check
