"""OMPL's planners: RRTConnect on projected, atlas and tangent-bundle spaces, and BKPIECE1.

The paper ran all of its planners in OMPL's RRTConnect: its baselines with OMPL's samples, CVQ-MPT
with samples of the network. OMPL's Python binding takes no sampler, but RRTConnect calls the
termination condition once in each iteration, then draws a sample, which the projected space
projects: so the first projection after a termination condition projects the sample. There, a
sample of any distribution replaces it (`_Draws`).

BKPIECE1 has cells over the free rows of the constraint.

Only this file imports ompl. Projection, residual, Jacobian and state checks are the kernels that
`birrt` uses; parameters are from the published experiment code. Without a constraint, as in
some phases of tasks, all three baselines are RRTConnect in the joint space.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError

try:
    from ompl import base as ob
    from ompl import geometric as og
    from ompl import util as ou
except ModuleNotFoundError as error:
    raise InvalidInputError(
        "planners of OMPL need ompl, which is not installed: it is not available for Python 3.14; "
        "use Python 3.11 to 3.13, or another planner: birrt, cells, roadmap"
    ) from error

from cvqmpt_lab.constraints.region_constraint import JumpingConstraint
from cvqmpt_lab.search.cell_grids import free_rows
from cvqmpt_lab.search.motion import (
    DRAW_NEWTON_ITERATIONS,
    DRAW_PROJECTIONS,
    EXTENSIONS,
    ITERATIONS,
    NEWTON_ITERATIONS,
    PROJECTIONS,
)
from cvqmpt_lab.search.planner_interface import DrawsOfTrees, Query, SamplingDistribution
from cvqmpt_lab.search.result import Budget, JointPath, PlanResult, PlanStatus
from cvqmpt_lab.search.space import ConstrainedSpace

ou.setLogLevel(ou.LogLevel.LOG_NONE)

OMPL_STEP_RAD = 0.05  # step along the manifold, delta in OMPL
DRAWS_AT_ONCE = 16  # of a sampling distribution


class _Manifold(ob.Constraint):
    """The space's constraint for OMPL; projection is the Newton loop of Algorithm 1.

    Args:
        space: the planning space.
        draws: samples that replace OMPL's; None: OMPL draws.
    """

    def __init__(self, space: ConstrainedSpace, draws: "_Draws | None" = None) -> None:
        super().__init__(space.robot.dof, space.dim, space.arrays.tolerance)
        self._space, self._draws = space, draws
        self._jumps = _as_published(space)

    def function(self, x: np.ndarray, out: np.ndarray) -> None:
        """Write F(x) at a configuration x (n,)."""
        residual = self._space.residual_and_jacobian(np.array(x))[0]
        out[:] = self._jumped(residual) if self._jumps else residual

    def jacobian(self, x: np.ndarray, out: np.ndarray) -> None:
        """Write dF/dx with all rows (tangent spaces need full rank); counts as a Newton step."""
        self._space.arrays.counters[NEWTON_ITERATIONS] += 1
        out[:, :] = self._space.residual_and_jacobian(np.array(x), full=True)[1]

    def project(self, x: np.ndarray) -> bool:
        """Project x (n,) in place, or a sample in its place; True on success."""
        draws, counters = self._draws, self._space.arrays.counters
        if draws is None or not draws.due:
            return self._project(x)
        projections, steps = counters[PROJECTIONS], counters[NEWTON_ITERATIONS]
        for _ in range(100 if draws.free else 1):
            x[:] = draws.next()
            projected = self._project(x)
            if projected and (not draws.free or self._space.valid(np.array(x))):
                break
        counters[DRAW_PROJECTIONS] += counters[PROJECTIONS] - projections
        counters[DRAW_NEWTON_ITERATIONS] += counters[NEWTON_ITERATIONS] - steps
        return projected

    def _project(self, x: np.ndarray) -> bool:
        if not self._space.dim:
            return True
        if self._jumps:
            return self._project_to_centre(x)
        q = np.array(x)
        if not self._space.project(q):
            return False
        x[:] = q
        return True

    def _jumped(self, residual: np.ndarray) -> np.ndarray:
        return JumpingConstraint.jumped(residual, self._space.arrays.regions)

    def _project_to_centre(self, x: np.ndarray) -> bool:
        """Project x (n,) in place by Newton's method with the jumping F, as published."""
        arrays = self._space.arrays
        arrays.counters[PROJECTIONS] += 1
        q = np.array(x)
        for _ in range(arrays.max_iterations):
            residual, jacobian = self._space.residual_and_jacobian(q, full=True)
            value = self._jumped(residual)
            if np.linalg.norm(value) <= arrays.tolerance:
                x[:] = q
                return True
            arrays.counters[NEWTON_ITERATIONS] += 1
            q -= np.linalg.lstsq(jacobian, value, rcond=None)[0]
        return False


