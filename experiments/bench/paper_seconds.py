"""Do prices of operations predict seconds? OMPL's planners with all operations done in PyBullet.

Rows of results price counted operations. Here state checks, poses and Jacobians of a whole search
are PyBullet's, and Newton's method is numpy's, as in the published code, and the search is timed.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import repeat
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.files import csv_table, make_folder, write_text
from cvqmpt_lab.benchmarks.results.provenance import ProvenanceFile, provenance
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.constraints.project import PROJECTION_STEPS
from cvqmpt_lab.experiments.bench.paper_check import Placement, Simulator
from cvqmpt_lab.experiments.bench.stage_times import CpuClock, Measured
from cvqmpt_lab.paper_tables.bootstrap import ratio_of_means
from cvqmpt_lab.planning.pipeline import with_drawn_goals
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.motion import NEWTON_ITERATIONS, PROJECTIONS, STATE_CHECKS
from cvqmpt_lab.search.planner_interface import Observation, Query, search
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.search.work import PRICES, Prices
from cvqmpt_lab.vqmpt.weights import VQ_MPT, resolve_model, weights_digest


class Timed(NamedTuple):
    """The searches of one run: their operations, and their processor time."""

    planner: str
    problem: str
    solved: bool
    state_checks: int
    projections: int
    newton_steps: int
    seconds: float  # without networks [s]
    # seconds predicted from prices on this machine, and from `PRICES["pybullet"]` [s]
    predicted: float = 0.0
    published: float = 0.0

    def priced(self, prices: Prices) -> float:
        """Return the price of the operations [s]."""
        return prices.cost(self.state_checks, self.projections, self.newton_steps)


def paper_seconds(
    problems: Sequence[PlanningProblem],
    report: Callable[[int, int], None],
    planners: Sequence[str] = ("ompl-projected", "ompl-cvq"),
    cost: float = 2.0,
) -> list[Timed]:
    """Run planners of OMPL on problems with all operations done in PyBullet; Ctrl-C ends it early.

    Prices are medians over random configurations, some of them measured for every problem.

    Args:
        problems: problems of the place task.
        report: called with the number of finished problems and the number of all.
        planners: planners of OMPL's RRTConnect.
        cost: budget of a run at the prices of PyBullet [s].
    """
    found: list[Timed] = []
    clock = CpuClock()
    with suppress(KeyboardInterrupt):
        for done, problem in enumerate(map(with_drawn_goals, problems), start=1):
            with Simulator(problem) as simulator:
                space = SimulatedSpace(problem, simulator)
                _measure_prices(clock, space, np.random.default_rng(done))
                found += [_timed(problem, space, planner, cost) for planner in planners]
            report(done, len(problems))
    spent = {figure.name: 1e-3 * figure.median for figure in clock.measured()}
    step = sum(spent[name] for name in ("residual", "jacobian", "least squares"))
    prices = Prices(spent["state check"], spent["residual"], step)
    fixed = PRICES["pybullet"]
    return [x._replace(predicted=x.priced(prices), published=x.priced(fixed)) for x in found]


def _measure_prices(clock: CpuClock, space: "SimulatedSpace", rng: np.random.Generator) -> None:
    """Time operations; Newton steps apart from checks, whose data would displace theirs."""
    configurations = space.robot.random_configurations(rng, 20)
    for q in configurations[:10]:
        clock("state check", space.valid, q)
    for q in configurations:
        residual = clock("residual", space.residual, q)
        rows = clock("jacobian", space.jacobian, q)
        clock("least squares", np.linalg.lstsq, rows, residual, None)


def _timed(problem: PlanningProblem, space: "SimulatedSpace", planner: str, cost: float) -> Timed:
    """Search for one goal after the other, or for all, as the planner does; seed 0.

    Args:
        problem: the problem, with goals.
        space: its space.
        planner: name of a planner.
        cost: budget at the prices of PyBullet [s].
    """
    stages = planner_named(planner).stages(problem)
    cloud = None if stages.observe is None else stages.observe(problem.scene)
    budget = Budget(cost=cost, prices=PRICES["pybullet"])
    rng = problem.random_stream(0)
    query = Query.of(space, problem.start, problem.goals, budget, rng)
    (limit,) = stages.goal_limits or (None,)
    space.tally[:], seconds, path = 0, 0.0, None
    for part in query.one_by_one(limit) if stages.goals_apart else (query,):
        proposal = stages.predict(part, Observation(cloud))
        began = time.process_time()
        path = search(stages.search or BiRRT(), part, proposal).path
        seconds += time.process_time() - began
        if path is not None or query.deadline.spent() is not None:
            break
    checks, projections, steps = space.tally[
        [STATE_CHECKS, PROJECTIONS, NEWTON_ITERATIONS]
    ].tolist()
    return Timed(planner, problem.name, path is not None, checks, projections, steps, seconds)


def ratios(found: Sequence[Timed]) -> list[Measured]:
    """Return ratios of mean seconds over problems, with 95 % intervals.

    For each planner: of measured over predicted seconds. Between planners: of the second one over
    the first one, measured and predicted.
    """
    runs = {name: [x for x in found if x.planner == name] for name in {x.planner: 0 for x in found}}

    def ratio(name: str, own: Sequence[float], other: Sequence[float]) -> Measured:
        middle, low, high = (float(x or 0.0) for x in ratio_of_means(own, other, 0.05)[:3])
        return Measured(name, middle, low, high, "times")

    def values(planner: str, what: str) -> list[float]:
        return [getattr(x, what) for x in runs[planner]]

    lines = [
        ratio(f"{name}: measured / {what} seconds", values(name, "seconds"), values(name, what))
        for name in runs
        for what in ("predicted", "published")
    ]
    first, second = runs
    words = {"seconds": "measured", "predicted": "predicted", "published": "published"}
    return lines + [
        ratio(f"{second} / {first}, {word}", values(second, what), values(first, what))
        for what, word in words.items()
    ]


def write_paper_seconds(out: Path, found: Sequence[Timed], command: Sequence[str]) -> None:
    """Write runs, ratios and provenance into a folder.

    Args:
        out: the folder.
        found: the runs.
        command: words of the command line.
    """
    model = weights_digest(resolve_model("vq_mpt", VQ_MPT))
    problems = sorted({int(x.problem) for x in found})
    configuration = {"figure": "paper-seconds", "suite": "place-task", "problems": problems}
    record = ProvenanceFile(make_folder(out))
    record.create(configuration, provenance(command, [0], {"vq_mpt": model}))
    tables: dict[str, list[Sequence[object]]] = {
        "values.csv": [Timed._fields, *found],
        "ratios.csv": [("ratio", "estimate", "low", "high"), *(x[:4] for x in ratios(found))],
    }
    for name, rows in tables.items():
        cells = [[f"{x:.6g}" if isinstance(x, float) else x for x in row] for row in rows]
        write_text(out / name, csv_table(cells))


class SimulatedSpace(ConstrainedSpace):
    """A space with one region of rotations whose checks, residual and Jacobian are PyBullet's.

    Only the fine check of a path that was found stays compiled. `tally` counts PyBullet's work.

    Args:
        problem: the problem; the joints of its robot are the first of its URDF.
        simulator: the simulator of the problem.
    """

    def __init__(self, problem: PlanningProblem, simulator: Simulator) -> None:
        super().__init__(World(problem.robot, problem.scene), problem.manifold)
        self._simulator, self._bullet = simulator, simulator.bullet
        (urdf, _), *_ = problem.robot.files
        # for kinematics; its bodies are not checked
        self._body = self._bullet.loadURDF(urdf, useFixedBase=True)
        joints = map(self._bullet.getJointInfo, repeat(self._body), range(self._joint_count()))
        # positions of all joints that move; the fingers are the last ones
        self._positions = [0.0] * sum(joint[3] >= 0 for joint in joints)
        regions = self.arrays.regions
        self._reference = regions.reference_rotation[0].T
        turns = self._reference, regions.end_rotation[0]
        self._turns = [Rotation.from_matrix(turn).as_quat().tolist() for turn in turns]
        self._rotation = np.zeros(3)  # of the last residual [rad]
        self.tally = np.zeros_like(self.arrays.counters)

    def _joint_count(self) -> int:
        return int(self._bullet.getNumJoints(self._body))

    def _count(self, operation: int) -> None:
        self.tally[operation] += 1
        self.arrays.counters[operation] += 1  # the budget counts these

    def _move_to(self, q: np.ndarray) -> None:
        for joint, angle in enumerate(q):
            self._bullet.resetJointState(self._body, joint, angle)

    def valid(self, q: np.ndarray) -> bool:
        """Whether q (n,) is free of collision, by all distances of the simulator."""
        self._count(STATE_CHECKS)
        self._move_to(q)
        joints = range(len(q))
        states = self._bullet.getLinkStates(self._body, joints, computeForwardKinematics=True)
        poses: list[Placement] = [([0.0] * 3, [0.0, 0.0, 0.0, 1.0])]  # of the base
        poses += [(list(state[4]), list(state[5])) for state in states]
        self._simulator.place([poses[row] for row in self._simulator.rows])
        apart = self._simulator.links_apart()
        return self._simulator.clear_of_obstacles() and apart

    def residual_and_jacobian(
        self, q: np.ndarray, full: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return F(q) (m,) and dF/dq (m, n); full: also the rows of dF/dq where F is 0."""
        residual = self.residual(q)
        rows = self.jacobian(q)
        return residual, rows if full else rows * (residual != 0.0)[:, None]

    def residual(self, q: np.ndarray) -> np.ndarray:
        """Return F(q) (m,), the part of the rotation vector outside its bounds [rad]."""
        bullet, none, regions = self._bullet, [0.0] * 3, self.arrays.regions
        self._move_to(q)
        link = bullet.getLinkState(self._body, len(q) - 1, computeForwardKinematics=True)
        before, after = self._turns
        turn = bullet.multiplyTransforms(none, before, none, link[5])[1]
        turn = bullet.multiplyTransforms(none, turn, none, after)[1]
        axis, angle = bullet.getAxisAngleFromQuaternion(turn)
        self._rotation = (angle - 2.0 * np.pi * (angle > np.pi)) * np.array(axis)
        x = self._rotation[regions.axis - 3]
        return x - np.clip(x, regions.lower, regions.upper)

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return all rows of dF/dq (m, n) where `residual` was computed last."""
        none = [0.0] * len(self._positions)
        self._positions[: len(q)] = q.tolist()
        angular = self._bullet.calculateJacobian(
            self._body, len(q) - 1, [0.0] * 3, self._positions, none, none
        )[1]
        x, y, z = self._rotation
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        square = x * x + y * y + z * z
        half = np.sqrt(square) / 2.0
        # Jl^-1 of the rotation vector, see `constraints.regions`
        factor = 1.0 / 12.0 if half < 1e-3 else (1.0 - half / np.tan(half)) / square
        inverse = np.eye(3) - cross / 2.0 + factor * cross @ cross
        rows = (inverse @ self._reference)[self.arrays.regions.axis - 3]
        return rows @ np.array(angular)[:, : len(q)]

    def project(self, q: np.ndarray) -> bool:
        """Project q (n,) in place by Newton's method, inside the limits; True on success."""
        self._count(PROJECTIONS)
        lower, upper = self.robot.lower, self.robot.upper
        np.clip(q, lower, upper, out=q)
        for _ in range(PROJECTION_STEPS):
            residual = self.residual(q)
            if np.linalg.norm(residual) <= self.arrays.tolerance:
                return True
            self._count(NEWTON_ITERATIONS)
            rows = self.jacobian(q) * (residual != 0.0)[:, None]
            np.clip(q - np.linalg.lstsq(rows, residual, rcond=None)[0], lower, upper, out=q)
        return False
