"""The planning space of all planners: projections and state checks, counted; checks of paths."""

import ctypes
from typing import Annotated, Any, NamedTuple, Self

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.base.jit import check_arrays, entry, kernel, placed
from cvqmpt_lab.base.modules import provider
from cvqmpt_lab.constraints.constraint import Constraint
from cvqmpt_lab.constraints.problem_parts import ProblemParts, StateChecker, WorldParts
from cvqmpt_lab.constraints.project import (
    PROJECTION_STEPS,
    PROJECTION_TOLERANCE,
    projection_scratch,
)
from cvqmpt_lab.constraints.regions import Regions, jacobian, no_regions, residual
from cvqmpt_lab.robot.kinematics import forward_kinematics
from cvqmpt_lab.search import motion
from cvqmpt_lab.search.motion import (
    MAX_LENGTH_RATIO,
    bisect_motion,
    chord_on_manifold,
    distance,
    path_blocked,
    project_state,
)
from cvqmpt_lab.search.result import Counters, JointPath

BACKENDS = ("compiled", "exact")


class Tolerances(NamedTuple):
    """Distances that a planning space keeps."""

    step: float = 0.05  # largest distance of neighbouring states [rad], as in the paper
    margin: float = 1e-4  # distance kept from obstacles [m]
    # bounds are tightened by this much [m, rad], so that motions between states at the bounds stay
    # inside
    inset: float = 1e-3


DEFAULT_TOLERANCES = Tolerances()


@entry
def refine_and_check(
    space: motion.Space,
    states: Annotated[np.ndarray, "count n"],
    out: Annotated[np.ndarray, "capacity n"],
    segment: Annotated[np.ndarray, "int64 capacity"],
    check: bool,
):
    """Copy a path, insert projected states where it leaves the manifold, and check all motions.

    Args:
        space: the planning space.
        states: the path (m, n) [rad or m].
        out: (capacity, n), written.
        segment: (capacity,), written: the segment of `states` that ends at, or contains, each state
            of out.
        check: whether motions are checked; False: they are known to be free.

    Returns:
        Number of states in out; a segment of `states` that cannot be refined or is not free, or -1;
        and the number of segments, from the first one on, that are refined and free.
    """
    space = placed(space)
    count, n = states.shape
    most_halvings = 8  # per segment
    last = out.shape[0] - 1  # the last rows of out hold states that come later, the next one first
    for j in range(n):
        out[0, j] = states[0, j]
    written = 1
    for i in range(1, count):
        waiting = 1
        for j in range(n):
            out[last, j] = states[i, j]
        while waiting > 0:
            if written + most_halvings + 1 > last:
                return written, i - 1, 0
            before, after = out[written - 1], out[last - waiting + 1]
            if distance(before, after) > MAX_LENGTH_RATIO * space.step or not chord_on_manifold(
                space, before, after
            ):
                for j in range(n):
                    out[last - waiting, j] = 0.5 * (before[j] + after[j])
                if waiting > most_halvings or not project_state(space, out[last - waiting]):
                    return written, i - 1, 0
                waiting += 1
                continue
            for j in range(n):
                out[written, j] = after[j]
            segment[written] = i - 1
            written += 1
            waiting -= 1
    blocked = path_blocked(space, out, written) if check else -1
    if blocked < 0:
        return written, -1, count - 1
    return written, segment[blocked + 1], segment[space.proven[0] + 1]


@kernel
def _cut(proven, first, last, way, longest, pieces, count):
    """Cut a stretch of motions into pieces of proven ones, and of at most `longest` others.

    Args:
        proven: (m - 1,) bool.
        first: motion at which to begin.
        last: motion before which to stop.
        way: 1: forwards; -1: backwards, from `last` on.
        longest: largest number of unproven motions of a piece.
        pieces: (m - 1, 5), written from row `count` on: first and last state, and whether proven.
        count: number of its rows so far.

    Returns:
        Number of rows.
    """
    left, at = last - first, first if way > 0 else last - 1
    while left > 0:
        known, size = proven[at], 1
        while size < left and proven[at + way * size] == known and (known or size < longest):
            size += 1
        begin = at if way > 0 else at - size + 1
        pieces[count, 0], pieces[count, 1], pieces[count, 2] = begin, begin + size, int(known)
        count, at, left = count + 1, at + way * size, left - size
    return count