class _Draws:
    """Samples of a distribution for a search of OMPL.

    Samples outside the limits are moved to the limits, as OMPL does with its projected ones. A
    sample that is not finite, or farther outside than a joint's whole range, is replaced by a
    uniform one.
    """

    def __init__(self, distribution: SamplingDistribution, query: Query, free: bool) -> None:
        self.due = False  # whether the next projection projects a sample
        self.free = free  # whether samples in collision are drawn again
        self.count = self.replaced = 0  # number of samples, and of replaced ones
        self._query = query
        # of the trees from the start and from the goal
        self._distributions = [distribution]
        if isinstance(distribution, DrawsOfTrees):
            self._distributions = [distribution.of_tree(tree) for tree in (0, 1)]
        self._drawn: list[list[np.ndarray]] = [[] for _ in self._distributions]
        self._tree = -1

    def begin(self) -> None:
        """Note that a search begins: its first draw is for the tree from the start."""
        self._tree = -1

    def iterate(self) -> None:
        """Note that an iteration begins: RRTConnect extends its two trees in turn."""
        self.due = True
        self._tree += 1

    def next(self) -> np.ndarray:
        """Return the next sample (n,) [rad or m]."""
        self.due = False
        self.count += 1
        uniform, rng = self._query.uniform, self._query.rng
        tree = self._tree % len(self._distributions)
        drawn = self._drawn[tree]
        if not drawn:
            drawn.extend(self._distributions[tree].sample(rng, DRAWS_AT_ONCE)[::-1])
        q = drawn.pop()
        inside = np.clip(q, uniform.lower, uniform.upper)
        # false for a sample that is not a number
        near = np.abs(q - inside) <= uniform.upper - uniform.lower
        if not near.all():
            self.replaced += 1
            return uniform.sample(rng, 1)[0]
        return inside

    @property
    def fallback(self) -> str:
        """Return the number of samples that uniform ones replaced, in words, or ""."""
        if not self.replaced:
            return ""
        return f"uniform in place of {self.replaced} of {self.count} draws, which cannot be used"


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
    """RRTConnect, or BKPIECE1, on one of OMPL's constrained state spaces."""

    manifold: str  # "projected", "atlas" or "tangent-bundle"
    kpiece: bool = False  # BKPIECE1 with cells over the free rows, in place of RRTConnect
    # whether the distribution given to `search` is used, on the projected space; False: OMPL draws
    sampled: bool = False
    # whether samples that cannot be projected or are in collision are drawn again
    free_draws: bool = False
    # [rad] longest motion towards a sample: a longer one ends there. inf: a motion adds a node at
    # its sample or none, as published (13.07, more than the Panda's joint space). None: OMPL's
    # default, a fifth of the extent of the joint space
    reach: float | None = None

    def __post_init__(self) -> None:
        if self.sampled and (self.manifold != "projected" or self.kpiece):
            raise InvalidInputError(
                "samples of a distribution: only RRTConnect on the projected space takes them"
            )

    def search(self, query: Query, distribution: SamplingDistribution) -> PlanResult:
        """Search a path from the query's start to any of its goals, see `Search`."""
        ou.RNG.setSeed(int(query.rng.integers(1, 2**31)))
        draws = _Draws(distribution, query, self.free_draws) if self.sampled else None
        run = _Run(self, query, draws)
        status, path = run.run()
        sampler = "atlas-charts" if run.charts else "uniform"
        return PlanResult(
            status=status,
            path=path,
            seconds=query.deadline.seconds,
            counters=query.deadline.counters,
            vertices=run.vertices,
            sampler=sampler if draws is None else distribution.name,
            fallback="" if draws is None else draws.fallback,
            waypoints=run.waypoints,
            roots=run.roots,
        )


