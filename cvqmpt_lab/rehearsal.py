"""What a process pays once, paid before any clock starts: weights, machine code, the robot's arrays."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cvqmpt_lab.kernels.compiling import compiled_before
from cvqmpt_lab.methods.method import Method
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planning.proposal import Observation
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
    rng = np.random.default_rng(0)
    empty, _ = with_sampled_goals(replace(problem, scene=Scene("empty", ())))
    goals = empty.goals if len(empty.goals) else problem.start[None]
    stages = method.stages(empty)
    space = ConstrainedSpace(empty.with_goals(goals), backend)
    query = Query.of(space, Budget(iterations=ITERATIONS), rng)
    proposal = stages.predict(query, Observation(rng.uniform(-1.0, 1.0, (POINTS, 3)), 0.0))
    if stages.update is not None:
        proposal = stages.update(query, proposal)
    search(stages.search, query, proposal)
    simplify(space, JointPath(np.array([problem.start, problem.start])), rng, SimplifySettings(SHORTCUTS))
