"""A problem's planning space:
limits, projection and state checks, counted, for every planner alike.
"""

import ctypes
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace

import numpy as np

from cvqmpt_lab.collision.arrays import robot_arrays, scene_arrays
from cvqmpt_lab.collision.exact import CollisionChecker, reach_with
from cvqmpt_lab.collision.geometry import swing
from cvqmpt_lab.constraints.project import projection_scratch
from cvqmpt_lab.constraints.task_space_region import MAX_ITERATIONS, TOLERANCE, stack_regions
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.jit import check_arrays
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search import motion as kernels
from cvqmpt_lab.search.motion import (
    DEVIATION,
    bisect_motion,
    constraint_one,
    project_one,
    refine_and_check,
    valid_one,
)
from cvqmpt_lab.search.result import Counters, JointPath

BACKENDS = ("compiled", "exact")


class StateCheck:
    """A Python function ``valid(q) -> bool`` that compiled code calls by address, on the shared
    array `query`.

    An exception inside it cannot cross compiled code: it is kept, the state counts as invalid, and
    `reraise` throws it once the kernel has returned. The object must outlive its use.
    """

    def __init__(self, valid: Callable[[np.ndarray], bool] | None, query: np.ndarray) -> None:
        self.error: BaseException | None = None

        def call() -> bool:
            if valid is None or self.error is not None:
                return False
            try:
                return bool(valid(query))
            except BaseException as error:
                self.error = error
                return False

        self._callback = ctypes.CFUNCTYPE(ctypes.c_bool)(call)
        self.address: int = ctypes.cast(self._callback, ctypes.c_void_p).value or 0

    def reraise(self) -> None:
        """Throw what the function threw, if it did."""
        if self.error is not None:
            error, self.error = self.error, None
            raise error


@dataclass(frozen=True)
class SpaceSettings:
    """How finely motions are walked and checked."""

    step: float = 0.05  # between neighbouring states [rad], the paper's 0.05
    resolution: float = 0.01  # of the exact backend's last check of a motion [rad]
    margin: float = 1e-4  # kept from obstacles [m]
    # by which bounds are tightened [m, rad]: motions between states on the rim stay inside
    inset: float = 1e-3
    tolerance: float = TOLERANCE  # on |F| after projection [m, rad]
    max_iterations: int = MAX_ITERATIONS  # newton steps per projection