def published_search(reach: float = math.inf, free_draws: bool = False) -> OmplSearch:
    """Return the search of the paper's experiments with a learned sampler, see `OmplSearch`."""
    return OmplSearch("projected", sampled=True, reach=reach, free_draws=free_draws)


GOAL_LIMIT = Budget(cost=2.5)  # of the search for one goal in the published code


class _Run:
    """The OMPL objects of one planning run."""

    def __init__(self, method: OmplSearch, query: Query, draws: _Draws | None) -> None:
        space = self._space = query.space
        self._deadline, self._draws = query.deadline, draws
        self._states, self._information = _state_spaces(space, method.manifold, draws)
        self.charts = space.dim > 0 and method.manifold != "projected"
        self._problem = ob.ProblemDefinition(self._information)
        self._moved: dict[bytes, np.ndarray] = {}  # projected start or goal -> the given one
        # a single state, because the binding never frees the memory of one
        self._given = self._states.allocState()
        self._problem.addStartState(self._state(self._inside(query.start)))
        goal = ob.GoalStates(self._information)
        for q in query.goals:
            goal.addState(self._state(self._inside(q)))
        self._problem.setGoal(goal)
        self._planner = (og.BKPIECE1 if method.kpiece else og.RRTConnect)(self._information)
        reach = method.reach
        if space.dim == 0 and _as_published(space):
            reach = math.inf
        if reach is not None:
            self._planner.setRange(min(reach, 2.0 * self._states.getMaximumExtent()))
        if method.kpiece:
            self._projection = _FreeRows(self._states, space)  # OMPL does not keep it alive
            self._planner.setProjectionEvaluator(self._projection)
        self._planner.setProblemDefinition(self._problem)
        self._planner.setup()
        self.vertices = self.roots = 0
        self.waypoints: np.ndarray | None = None  # states of the solution that OMPL stored

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
        _write(q, self._given)
        if self.charts:
            self._states.anchorChart(self._given)
        return self._given

    def run(self) -> tuple[PlanStatus, JointPath | None]:
        """Search until a path passes the fine check or the budget is spent."""
        deadline, draws, counters = self._deadline, self._draws, self._space.arrays.counters

        def spent() -> bool:
            if draws is not None:
                draws.iterate()
            late = deadline.spent() is not None
            counters[ITERATIONS] += not late
            return late

        while True:
            if draws is not None:
                draws.begin()
            self._planner.solve(ob.PlannerTerminationCondition(spent))
            data = ob.PlannerData(self._information)
            self._planner.getPlannerData(data)
            self.vertices += data.numVertices()
            roots = data.numStartVertices() + data.numGoalVertices()
            self.roots += roots
            self._space.arrays.counters[EXTENSIONS] += data.numVertices() - roots
            if not self._problem.hasExactSolution():
                break
            path = self._dense_path()
            if path is not None:
                return PlanStatus.SOLVED, path
            self._problem.clearSolutionPaths()
            self._planner.clear()
        return deadline.spent() or PlanStatus.NO_PATH, None

    def _dense_path(self) -> JointPath | None:
        """Return the solution with projected states every OMPL_STEP_RAD, or None if it fails.

        The path must pass the fine check.
        """
        solution = self._problem.getSolutionPath()
        self.waypoints = np.array(_states_of(solution, self._space.robot.dof))
        solution.interpolate()
        states = _states_of(solution, self._space.robot.dof)
        if not all(self._space.project(q) for q in states[1:-1]):
            return None
        first, last = (self._moved.get(q.tobytes()) for q in (states[0], states[-1]))
        whole = [q for q in (first, *states, last) if q is not None]
        return self._space.checked_path(np.array(whole))[0]


