"""The paper's baselines from OMPL: RRTConnect on projected, atlas and tangent-bundle spaces.

There is also BKPIECE1 on the projected space, with cells over the free rows of the constraint.

Only this file imports ompl. Projection, residual, Jacobian and state checks are the kernels that
`birrt` uses; parameters are those of the published experiment code. Without a constraint, as in
some phases of tasks, all three baselines are RRTConnect in the joint space.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from cvqmpt_lab.search.cell_grids import free_rows
from cvqmpt_lab.search.motion import EXTENSIONS, ITERATIONS, NEWTON_ITERATIONS
from cvqmpt_lab.search.planner_interface import Query, SamplingDistribution
from cvqmpt_lab.search.result import JointPath, PlanResult, PlanStatus
from cvqmpt_lab.search.space import ConstrainedSpace

ou.setLogLevel(ou.LogLevel.LOG_NONE)

OMPL_STEP_RAD = 0.05  # step along the manifold, delta in OMPL


class _Manifold(ob.Constraint):
    """The space's constraint for OMPL; projection is the Newton loop of Algorithm 1."""

    def __init__(self, space: ConstrainedSpace) -> None:
        super().__init__(space.robot.dof, space.dim, space.arrays.tolerance)
        self._space = space

    def function(self, x: np.ndarray, out: np.ndarray) -> None:
        """Write F(x) at a configuration x (n,)."""
        out[:] = self._space.residual_and_jacobian(np.array(x))[0]

    def jacobian(self, x: np.ndarray, out: np.ndarray) -> None:
        """Write dF/dx with all rows (tangent spaces need full rank); counts as a Newton step."""
        self._space.arrays.counters[NEWTON_ITERATIONS] += 1
        out[:, :] = self._space.residual_and_jacobian(np.array(x), full=True)[1]

    def project(self, x: np.ndarray) -> bool:
        """Project x (n,) in place; True on success."""
        q = np.array(x)
        if not self._space.project(q):
            return False
        x[:] = q
        return True


class _FreeRows(ob.ProjectionEvaluator):
    """Coordinates of BKPIECE1's cells: up to three free rows of the constraint, else three joints.

    OMPL allows one size of cells: the middle one of `cell_grids`.
    """

    def __init__(self, states: ob.StateSpace, space: ConstrainedSpace) -> None:
        super().__init__(states)
        self._space, self._rows = space, free_rows(space)[:3]
        self._q = np.empty(space.robot.dof)
        spans = np.where(self._rows[:, 1] < 3, space.robot.reach, np.pi)
        if not len(spans):
            spans = (space.robot.upper - space.robot.lower)[:3]
        for i, span in enumerate(spans):
            self.setCellSizes(i, float(span) / 16.0)

    def getDimension(self) -> int:
        """Return the number of coordinates."""
        return len(self._rows) or min(3, len(self._q))

    def project(self, state, projection) -> None:
        """Write a state's coordinates."""
        for j in range(len(self._q)):
            self._q[j] = state[j]
        self._space.residual_and_jacobian(self._q)
        displacement = self._space.arrays.scratch.displacement
        for i in range(self.getDimension()):
            if len(self._rows):
                region, axis = self._rows[i]
                projection[i] = displacement[region, 3 + axis]
            else:
                projection[i] = self._q[i]


@dataclass(frozen=True)
class OmplSearch:
    """RRTConnect, or BKPIECE1, on one of OMPL's constrained state spaces.

    OMPL 2.0.1 accepts no sampler: the distribution given to `search` is not used, and the result
    states the one that was.
    """

    manifold: str  # "projected", "atlas" or "tangent-bundle"
    kpiece: bool = False  # BKPIECE1 with cells over the free rows, in place of RRTConnect

    def search(self, query: Query, distribution: SamplingDistribution) -> PlanResult:
        """Search a path from the query's start to any of its goals, see `Search`."""
        ou.RNG.setSeed(int(query.rng.integers(1, 2**31)))
        run = _Run(self.manifold, query, self.kpiece)
        status, path = run.run()
        return PlanResult(
            status=status,
            path=path,
            seconds=query.deadline.seconds,
            counters=query.deadline.counters,
            vertices=run.vertices,
            sampler="atlas-charts" if run.charts else "uniform",
        )


