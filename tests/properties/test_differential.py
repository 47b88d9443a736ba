"""Two independent methods agree on what is free, projected, certified and timed."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from ompl import base as ob
from toppra_duration import toppra_duration, weak_efforts

from cvqmpt_lab.benchmarks.place_task import TUNING_ENVIRONMENTS, place_problem
from cvqmpt_lab.certificate.between_states import evenly_spaced
from cvqmpt_lab.certificate.certificate import CERTIFICATE_TOLERANCE, certify
from cvqmpt_lab.constraints.report import bound_usage
from cvqmpt_lab.features.motion.timing import TimingSettings, smooth_curve, time_path
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import panda
from cvqmpt_lab.search.result import Budget, JointPath
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.vqmpt.checkpoint import as_modules
from cvqmpt_lab.vqmpt.codebook import CodeDecoder, ModelConfigurations, waypoint_codes
from cvqmpt_lab.vqmpt.weights import load_vq_mpt

ENOUGH = Budget(iterations=20_000)
STATES, PATHS, MOTIONS = 5000, 50, 12  # at most, on a problem
FINE = 1e-3  # [rad] between the states at which brute force looks
NEIGHBOURS = 1e-3  # [m] that a point moves at most from there to any state of the path
AROUND = 5  # states on either side of one that was tampered with
FAR = 1e-4  # numbers of order 1 that differ by more differ by more than rounding in 32 bits


def tuning_problems(trials, size):
    """Problems, trials to make on each, and its number."""
    for number in TUNING_ENVIRONMENTS:
        problem = place_problem(number)
        if trials > 0 and isinstance(problem, PlanningProblem):
            yield problem, min(trials, size), number
            trials -= size


def simplified(problem, seed=0):
    return solve(problem, "birrt", ENOUGH, seed).path.states


def near_contact(problem, space, rng, count):
    """Free states (count, n) of the kernels, next to a colliding state on the same motion."""
    q = problem.robot.random_configurations(rng, 10 * count)
    valid = space.valid_batch(q)
    free, colliding = q[valid][:count], q[~valid][:count]
    for _ in range(16):
        middle = 0.5 * (free + colliding)
        valid = space.valid_batch(middle)[:, None]
        free, colliding = np.where(valid, middle, free), np.where(valid, colliding, middle)
    return free


@pytest.mark.promise("what the kernels call free, coal calls free", "states", ci=2000, long=100_000)
def test_collision(trials):
    """Half of the states are near contact."""
    for problem, count, seed in tuning_problems(trials, STATES):
        space, rng = ConstrainedSpace.of(problem), np.random.default_rng(seed)
        anywhere = problem.robot.random_configurations(rng, count // 2)
        q = np.concatenate([anywhere, near_contact(problem, space, rng, count // 2)])
        free = q[space.valid_batch(q)]
        assert free[problem.collision_checker().in_collision_batch(free)].tolist() == []


class Manifold(ob.Constraint):
    """The constraint F(q) = 0 of a problem, onto which OMPL projects by its own Newton's method."""

    def __init__(self, problem):
        self.manifold = problem.manifold
        super().__init__(problem.robot.dof, len(self.manifold.residual(problem.start)), 1e-4)

    def function(self, x, out):
        out[:] = self.manifold.residual(np.array(x))

    def jacobian(self, x, out):
        out[:] = self.manifold.residual_and_jacobian(np.array(x))[1]


@pytest.mark.promise(
    "we project what OMPL projects, onto the same manifold", "states", ci=300, long=100_000
)
def test_projection(trials):
    for problem, count, seed in tuning_problems(trials, STATES):
        by_ompl, robot = Manifold(problem), problem.robot
        for q in robot.random_configurations(np.random.default_rng(seed), count):
            ours, theirs = problem.manifold.project(q), q.copy()
            reached = by_ompl.project(theirs) and robot.joint_outside_limits(theirs) is None
            assert ours is not None or not reached, q.tolist()
            if ours is not None:
                inside = robot.joint_outside_limits(ours) is None
                assert by_ompl.isSatisfied(ours) and inside, q.tolist()