def simplified_by_ompl(space: ConstrainedSpace, waypoints: np.ndarray) -> JointPath:
    """Return a path after OMPL's own simplification and interpolation, as the published code does.

    On a manifold it removes states and joins near ones; it makes no shortcuts between states.

    Args:
        space: checks and projects; its counts include this work.
        waypoints: states that a search of OMPL stored (m, n) [rad or m].
    """
    states, information = _state_spaces(space, "projected")
    path, state = og.PathGeometric(information), states.allocState()
    for q in waypoints:
        _write(q, state)
        path.append(state)
    og.PathSimplifier(information).simplifyMax(path)
    path.interpolate()
    return JointPath(np.array(_states_of(path, space.robot.dof)))


def _states_of(path: og.PathGeometric, n: int) -> list[np.ndarray]:
    """Return the states of a path of OMPL, each (n,) [rad or m]."""
    given = [path.getState(i) for i in range(path.getStateCount())]
    return [np.array([state[j] for j in range(n)]) for state in given]


def _write(q: np.ndarray, state) -> None:
    """Write a configuration q (n,) [rad or m] into a state of OMPL."""
    if hasattr(state, "copy"):
        state.copy([float(x) for x in q])
    else:
        for i, x in enumerate(q):
            state[i] = float(x)


def _state_spaces(space: ConstrainedSpace, manifold: str, draws: _Draws | None = None):
    """Return OMPL's state space with a step of OMPL_STEP_RAD, and its space information.

    Args:
        space: the planning space. Without a constraint it is the joint space, except for draws,
            which need a projection.
        manifold: a key of OMPL_STATE_SPACES.
        draws: samples that replace OMPL's.
    """
    if space.dim or draws is not None:
        constraint = _Manifold(space, draws)
        states = _state_space(manifold, _joint_space(space), constraint)
        states.setDelta(_step(space))
        kind = (
            ob.TangentBundleSpaceInformation
            if manifold == "tangent-bundle"
            else ob.ConstrainedSpaceInformation
        )
    else:
        states, kind = _joint_space(space), ob.SpaceInformation
        states.setLongestValidSegmentFraction(_step(space) / states.getMaximumExtent())
    information = kind(states)
    information.setStateValidityChecker(_validity(space))
    if draws is not None and not space.dim:
        information.setMotionValidator(_StraightMotions(information, space))
    information.setup()
    return states, information


class _StraightMotions(ob.MotionValidator):
    """Checks the states of a straight motion in the order of OMPL's joint space.

    A constrained space checks them from the start on, because each is the projection of the one
    before. Without a constraint that takes more checks to refuse a motion.
    """

    def __init__(self, information: ob.SpaceInformation, space: ConstrainedSpace) -> None:
        super().__init__(information)
        # see `_validity` about references
        self._valid, self._step, self._n = _validity(space), _step(space), space.robot.dof

    def checkMotion(self, first, last, *_) -> bool:
        """Return whether a motion is valid whose first state is: last state, then bisection."""
        begin, end = (np.array([state[i] for i in range(self._n)]) for state in (first, last))
        count = math.ceil(np.linalg.norm(end - begin) / self._step)
        if not self._valid(end):
            return False
        parts = deque([(1, count - 1)])
        while parts:
            low, high = parts.popleft()
            if low > high:
                continue
            middle = (low + high) // 2
            if not self._valid(begin + middle / count * (end - begin)):
                return False
            parts += (low, middle - 1), (middle + 1, high)
        return True


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
    return states


def _as_published(space: ConstrainedSpace) -> bool:
    """Return whether the problem is one of the published code, not of the paper's text."""
    return isinstance(space.constraint, JumpingConstraint)


def _step(space: ConstrainedSpace) -> float:
    """Return the distance of the states of a motion that OMPL checks [rad].

    The published code leaves OMPL's default, 1 % of the extent, where there is no constraint.
    """
    if space.dim == 0 and _as_published(space):
        return 0.01 * float(np.linalg.norm(space.robot.upper - space.robot.lower))
    return OMPL_STEP_RAD


OMPL_STATE_SPACES = {
    "projected": ob.ProjectedStateSpace,
    "atlas": ob.AtlasStateSpace,
    "tangent-bundle": ob.TangentBundleStateSpace,
}