@entry
def refine_pieces(
    space: motion.Space,
    states: Annotated[np.ndarray, "count n"],
    proven: Annotated[np.ndarray, "bool motions"],
    middle: int,
    longest: int,
    out: Annotated[np.ndarray, "capacity n"],
    segment: Annotated[np.ndarray, "int64 capacity"],
    pieces: Annotated[np.ndarray, "int64 motions 5"],
):
    """Call `refine_and_check` on pieces of a path: first on those that may fail, until one does.

    Args:
        space: the planning space.
        states: the path (m, n) [rad or m].
        proven: (m - 1,), whether each motion is known to be free; those that pass are marked.
        middle: pieces before this motion are checked from the first one on, others from the last.
        longest: largest number of motions that are checked together.
        out: (capacity, n), written: the refined states of one piece after another.
        segment: (capacity,), work array.
        pieces: (m - 1, 5), written: first and last state of each piece, whether it was known to be
            free, and where its states begin and end in out.

    Returns:
        Number of pieces, or -1 less the index of a motion that fails.
    """
    space = placed(space)
    count = _cut(proven, 0, middle, 1, longest, pieces, 0)
    count = _cut(proven, middle, proven.shape[0], -1, longest, pieces, count)
    begin = 0
    for known in range(2):
        for k in range(count):
            first, last = pieces[k, 0], pieces[k, 1]
            if pieces[k, 2] != known:
                continue
            written, bad, passed = refine_and_check(
                space, states[first : last + 1], out[begin:], segment[begin:], known == 0
            )
            for i in range(passed):
                proven[first + i] = True
            if bad >= 0:
                return -1 - first - bad
            pieces[k, 3], pieces[k, 4] = begin, begin + written
            begin += written
    return count


@entry
def project_one(space: motion.Space, q: Annotated[np.ndarray, "n"]):
    """Project q (n,) in place; True on success."""
    return project_state(placed(space), q)


@entry
def constraint_one(
    space: motion.Space,
    q: Annotated[np.ndarray, "n"],
    full: bool,
    out_residual: Annotated[np.ndarray, "m"],
    out_jacobian: Annotated[np.ndarray, "m n"],
):
    """Compute the constraint and its Jacobian at one configuration.

    Args:
        space: the planning space.
        q: (n,) [rad or m].
        full: whether the Jacobian has non-zero rows where F is 0.
        out_residual: F(q) (m,), written.
        out_jacobian: dF/dq (m, n), written.
    """
    scratch = space.scratch
    rotation, translation = scratch.link_rotation, scratch.link_translation
    forward_kinematics(space.kinematics, q, rotation, translation)
    residual(space.regions, q, rotation, translation, out_residual, scratch.displacement)
    jacobian(
        space.kinematics,
        space.regions,
        q,
        rotation,
        translation,
        scratch.displacement,
        full,
        out_residual,
        out_jacobian,
    )


CERTIFIED_CHORD = 4e-4  # |F| [m, rad] between two states, below the tolerance of the certificate


def _chord(regions: Regions, inset: float, most: float = 6e-4) -> float:
    """Return the largest |F| [m, rad] of tightened bounds that straight motions may reach.

    Args:
        regions: regions with tightened bounds.
        inset: the bounds were tightened by this much, narrow ones by less [m, rad].
        most: result where all bounds were tightened by `inset`: motions stay inside the true ones.
            Where narrow bounds were tightened less, motions may be outside the true ones by
            CERTIFIED_CHORD.
    """
    # of a narrow bound, a tenth of the width was taken from both sides
    taken = min(inset, float((regions.upper - regions.lower).min(initial=np.inf)) / 8.0)
    return min(most, CERTIFIED_CHORD + taken)


class StateCheck:
    """An exact state check that compiled code calls by its address.

    The caller writes the configuration into `query`. Without a checker, no state is free. An
    exception cannot pass through compiled code: it is stored in `error`, and the state counts as
    invalid. The object must exist as long as compiled code may call it.
    """

    def __init__(self, checker: StateChecker | None, n: int) -> None:
        self.error: BaseException | None = None
        self.query = query = np.zeros(n)

        def call() -> bool:
            if checker is None or self.error is not None:
                return False
            try:
                return not checker.in_collision(query)
            except BaseException as error:
                self.error = error
                return False

        self._callback = ctypes.CFUNCTYPE(ctypes.c_bool)(call)
        self.address: int = ctypes.cast(self._callback, ctypes.c_void_p).value or 0


