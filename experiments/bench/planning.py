"""What planners and their stages cost; `BENCHES` is the table of all that `cvqmpt bench` measures."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import trimesh

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.pipeline import solve, solve_many, with_sampled_goals
from cvqmpt_lab.planners import PLANNERS, planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.scene.convex import convex_pieces
from cvqmpt_lab.scene.families import random_scene
from cvqmpt_lab.search import birrt as kernels
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.query import Observation, Query, Uniform
from cvqmpt_lab.search.result import Budget, PlanStatus
from cvqmpt_lab.search.shortcut import SimplifySettings, simplify
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.sensing.observation import Observer
from cvqmpt_lab.vqmpt.stages import STEPS, code_roadmap
from cvqmpt_lab.warm_up import warm_up
from experiments.bench.measurement import CALIBRATION, CpuTimes, Figure, Measurement, measured
from experiments.bench.paper_check import bench_paper_check
from experiments.bench.perception import bench_calibration, bench_edge_model, bench_scan
from experiments.bench.scene_prediction import bench_transformer
from experiments.bench.sequence_quality import bench_sequences
from experiments.bench.state_checks import bench_collision, bench_kernels
from experiments.executors import local_processes
from experiments.suites.place_task import TUNING_ENVIRONMENTS, place_problem

ENOUGH = Budget(iterations=20_000)
SIZES = (1_000, 10_000, 100_000)  # nodes of the larger tree
SAMPLES = 16  # handed to a growing tree at once
REPEATS = 5  # of each problem
LONG_RUN = 2.0  # [s] in which the best path is looked for
FIRST_RANDOM_SCENE = 700_000  # seeds of scenes that nothing else uses


def bench_planners(problems: int) -> Iterator[Measurement]:
    """Every planner on tuning problems: time, counts, lengths, success."""
    cases = _posed(problems)
    for name in PLANNERS:
        runs = [  # the first one only loads code
            solve(problem, name, Budget(seconds=10.0), seed=0, clearance=False)
            for problem in (cases[0], *cases)
        ][1:]
        solved = [run.plan.status is PlanStatus.SOLVED for run in runs]
        times = [
            1e3 * run.plan.seconds if ok else np.inf for run, ok in zip(runs, solved, strict=True)
        ]
        shorter = [run.simplified for run in runs if run.simplified is not None]
        raw = [run.plan.path.length for run in runs if run.plan.path is not None]
        yield Measurement(f"{name}: plan", "ms", times)
        yield Measurement(f"{name}: simplify", "ms", [1e3 * one.seconds for one in shorter])
        yield Measurement(
            f"{name}: projections", "", [run.plan.counters.projections for run in runs]
        )
        yield Measurement(
            f"{name}: state checks", "", [run.plan.counters.state_checks for run in runs]
        )
        yield Measurement(f"{name}: raw length", "rad", raw)
        yield Measurement(f"{name}: final length", "rad", [one.path.length for one in shorter])
        yield Measurement(f"{name}: solved of {len(runs)}", "", [sum(solved)])


def bench_stages(problems: int) -> Iterator[Measurement]:
    """Every stage of planning with `birrt`."""
    clock, states, lengths = CpuTimes(), [], []
    for problem in _place_problems(problems):
        rng, uniform = np.random.default_rng(0), Uniform(problem.robot.lower, problem.robot.upper)
        posed, _ = clock("place task: goals", with_sampled_goals, problem)
        space = clock("place task: space", ConstrainedSpace, posed)
        ends = posed.start, posed.goals
        plan = clock("place task: search", BiRRT().search, space, *ends, uniform, ENOUGH, rng)
        if plan.path is not None:
            shorter = clock("place task: shortening", simplify, space, plan.path, rng)
            certificate = clock("place task: certificate", certify, posed, shorter.path)
            states.append(certificate.states_checked)
            lengths.append(shorter.path.length)
    yield from clock.measurements()
    yield Measurement("place task: configurations checked by the certificate", "", states)
    yield Measurement("place task: length", "rad", lengths)


def bench_growth() -> Iterator[Measurement]:
    """Tree growth against the number of nodes, by iteration and by projection, of which dense trees
    need more.

    Connections are ignored, so that trees go on growing.
    """
    (problem,) = _posed(1)
    solve(problem, "birrt", ENOUGH, seed=0, clearance=False)  # only loads code
    space = ConstrainedSpace(problem)
    arrays = space.arrays._replace(step=BiRRT().step)
    trees, rng = kernels.plant(problem.start, problem.goals, 4 * SIZES[0]), np.random.default_rng(0)
    for size in SIZES:
        iteration: list[float] = []
        projection: list[float] = []
        while trees.size.max() < 1.2 * size:
            samples = problem.robot.random_configurations(rng, SAMPLES)
            before, began, first = space.counters, time.process_time(), 0
            while first < SAMPLES:
                status, first = kernels.grow(arrays, trees, samples, first, BiRRT().reach)
                trees = kernels.enlarged(trees) if status == kernels.FULL else trees
            if trees.size.max() > 0.8 * size:
                took = 1e6 * (time.process_time() - began)
                iteration.append(took / SAMPLES)
                projection.append(took / space.counters_since(before).projections)
        yield Measurement(f"birrt: an iteration with {size} nodes", "us", iteration)
        yield Measurement(f"birrt: a projection, all in, with {size} nodes", "us", projection)


def bench_networks(problems: int) -> Iterator[Measurement]:
    """Edge costs of a new cloud, prediction of sequences to all goals in a known one, update of
    their codes.
    """
    method, rng, clock = (
        planner_named("cvq:graph+algorithm-2"),
        np.random.default_rng(0),
        CpuTimes(),
    )
    for problem in _posed(problems):
        stages, space = method.stages(problem), ConstrainedSpace(problem)
        assert (
            stages.observe is not None and stages.update is not None and method.weights is not None
        )
        cloud = stages.observe(problem.scene)
        seen = code_roadmap(method.weights, problem.robot, problem.attachments)

        def observe(seen=seen, cloud=cloud) -> None:
            seen.model.arrays(cloud, use_cache=False)
            seen.edge_costs(cloud, use_cache=False)

        for _ in range(REPEATS):
            clock(f"distance field and edge costs, {len(cloud)} points", observe)
            query = Query.of(space, Budget(seconds=60.0), rng)
            proposal = clock(
                "prediction of sequences to all goals", stages.predict, query, Observation(cloud)
            )
            clock(f"latent update, {STEPS} steps", stages.update, query, proposal)
    yield from clock.measurements()


def bench_throughput(problems: int) -> Iterator[Measurement]:
    """Certified problems a second, by one process and by two at once.

    From a tuning problem and its rendered cloud to a certified path. Robots, weights and machine
    code are loaded before; distance fields and checkers are made on the way. The processor's time
    does not depend on other processes.
    """
    environments = list(TUNING_ENVIRONMENTS)[:problems]
    for name in ("birrt", "roadmap-cvq", "opt-cvq-mpt"):
        for count in range(1, 1 + min(2, len(environments))):
            parts = [environments[first::count] for first in range(count)]
            with local_processes(count) as executor:
                shares = [
                    share for _, share in executor.results(partial(_solved_in_worker, name), parts)
                ]
            certified, wall, cpu = (np.array(column) for column in zip(*shares, strict=True))
            label = f"{name}, {count} worker{'s' * (count > 1)}"
            yield Measurement(f"{label}: certified", f"of {len(environments)}", [certified.sum()])
            yield Measurement(f"{label}: rate", "a second", [certified.sum() / wall.max()])
            yield Measurement(
                f"{label}: processor time", "ms each", [1e3 * cpu.sum() / len(environments)]
            )


def _solved_in_worker(name: str, environments: list[int]) -> tuple[int, float, float]:
    """Problems that were certified, and the wall and processor time [s] of solving all of them."""
    problems = [p for p in map(place_problem, environments) if isinstance(p, PlanningProblem)]
    method, observer = planner_named(name), Observer(scenes=len(problems))
    stages = method.stages(problems[0])
    if stages.observe is not None:
        stages = replace(stages, observe=observer)
        for problem in problems:
            observer(problem.scene)
    method = replace(method, build=lambda problem, weights: stages)
    warm_up(problems[0], method, "compiled")
    wall, cpu = time.perf_counter(), time.process_time()
    solutions = solve_many(problems, method, ENOUGH)
    return (
        sum(one.solved for one in solutions),
        time.perf_counter() - wall,
        time.process_time() - cpu,
    )


def bench_meshes() -> Iterator[Measurement]:
    """Cutting meshes into convex pieces: a torus, a wavy ball, and one with a hole."""
    ball = trimesh.creation.icosphere(5)
    wavy = np.array(ball.triangles)
    wavy[:, :, 0] *= 1.0 + 0.5 * np.cos(9.0 * wavy[:, :, 1])
    torus = np.array(
        trimesh.creation.torus(0.5, 0.2, major_sections=128, minor_sections=64).triangles
    )
    open_ball = wavy[ball.triangles_center[:, 2] < 0.9]
    for name, triangles in (("torus", torus), ("closed ball", wavy), ("open ball", open_ball)):
        label = (
            f"{name} of {len(triangles)} faces into {len(convex_pieces(triangles))} convex pieces"
        )
        yield Measurement(label, "s", partial(convex_pieces, triangles))


def bench_unconstrained(problems: int) -> Iterator[Measurement]:
    """Free paths among random cubes and spheres:
    the first one, the shortened one, and how far from the best.
    """
    first, total, above_same, above_best = [], [], [], []
    for index, problem in enumerate((next(_random_problems(1)), *_random_problems(problems))):
        space, rng = ConstrainedSpace(problem), np.random.default_rng(index)
        ends, uniform = (
            (problem.start, problem.goals),
            Uniform(problem.robot.lower, problem.robot.upper),
        )
        plan = BiRRT().search(space, *ends, uniform, Budget(seconds=2.0), rng)
        if plan.path is None or index == 0:  # the first one only loads code
            continue
        shorter = simplify(space, plan.path, rng, SimplifySettings(attempts=96))
        patient = SimplifySettings(attempts=10**9, seconds=LONG_RUN, patience=10**9)
        same = best = simplify(space, plan.path, rng, patient).path.length
        began = time.perf_counter()
        while (left := LONG_RUN - (time.perf_counter() - began)) > 0:
            again = BiRRT().search(space, *ends, uniform, Budget(seconds=left), rng)
            if again.path is not None:
                settings = SimplifySettings(attempts=1024, patience=16)
                best = min(best, simplify(space, again.path, rng, settings).path.length)
        first.append(1e3 * plan.seconds)
        total.append(1e3 * (plan.seconds + shorter.seconds))
        above_same.append(100.0 * (shorter.path.length / same - 1.0))
        above_best.append(100.0 * (shorter.path.length / best - 1.0))
    yield Measurement("random scenes: first path", "ms", first)
    yield Measurement("random scenes: shortened path", "ms", total)
    yield Measurement(
        f"random scenes: above the same path shortened for {LONG_RUN:g} s", "%", above_same
    )
    yield Measurement(
        f"random scenes: above the best of {LONG_RUN:g} s of restarts", "%", above_best
    )
    yield Measurement(f"random scenes: solved of {problems}", "", [len(first)])


def _random_problems(count: int) -> Iterator[PlanningProblem]:
    """Start and goal uniform among 8 cubes and 8 spheres, where the straight motion is not free."""
    robot, number = panda(), 0
    while count > 0:
        scene, number = random_scene(FIRST_RANDOM_SCENE + number), number + 1
        rng = np.random.default_rng(number)
        checker = CollisionChecker(robot, scene, margin=0.001)
        states = [q for q in robot.random_configurations(rng, 64) if not checker.in_collision(q)]
        if (
            len(states) < 2
            or not checker.in_collision_batch(np.linspace(states[0], states[1], 64)).any()
        ):
            continue
        count -= 1
        yield PlanningProblem(f"random {number}", robot, scene, states[0], states[1][None])


def _place_problems(count: int) -> Iterator[PlanningProblem]:
    """Place-task problems whose environments are never reported, without their goals."""
    problems = (place_problem(environment) for environment in TUNING_ENVIRONMENTS[:count])
    return (problem for problem in problems if isinstance(problem, PlanningProblem))


def _posed(count: int) -> list[PlanningProblem]:
    """The same with their goals."""
    return [with_sampled_goals(problem)[0] for problem in _place_problems(count)]


BENCHES: Mapping[str, Callable[[int, int, str | None], Iterable[Measurement]]] = {
    "kernels": lambda problems, states, model: bench_kernels(_posed(1)[0]),
    "collision": lambda problems, states, model: bench_collision(_posed(1)[0], states),
    "paper-check": lambda problems, states, model: bench_paper_check(_posed(1)[0]),
    "planners": lambda problems, states, model: bench_planners(problems),
    "stages": lambda problems, states, model: bench_stages(problems),
    "networks": lambda problems, states, model: bench_networks(problems),
    "transformer": lambda problems, states, model: bench_transformer(problems, model),
    "sequences": lambda problems, states, model: bench_sequences(problems, model),
    "throughput": lambda problems, states, model: bench_throughput(problems),
    "growth": lambda problems, states, model: bench_growth(),
    "edge-model": lambda problems, states, model: bench_edge_model(problems),
    "calibration": lambda problems, states, model: bench_calibration(panda(), problems),
    "unconstrained": lambda problems, states, model: bench_unconstrained(problems),
    "scan": lambda problems, states, model: bench_scan(),
    "meshes": lambda problems, states, model: bench_meshes(),
}
"""What is measured, by name; of so many problems or scenes, and states, and of which model."""


def run_bench(name: str, problems: int, states: int, model: str | None = None) -> list[Figure]:
    """The figures of a bench, a fixed loop first, which compares machines and moments."""
    return [measured(CALIBRATION), *map(measured, BENCHES[name](problems, states, model))]