class ConstrainedSpace:
    """Compiled arrays of a problem, with one counter for all who use them."""

    doubtful: tuple[str, ...]
    """Names of the problem's configurations that the (conservative) state check blocks although the
    meshes allow them; within `kernels.DOUBT` of these, exact checks have the last word.
    """

    def __init__(
        self,
        problem: PlanningProblem,
        backend: str = "compiled",
        settings: SpaceSettings | None = None,
    ) -> None:
        """backend: state checks are "compiled", or "exact" by coal;
        projection and tree growth are the same code.
        """
        if backend not in BACKENDS:
            raise UnknownChoiceError("backend", backend, BACKENDS)
        settings = settings or SpaceSettings()
        self.problem, self.robot, self.backend, self.settings = (
            problem,
            problem.robot,
            backend,
            settings,
        )
        exact = problem.collision_checker(settings.margin) if backend == "exact" else None
        self._check, query = _callback(exact, problem.robot.dof)
        self.arrays = _arrays(problem, settings, exact is not None, self._check.address, query)
        check_arrays(self.arrays)
        self._shape = (problem.robot.dof,)
        self.doubtful = self._find_doubtful()

    def _find_doubtful(self) -> tuple[str, ...]:
        """Names of start and goals that state checks block but the meshes allow;
        exact checks are used near them.
        """
        blocked = {
            label: q for label, q in self.problem.labelled_configurations() if not self.valid(q)
        }
        self.arrays.counters[:] = 0
        if not blocked:
            return ()
        checker = self.problem.collision_checker()
        doubtful = {label: q for label, q in blocked.items() if not checker.in_collision(q)}
        self._check, query = _callback(checker, self.robot.dof)
        near = np.array(list(doubtful.values())).reshape(-1, self.robot.dof)
        self.arrays = self.arrays._replace(check=self._check.address, query=query, doubtful=near)
        return tuple(doubtful)

    @property
    def counters(self) -> Counters:
        """Work done in this space so far."""
        return Counters(*(int(c) for c in self.arrays.counters))

    def counters_since(self, before: Counters) -> Counters:
        """Work done since an earlier reading."""
        return Counters(
            *(now - then for now, then in zip(astuple(self.counters), astuple(before), strict=True))
        )

    def reraise(self) -> None:
        """Throw what a Python state check threw inside compiled code, if anything (Ctrl-C
        included).
        """
        self._check.reraise()

    def unconstrained(self) -> "ConstrainedSpace":
        """The same world without its constraint; work done there is counted here."""
        free = ConstrainedSpace(replace(self.problem, constraint=()), self.backend, self.settings)
        free.arrays = free.arrays._replace(counters=self.arrays.counters)
        return free

    @property
    def dim(self) -> int:
        """Number m of bounded rows of the constraint."""
        return len(self.arrays.regions.axis)

    def project(self, q: np.ndarray) -> bool:
        """Project q (n,) in place onto the manifold, inside the limits; True on success."""
        self._require_configuration(q)
        return project_one.unchecked(self.arrays, q)

    def valid(self, q: np.ndarray) -> bool:
        """Whether q (n,) is free of collision."""
        self._require_configuration(q)
        answer = valid_one.unchecked(self.arrays, q)
        self.reraise()
        return answer

    def valid_batch(self, configurations: np.ndarray) -> np.ndarray:
        """Whether each row of configurations (b, n) is free of collision, (b,) bool."""
        out = np.zeros(len(configurations), dtype=bool)
        kernels.states_valid(self.arrays, configurations, out)
        self.reraise()
        return out

    def residual_and_jacobian(
        self, q: np.ndarray, full: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """F(q) (m,) and dF/dq (m, n)."""
        self._require_configuration(q)
        residual, jacobian = np.zeros(self.dim), np.zeros((self.dim, self.robot.dof))
        constraint_one.unchecked(self.arrays, q, full, residual, jacobian)
        return residual, jacobian

    def _require_configuration(self, q: np.ndarray) -> None:
        """The check that `jit.entry` makes, for calls per state:
        InvalidInputError unless q is one configuration.
        """
        if q.shape != self._shape or q.dtype != np.float64:
            raise InvalidInputError(
                f"a configuration of {self.robot.name} is an array ({self.robot.dof},) of float64; "
                f"given: {q.shape} of {q.dtype}"
            )

    def checked_path(self, states: np.ndarray) -> tuple[JointPath | None, int]:
        """The path through states (m, n), refined where straight motions leave the manifold, if it
        is free.

        Otherwise None, and the index of the first segment that fails at the fine resolution.
        """
        states = np.ascontiguousarray(states)
        capacity = 8 * len(states) + 4 * int(JointPath(states).length / self.settings.step) + 64
        out = np.empty((capacity, states.shape[1]))
        written, bad = refine_and_check(self.arrays, states, out)
        self.reraise()
        return (JointPath(out[:written].copy()), -1) if bad < 0 else (None, int(bad))


def _arrays(
    problem: PlanningProblem, settings: SpaceSettings, exact: bool, check: int, query: np.ndarray
) -> kernels.Space:
    """The problem in plain arrays; check, query:
    address of the exact check, and the array it reads.
    """
    kinematics, n = problem.robot.kinematics, problem.robot.dof
    regions = stack_regions(problem.robot, problem.constraint, settings.inset)
    robot = robot_arrays(problem.robot, problem.attachments)
    return kernels.Space(
        kinematics=kinematics,
        regions=regions,
        robot=robot,
        scene=scene_arrays(
            problem.scene, reach_with(problem.robot, problem.attachments), problem.clearance
        ),
        tolerance=settings.tolerance,
        max_iterations=settings.max_iterations,
        step=settings.step,
        resolution=settings.resolution,
        margin=settings.margin,
        exact=exact,
        check=check,
        query=query,
        doubtful=np.empty((0, n)),
        swing=swing(kinematics, robot),
        counters=np.zeros(5, dtype=np.int64),
        state=np.zeros(n),
        scratch=projection_scratch(n, regions),
    )


def _callback(checker: CollisionChecker | None, n: int) -> tuple[StateCheck, np.ndarray]:
    """A checker of n joints as compiled code calls it, and the array through which it is asked."""
    query = np.zeros(n)
    valid = None if checker is None else lambda q: not checker.in_collision(q)
    return StateCheck(valid, query), query


# The direct motion between two states: straight in joints, projected on the manifold, free of
# collision.
COARSE_STEP = 0.15
"""Between neighbouring states of the first check [rad], as in `BiRRT`;
the path is then refined to the space's step.
"""


def direct_motion(
    space: ConstrainedSpace, origin: np.ndarray, target: np.ndarray
) -> JointPath | None:
    """The motion from origin to target (n,), both on the manifold, or None when there is none.

    Projected midpoints from coarse to fine, so that most failures cost a few states; a motion more
    than twice as long as straight is none. What is found is checked at the space's fine resolution.
    """
    origin, target = (np.ascontiguousarray(q, dtype=float) for q in (origin, target))
    straight = float(np.linalg.norm(target - origin))
    out = np.empty((2 * int(straight / COARSE_STEP) + 2, len(origin)))
    arrays = space.arrays._replace(step=COARSE_STEP)
    count = bisect_motion(arrays, origin, target, max(DEVIATION * straight, COARSE_STEP), out)
    space.reraise()
    if count == 0:
        return None
    return space.checked_path(np.vstack((origin[None], out[:count])))[0]
