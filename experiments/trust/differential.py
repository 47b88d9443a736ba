"""Two ways to the same answer: what one calls free, on the manifold, certified or timed, the other must too."""

from collections.abc import Callable

import numpy as np
from ompl import base as ob

from cvqmpt_lab.certificate import TOLERANCE, certify
from cvqmpt_lab.constraints.between_states import evenly_spaced
from cvqmpt_lab.constraints.report import bound_usage
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.planning.result import Budget, JointPath
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.trajectory.curve import SmoothCurve, smooth_curve
from cvqmpt_lab.trajectory.timing import TimingSettings, time_path
from experiments.bench.state_checks import near_contact
from experiments.suites.place_task import TUNING_ENVIRONMENTS, UnsolvableProblem, place_problem
from experiments.trust.check import Check, Trial
from experiments.trust.networks import networks_differ
from experiments.trust.put_inside import unseen

ENOUGH = Budget(iterations=20_000)
STATES_A_PROBLEM, PATHS_A_PROBLEM = 5000, 50
FINE = 1e-3
"""[rad] between the states at which the brute-force certificate looks."""
AROUND = 5
"""States on either side of one that was tampered with."""
SLOWER = 0.01
"""Share by which a motion may last longer, or less long, than toppra's."""


def in_parts(part: Callable[[PlanningProblem, int, int], list[str]], size: int) -> Callable[[int], Trial]:
    """An attack that has a part's trials made on one tuning problem after another, `size` on each.

    part: called with problem, trials and seed, returns faults.
    """

    def attack(trials: int) -> Trial:
        faults: list[str] = []
        for k, environment in enumerate(TUNING_ENVIRONMENTS[: -(-trials // size)]):
            problem = place_problem(environment)
            if isinstance(problem, UnsolvableProblem):
                continue
            found = part(problem, min(size, trials - k * size), environment)
            faults += [f"tuning problem {environment}: {fault}" for fault in found]
        return Trial(trials, faults)

    return attack


def free_states(problem: PlanningProblem, states: int, seed: int) -> list[str]:
    """States, half of them near contact, that the kernels call free and coal does not."""
    space, rng = ConstrainedSpace(problem), np.random.default_rng(seed)
    anywhere = problem.robot.random_configurations(rng, states - states // 2)
    close = near_contact(problem, space, rng, states // 2) if states > 1 else anywhere[:0]
    q = np.concatenate([anywhere, close])
    q = q[space.valid_batch(q)]
    return [
        f"free although {q.tolist()} collides" for q in q[problem.collision_checker().in_collision_batch(q)]
    ]


class _Manifold(ob.Constraint):
    """The constraint of a problem, projected upon by OMPL's own Newton's method."""

    def __init__(self, problem: PlanningProblem) -> None:
        self._manifold = problem.manifold
        rows = len(problem.manifold.residual(problem.start))
        super().__init__(problem.robot.dof, rows, 1e-4)

    def function(self, x: np.ndarray, out: np.ndarray) -> None:
        """F(x)."""
        out[:] = self._manifold.residual(np.array(x))

    def jacobian(self, x: np.ndarray, out: np.ndarray) -> None:
        """Its derivative."""
        out[:] = self._manifold.jacobian(np.array(x))


def projections(problem: PlanningProblem, states: int, seed: int) -> list[str]:
    """States that OMPL brings onto the manifold, inside the limits, and our projection does not, nor nearly as near."""
    theirs, robot, faults = _Manifold(problem), problem.robot, []
    for q in robot.random_configurations(np.random.default_rng(seed), states):
        ours, other = problem.manifold.project(q), q.copy()
        reached = theirs.project(other) and robot.joint_outside_limits(other) is None
        if ours is None and reached:
            faults.append(f"OMPL projects {q.tolist()}, we do not")
        if ours is not None and (
            not theirs.isSatisfied(ours) or robot.joint_outside_limits(ours) is not None
        ):
            faults.append(f"our projection of {q.tolist()} is off the manifold or beyond a limit")
    return faults


def certificates(problem: PlanningProblem, paths: int, seed: int) -> list[str]:
    """Tampered pieces of a path that are certified although states FINE apart collide or leave the constraint."""
    solution, rng, faults = solve(problem, "birrt", ENOUGH, seed=0), np.random.default_rng(seed), []
    if solution.simplified is None:
        return ["not solved"]
    states, checker = solution.simplified.path.states, problem.collision_checker()
    for _ in range(paths):
        middle = rng.integers(AROUND, len(states) - AROUND)
        piece = states[middle - AROUND : middle + AROUND + 1].copy()
        bend = np.concatenate([np.linspace(0.0, 1.0, AROUND + 1), np.linspace(1.0, 0.0, AROUND + 1)[1:]])
        piece += 10.0 ** rng.uniform(-4.0, -0.3) * bend[:, None] * rng.standard_normal(problem.robot.dof)
        kinds = {
            str(fault.kind) for fault in certify(problem, JointPath(piece), checker, clearance=False).faults
        }
        fine = evenly_spaced(piece, FINE)
        outside = max(
            (use.excess for use in bound_usage(problem.robot, problem.constraint, fine)), default=0.0
        )
        if checker.in_collision_batch(fine).any() and "collision" not in kinds:
            faults.append(f"certified although it collides: {piece.tolist()}")
        if outside > TOLERANCE and "manifold" not in kinds:
            faults.append(f"certified although it leaves the constraint by {outside:.2g}: {piece.tolist()}")
    return faults


def durations(problem: PlanningProblem, paths: int, seed: int) -> list[str]:
    """Paths on which our fastest motion and toppra's last differently long."""
    limits, faults = problem.robot.joint_limits, []
    for k in range(paths):
        solution = solve(problem, "birrt", ENOUGH, seed=seed + k, clearance=False)
        if solution.simplified is None:
            continue
        states = solution.simplified.path.states
        ours = time_path(states, limits, TimingSettings(speed=1.0)).duration
        theirs = toppra_duration(
            smooth_curve(states, TimingSettings().deviation), limits.velocity, limits.acceleration
        )
        if abs(ours / theirs - 1.0) > SLOWER:
            faults.append(f"seed {seed + k}: {ours:.4f} s, toppra {theirs:.4f} s")
    return faults


def toppra_duration(curve: SmoothCurve, velocity: np.ndarray, acceleration: np.ndarray) -> float:
    """Duration [s] of the fastest motion along a curve by toppra; velocity, acceleration: (n,), largest ones."""
    import toppra
    from toppra.algorithm import TOPPRA
    from toppra.constraint import DiscretizationType, JointAccelerationConstraint, JointVelocityConstraint
    from toppra.interpolator import AbstractGeometricPath

    class Curve(AbstractGeometricPath):
        """The curve as toppra asks for it."""

        dof = curve.spline.c.shape[1]
        path_interval = np.array([0.0, curve.length])
        waypoints = None

        def __call__(self, s: np.ndarray, order: int = 0) -> np.ndarray:
            return curve.spline(s, order)

    toppra.setup_logging("ERROR")
    both = DiscretizationType.Interpolation
    constraints = [
        JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
        JointAccelerationConstraint(np.stack([-acceleration, acceleration], axis=1), both),
    ]
    grid = np.unique(np.concatenate([curve.grid, 0.5 * (curve.grid[1:] + curve.grid[:-1])]))
    _, speed, _ = TOPPRA(constraints, Curve(), gridpoints=grid).compute_parameterization(0.0, 0.0)
    return float((2.0 * np.diff(grid) / (speed[1:] + speed[:-1])).sum())


CHECKS = (
    Check(
        "what the kernels call free, coal calls free",
        "states",
        2000,
        100_000,
        in_parts(free_states, STATES_A_PROBLEM),
    ),
    Check(
        "we project what OMPL projects, onto the same manifold",
        "states",
        500,
        100_000,
        in_parts(projections, STATES_A_PROBLEM),
    ),
    Check(
        "no tampered path is certified that brute force at 0.001 rad refuses",
        "paths",
        25,
        1000,
        in_parts(certificates, PATHS_A_PROBLEM),
    ),
    Check(
        "an obstacle that a link or the can it carries is in is seen, of any size, its frame anywhere",
        "obstacles",
        20,
        5000,
        in_parts(unseen, 10 * PATHS_A_PROBLEM),
    ),
    Check(
        "what the networks compute in numpy, torch computes too",
        "states",
        2000,
        100_000,
        in_parts(networks_differ, STATES_A_PROBLEM),
    ),
    Check("motions are as fast as toppra's, to 1 %", "paths", 2, 1000, in_parts(durations, PATHS_A_PROBLEM)),
)