@pytest.mark.promise(
    "no tampered path is certified that brute force at 0.001 rad refuses", "paths", ci=15, long=1000
)
def test_certificate(trials):
    """A state of a certified path is moved by 0.1 mrad to 0.5 rad, its neighbours by less."""
    for problem, count, seed in tuning_problems(trials, PATHS):
        states, rng = simplified(problem), np.random.default_rng(seed)
        checker = problem.collision_checker()
        bend = 1.0 - np.abs(np.arange(-AROUND, AROUND + 1)) / AROUND
        for _ in range(count):
            middle = rng.integers(AROUND, len(states) - AROUND)
            piece = states[middle - AROUND : middle + AROUND + 1].copy()
            size = 10.0 ** rng.uniform(-4.0, -0.3)
            piece += size * bend[:, None] * rng.standard_normal(problem.robot.dof)
            judged = certify(problem, JointPath(piece), checker)
            kinds = {str(fault.kind) for fault in judged.faults}
            fine = evenly_spaced(piece, FINE)
            excess = [use.excess for use in bound_usage(problem.robot, problem.constraint, fine)]
            kept = max(excess, default=0.0) <= CERTIFICATE_TOLERANCE
            free = not checker.in_collision_batch(fine).any()
            assert kinds & {"collision", "not_proven"} or free, piece.tolist()
            assert kinds & {"manifold", "not_proven"} or kept, piece.tolist()


@pytest.mark.promise(
    "the printed least clearance is between what is proven and what is found by brute force",
    "motions",
    ci=2,
    long=500,
)
def test_clearance(trials):
    for problem, count, seed in tuning_problems(trials, MOTIONS):
        checker = problem.collision_checker()
        for k in range(count):
            states = simplified(problem, seed + k)
            judged, fine = (
                certify(problem, JointPath(states), checker, True),
                evenly_spaced(states, FINE),
            )
            for clearance, nearest in (
                (judged.obstacle_clearance, checker.nearest_obstacle),
                (judged.self_clearance, checker.nearest_of_itself),
            ):
                closest = min(nearest(q).distance for q in fine)
                assert clearance.at_least_m <= closest + 1e-6, seed + k
                assert clearance.distance_m >= closest - NEIGHBOURS, seed + k


# both keep the limits at the two ends of each interval of the grid: on 40 paths that efforts limit,
# a grid twice as fine makes motions 1.3 % faster (median; at most 7.8 %), and doubles the program
@pytest.mark.promise(
    "motions are as fast as toppra's on their grid, to 1 %", "paths", ci=2, long=1000
)
def test_timing(trials):
    for problem, count, seed in tuning_problems(trials, PATHS):
        limits = replace(problem.robot.joint_limits, jerk=None)
        for k in range(count):
            states = simplified(problem, seed + k)
            # on every second path effort limits are so low that they slow the motion down
            dynamics = problem.dynamics if (seed + k) % 2 else None
            effort = weak_efforts(problem, states)
            full, weak = TimingSettings(speed=1.0), replace(limits, effort=effort)
            ours = time_path(states, weak, full, dynamics=dynamics).duration
            curve = smooth_curve(states, TimingSettings().deviation)
            theirs = toppra_duration(curve, limits.velocity, limits.acceleration, dynamics, effort)
            assert ours == pytest.approx(theirs, rel=0.01), seed + k


@pytest.mark.promise(
    "what the networks compute in numpy, torch computes too", "states", ci=2000, long=100_000
)
@torch.inference_mode()
def test_networks(trials):
    stored = load_vq_mpt(panda())
    dictionary = as_modules(stored).modules["dictionary"]
    for problem, count, seed in tuning_problems(trials, STATES):
        rng = np.random.default_rng(seed)
        q = problem.robot.random_configurations(rng, count)
        of = ModelConfigurations(stored, problem.robot).of(q)
        quantizer = dictionary.quantizer
        z = quantizer.project(dictionary.encoder(torch.from_numpy(of)[None]))[0]
        cosines = (z @ quantizer.embedding.weight.T).numpy()
        chosen = cosines[np.arange(count), waypoint_codes(stored, of)]
        # rounding may choose only between equal cosines
        assert (chosen > cosines.max(axis=1) - FAR).all()
        z = rng.standard_normal((count, stored.config.dictionary.code_dim)).astype(np.float32)
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        theirs, ours = dictionary.decode(torch.from_numpy(z)), CodeDecoder(stored).decode(z)
        np.testing.assert_allclose(ours.mean, theirs.mean.numpy(), rtol=0, atol=FAR)
        np.testing.assert_allclose(ours.covariance, theirs.covariance.numpy(), rtol=0, atol=FAR)