class ConstrainedSpace:
    """Arrays of a robot, a scene and a constraint for compiled code, and counters of the work.

    Args:
        world: the robot, what it carries, and obstacles.
        constraint: F(q) = 0; None: all configurations. Compiled code calls it by an address where
            it is Python code, which takes longer.
        backend: state checks are "compiled", or "exact" by the world's checker; everything else is
            the same.
        ends: start and goals (k, n) [rad or m]. The compiled check is conservative: near an end
            that only this check blocks, exact checks decide.
        tolerances: step, margin and tightening of bounds.
    """

    # names of start and goals that only the conservative check blocks
    doubtful: tuple[str, ...]

    def __init__(
        self,
        world: WorldParts,
        constraint: Constraint | None = None,
        *,
        backend: str = "compiled",
        ends: np.ndarray | None = None,
        tolerances: Tolerances = DEFAULT_TOLERANCES,
    ) -> None:
        if backend not in BACKENDS:
            raise UnknownChoiceError("backend", backend, BACKENDS)
        self._made_of: dict[str, Any] = {
            "backend": backend,
            "ends": ends,
            "tolerances": tolerances,
        }
        self.world, self.robot, self.constraint = world, world.robot, constraint
        self.stopped = False  # whether searches in this space shall end, see `stop`
        robot, n = world.robot, world.robot.dof
        step, margin, inset = tolerances
        exact = world.checker(margin) if backend == "exact" else None
        self._check = StateCheck(exact, n)
        regions = no_regions() if constraint is None else constraint.inner_regions(inset)
        self.arrays = motion.Space(
            kinematics=robot.kinematics,
            regions=regions,
            robot=world.robot_arrays,
            scene=world.scene_arrays,
            tolerance=PROJECTION_TOLERANCE,
            chord=_chord(regions, inset),
            max_iterations=PROJECTION_STEPS,
            step=step,
            resolution=0.01,
            margin=margin,
            exact=exact is not None,
            check=self._check.address,
            query=self._check.query,
            doubtful=np.empty((0, n)),
            swing=world.robot_swing,
            counters=np.zeros(8, dtype=np.int64),
            state=np.zeros(n),
            scratch=projection_scratch(robot.kinematics, regions),
            ends=np.zeros((2, n)),
            proven=np.zeros(1, dtype=np.int64),
            motion=np.zeros(n),
            balls=np.zeros((len(world.robot_arrays.body_link), 4)),
            projection=motion.project_at.kernel_address,
            advance=motion.advance_at.kernel_address,
            bisection=bisect_motion.kernel_address,
            proof=motion.blocked_segment.kernel_address,
        )
        check_arrays(self.arrays)
        self.doubtful = ()
        if ends is not None:
            self.doubtful = self._find_doubtful(world.checker(), ends)

    @classmethod
    def of(
        cls,
        problem: ProblemParts,
        backend: str = "compiled",
        world: WorldParts | None = None,
        **options: Any,
    ) -> Self:
        """Return the space of a planning problem; `ends` are its start and goals.

        Args:
            problem: the planning problem.
            backend: of state checks.
            world: the world of the problem; None: it is made here.
            **options: more arguments of the constructor.
        """
        return cls(
            world or provider("world").of(problem),
            problem.manifold,
            backend=backend,
            **{"ends": np.vstack([problem.start, problem.goals]), **options},
        )

    def again(self) -> "ConstrainedSpace":
        """Return a copy of this space with separate counters."""
        return ConstrainedSpace(self.world, self.constraint, **self._made_of)

    def stop(self) -> None:
        """Ask a search in this space, which runs in another thread, to end soon."""
        self.stopped = True

    def unconstrained(self) -> "ConstrainedSpace":
        """Return a copy of this space without its constraint; its work is counted in this one."""
        free = ConstrainedSpace(self.world, **self._made_of)
        free.arrays = free.arrays._replace(counters=self.arrays.counters)
        return free

    def _find_doubtful(self, checker: StateChecker, ends: np.ndarray) -> tuple[str, ...]:
        """Return `doubtful` for start and goals (k, n); exact checks will decide near them."""
        free = self.valid_batch(ends)
        self.arrays.counters[:] = 0
        if free.all():
            return ()
        rows = [k for k in np.flatnonzero(~free) if not checker.in_collision(ends[k])]
        self._check = StateCheck(checker, self.robot.dof)
        self.arrays = self.arrays._replace(
            check=self._check.address, query=self._check.query, doubtful=ends[rows]
        )
        return tuple("start" if k == 0 else f"goal {k - 1}" for k in rows)

    @property
    def counters(self) -> Counters:
        """Work done in this space so far."""
        return Counters(*self.arrays.counters.tolist())

    @property
    def work(self) -> float:
        """Work done in this space so far, see `Counters.work`."""
        return self.counters.work

    def counters_since(self, before: Counters) -> Counters:
        """Work done since the counters were `before`."""
        return Counters(*(self.arrays.counters - [*vars(before).values()]).tolist())

    def reraise(self) -> None:
        """Raise what Python code raised inside compiled code, Ctrl-C included."""
        error, self._check.error = self._check.error, None
        if error is not None:
            raise error
        if self.constraint is not None:
            self.constraint.reraise()

    @property
    def dim(self) -> int:
        """Number m of entries of F."""
        return 0 if self.constraint is None else self.constraint.dim

    def project(self, q: np.ndarray) -> bool:
        """Project q (n,) in place onto the manifold, inside the limits; True on success."""
        self._require_configuration(q)
        return project_one.unchecked(self.arrays, q)

    def valid(self, q: np.ndarray) -> bool:
        """Whether q (n,) is free of collision."""
        self._require_configuration(q)
        free = np.zeros(1, dtype=bool)
        motion.states_valid.unchecked(self.arrays, q[None], free)
        self.reraise()
        return bool(free[0])

    def valid_batch(self, configurations: np.ndarray) -> np.ndarray:
        """Whether each row of configurations (b, n) is free of collision, (b,) bool."""
        out = np.zeros(len(configurations), dtype=bool)
        motion.states_valid(self.arrays, configurations, out)
        self.reraise()
        return out

    def residual_and_jacobian(
        self, q: np.ndarray, full: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return F(q) (m,) and dF/dq (m, n); full: also the rows of dF/dq where F is 0."""
        self._require_configuration(q)
        residual, jacobian = np.zeros(self.dim), np.zeros((self.dim, self.robot.dof))
        constraint_one.unchecked(self.arrays, q, full, residual, jacobian)
        return residual, jacobian

    def _require_configuration(self, q: np.ndarray) -> None:
        """Refuse anything but one configuration; faster than the check of `jit.entry`."""
        if q.shape != (self.robot.dof,) or q.dtype != np.float64:
            raise InvalidInputError(
                f"a configuration of {self.robot.name} is an array ({self.robot.dof},) of "
                f"float64; given: {q.shape} of {q.dtype}"
            )

    def checked_path(
        self, states: np.ndarray, proven: np.ndarray | None = None, middle: int | None = None
    ) -> tuple[JointPath | None, int]:
        """Refine a path (m, n) [rad or m] where straight motions leave the manifold, and check it.

        Args:
            states: the path.
            proven: (m - 1,) bool, whether a motion to the next state passed this check before:
                it is not checked again. Motions that pass are marked, also on a path that fails.
            middle: motions before this one are checked from the path's first state on, the others
                from its last state on; None: all from the first one on.

        Returns:
            The path and -1, or None and the index of a motion that fails.
        """
        if proven is None:
            proven, longest = np.zeros(max(len(states) - 1, 0), dtype=bool), len(states)
        else:
            longest = PROVEN_TOGETHER
        if not len(proven):
            return JointPath(states.copy()), -1
        states = np.ascontiguousarray(states)
        capacity = 24 * len(states) + 4 * int(JointPath(states).length / self.arrays.step) + 64
        out, segment = np.empty((capacity, states.shape[1])), np.empty(capacity, dtype=np.int64)
        pieces = np.empty((len(proven), 5), dtype=np.int64)
        middle = len(proven) if middle is None else middle
        count = refine_pieces(self.arrays, states, proven, middle, longest, out, segment, pieces)
        self.reraise()
        if count < 0:
            return None, -1 - int(count)
        rows = sorted(pieces[:count].tolist())
        # neighbouring pieces share a state
        parts = [out[begin + (k > 0) : end] for k, *_, begin, end in rows]
        return JointPath(np.concatenate(parts)), -1


# motions of a path that are checked in one call: fewer are checked in vain behind one that fails,
# more share a proof
PROVEN_TOGETHER = 8


def direct_motion(
    space: ConstrainedSpace, origin: np.ndarray, target: np.ndarray, coarse_step: float = 0.15
) -> JointPath | None:
    """Return the direct motion between two states by projected midpoints, or None.

    Midpoints are made from coarse to fine: most motions that fail do so after few states. Motions
    more than MAX_LENGTH_RATIO times as long as the straight line are refused. The result is checked
    at the space's fine resolution.

    Args:
        space: the planning space.
        origin: (n,), on the manifold [rad or m].
        target: (n,), on the manifold [rad or m].
        coarse_step: largest distance of neighbouring states before the refinement [rad].
    """
    origin = np.ascontiguousarray(origin, dtype=float)
    target = np.ascontiguousarray(target, dtype=float)
    straight = float(np.linalg.norm(target - origin))
    out = np.empty((2 * int(straight / coarse_step) + 2, len(origin)))
    arrays = space.arrays._replace(step=coarse_step)
    longest = max(MAX_LENGTH_RATIO * straight, coarse_step)
    count = bisect_motion(arrays, origin, target, longest, out)
    space.reraise()
    if count == 0:
        return None
    return space.checked_path(np.vstack((origin[None], out[:count])))[0]