class _Run:
    """The OMPL objects of one planning run."""

    def __init__(self, manifold: str, query: Query, kpiece: bool = False) -> None:
        space = self._space = query.space
        self._deadline = query.deadline
        if space.dim:
            self._states = _state_space(manifold, _joint_space(space), _Manifold(space))
            information = (
                ob.TangentBundleSpaceInformation
                if manifold == "tangent-bundle"
                else ob.ConstrainedSpaceInformation
            )
        else:
            self._states, information = _joint_space(space), ob.SpaceInformation
            fraction = OMPL_STEP_RAD / self._states.getMaximumExtent()
            self._states.setLongestValidSegmentFraction(fraction)
        self.charts = space.dim > 0 and manifold != "projected"
        self._information = information(self._states)
        self._information.setStateValidityChecker(_validity(space))
        self._information.setup()
        self._problem = ob.ProblemDefinition(self._information)
        self._moved: dict[bytes, np.ndarray] = {}  # projected start or goal -> the given one
        # a single state, because the binding never frees the memory of one
        self._given = self._states.allocState()
        self._problem.addStartState(self._state(self._inside(query.start)))
        goal = ob.GoalStates(self._information)
        for q in query.goals:
            goal.addState(self._state(self._inside(q)))
        self._problem.setGoal(goal)
        self._planner = (og.BKPIECE1 if kpiece else og.RRTConnect)(self._information)
        if kpiece:
            self._projection = _FreeRows(self._states, space)  # OMPL does not keep it alive
            self._planner.setProjectionEvaluator(self._projection)
        self._planner.setProblemDefinition(self._problem)
        self._planner.setup()
        self.vertices = 0

    def _inside(self, q: np.ndarray) -> np.ndarray:
        """Return a configuration, or its projection if it is outside the tightened bounds.

        OMPL refuses a start or goal off its manifold. The motion between the configuration and its
        projection becomes part of the path.
        """
        moved = np.array(q)
        residual, _ = self._space.residual_and_jacobian(moved)
        if np.linalg.norm(residual) <= self._space.arrays.tolerance or not self._space.project(
            moved
        ):
            return q
        self._moved[moved.tobytes()] = q
        return moved

    def _state(self, q: np.ndarray):
        """Return an OMPL state at q with its chart; copy it before the next call."""
        if self._space.dim:
            self._given.copy([float(x) for x in q])
        else:
            for i, x in enumerate(q):
                self._given[i] = float(x)
        if self.charts:
            self._states.anchorChart(self._given)
        return self._given

    def run(self) -> tuple[PlanStatus, JointPath | None]:
        """Search until a path passes the fine check or the budget is spent."""
        deadline, budget = self._deadline, self._deadline.budget
        steps = 0

        def spent() -> bool:
            nonlocal steps
            steps += 1
            late = time.perf_counter() >= deadline.clock
            late = late or (budget.iterations is not None and steps > budget.iterations)
            self._space.arrays.counters[ITERATIONS] += not late
            return late

        while True:
            self._planner.solve(ob.PlannerTerminationCondition(spent))
            data = ob.PlannerData(self._information)
            self._planner.getPlannerData(data)
            self.vertices += data.numVertices()
            roots = data.numStartVertices() + data.numGoalVertices()
            self._space.arrays.counters[EXTENSIONS] += data.numVertices() - roots
            if not self._problem.hasExactSolution():
                break
            path = self._dense_path()
            if path is not None:
                return PlanStatus.SOLVED, path
            self._problem.clearSolutionPaths()
            self._planner.clear()
        late = budget.iterations is None or steps <= budget.iterations
        return PlanStatus.TIMEOUT if late else PlanStatus.ITERATION_LIMIT, None

    def _dense_path(self) -> JointPath | None:
        """Return the solution with projected states every OMPL_STEP_RAD, or None if it fails.

        The path must pass the fine check.
        """
        solution = self._problem.getSolutionPath()
        solution.interpolate()
        joints = range(self._space.robot.dof)
        given = [solution.getState(i) for i in range(solution.getStateCount())]
        states = [np.array([state[j] for j in joints]) for state in given]
        if not all(self._space.project(q) for q in states[1:-1]):
            return None
        first, last = (self._moved.get(q.tobytes()) for q in (states[0], states[-1]))
        whole = [q for q in (first, *states, last) if q is not None]
        return self._space.checked_path(np.array(whole))[0]


def _validity(space: ConstrainedSpace) -> Callable[..., bool]:
    """Return a function: whether a state is free and inside the limits, which OMPL may leave.

    OMPL keeps a reference that Python's garbage collector does not know: the function must not
    refer to objects of OMPL.
    """
    lower, upper = space.robot.lower - 1e-9, space.robot.upper + 1e-9
    q = np.empty(space.robot.dof)

    def valid(state) -> bool:
        for i in range(len(q)):
            q[i] = state[i]
        return bool((q >= lower).all() and (q <= upper).all() and space.valid(q))

    return valid


def _joint_space(space: ConstrainedSpace) -> ob.RealVectorStateSpace:
    joints = ob.RealVectorStateSpace(space.robot.dof)
    bounds = ob.RealVectorBounds(space.robot.dof)
    for i, (low, high) in enumerate(zip(space.robot.lower, space.robot.upper, strict=True)):
        bounds.setLow(i, float(low))
        bounds.setHigh(i, float(high))
    joints.setBounds(bounds)
    return joints


def _state_space(manifold: str, joints: ob.RealVectorStateSpace, constraint: _Manifold):
    """Return OMPL's constrained state space with the parameters of the published experiments."""
    states = OMPL_STATE_SPACES[manifold](joints, constraint)
    if manifold != "projected":
        states.setExploration(0.8)
        states.setEpsilon(0.1)
        states.setRho(0.25)
        states.setAlpha(math.pi / 8)
        states.setMaxChartsPerExtension(200)
        states.setBackoff(0.75)
    if manifold == "atlas":
        states.setSeparated(True)
    states.setDelta(OMPL_STEP_RAD)
    return states


OMPL_STATE_SPACES = {
    "projected": ob.ProjectedStateSpace,
    "atlas": ob.AtlasStateSpace,
    "tangent-bundle": ob.TangentBundleStateSpace,
}
