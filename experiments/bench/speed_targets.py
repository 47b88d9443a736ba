"""Targets of speed, measured in two checkouts that take turns: an earlier commit, and this one.

``git worktree add --detach ../before 253fbaf0``, then
``python -m cvqmpt_lab.experiments.bench.speed_targets ../before 20`` prints one table from 20
problems of each suite. Words after the number choose parts of it, see PARTS. Times are processor
times; limits of seconds are, too, so that other processes on the machine change little. Both
checkouts compute with the same instructions, see `base.arithmetic`.
"""

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, NamedTuple

HERE = Path(__file__).parents[3]
FOLDER = "SPEED_TARGETS_PROBLEMS"  # environment variable: folder of the problems' files
NOW, BEFORE = 0, 1


# What a child process answers; it runs in both checkouts, so it imports only what both have.


@cache
def problem(kind: str, index: int) -> Any:
    """Return a problem with goals, or None; the file that the first checkout has written."""
    from cvqmpt_lab import suite_named
    from cvqmpt_lab.benchmarks.passages import cage_problem
    from cvqmpt_lab.planning.pipeline import with_drawn_goals
    from cvqmpt_lab.problem import PlanningProblem

    file = Path(os.environ[FOLDER]) / f"{kind}-{index}.json"
    if not file.is_file():
        made: Any
        made = cage_problem(float(kind[5:]), index) if kind.startswith("cage-") else None
        made = suite_named(kind).item(index) if made is None else made
        if not hasattr(made, "reason") and not len(made.goals):
            made = with_drawn_goals(made)
        usable = not hasattr(made, "reason") and len(made.goals)
        file.write_text(json.dumps(made.to_dict() if usable else None), encoding="utf-8")
    data = json.loads(file.read_text(encoding="utf-8"))
    return data and PlanningProblem.from_dict(data)


def posed(kind: str, index: int) -> bool:
    """Write a problem to a file, for both checkouts; return whether it has goals."""
    return problem(kind, index) is not None


def searched(kind: str, index: int, planner: str, seed: int, **budget: Any) -> Any:
    """Return whether a search found a path, its processor time [s] and its work."""
    import numpy as np

    from cvqmpt_lab import Budget
    from cvqmpt_lab.planning.planners import planner_named
    from cvqmpt_lab.search import planner_interface as interface
    from cvqmpt_lab.search.birrt import BiRRT
    from cvqmpt_lab.search.space import ConstrainedSpace

    given = problem(kind, index)
    if given is None:
        return None
    vars(interface)["time"] = SimpleNamespace(perf_counter=time.process_time)
    stages, space = planner_named(planner).stages(given), ConstrainedSpace.of(given)
    rng, limit = np.random.default_rng([seed, index]), Budget(**budget)
    query = interface.Query.of(space, given.start, given.goals, limit, rng, seed)
    proposal = stages.predict(query, interface.Observation(None))
    began = time.process_time()
    found = interface.search(stages.search or BiRRT(), query, proposal, 0)
    return found.path is not None, time.process_time() - began, space.counters.work


def planned(kind: str, index: int, repeats: int) -> Any:
    """Return the least processor time of a whole plan with `roadmap`, goals to certificate [s]."""
    from cvqmpt_lab import Budget, solve

    given, least = problem(kind, index), math.inf
    for _ in range(repeats if given is not None else 0):
        began = time.process_time()
        solve(given, "roadmap", Budget(iterations=20_000), seed=0)
        least = min(least, time.process_time() - began)
    return least


def checked(kind: str, index: int, repeats: int) -> float:
    """Return the least processor time of 20 000 state checks near the start [s]."""
    import numpy as np

    from cvqmpt_lab.search.space import ConstrainedSpace

    given = problem(kind, index)
    space = ConstrainedSpace.of(given)
    near = given.start + 0.5 * np.random.default_rng(0).standard_normal((20_000, len(given.start)))
    times = []
    for _ in range(repeats):
        began = time.process_time()
        space.valid_batch(near)
        times.append(time.process_time() - began)
    return min(times)


def judged(kind: str, index: int, count: int) -> list[bool]:
    """Return the verdicts of the proof on motions of 0.05 to 1 rad from free states."""
    import numpy as np

    from cvqmpt_lab.search.motion import motion_free
    from cvqmpt_lab.search.space import ConstrainedSpace

    given = problem(kind, index)
    if given is None:
        return []
    space, rng = ConstrainedSpace.of(given), np.random.default_rng(index)
    states = given.start + 0.5 * rng.standard_normal((20 * count, len(given.start)))
    free = states[space.valid_batch(states)][:count]
    ways = rng.standard_normal(free.shape)
    ways *= 0.05 * 20.0 ** rng.random((len(free), 1)) / np.linalg.norm(ways, axis=1)[:, None]
    return [bool(motion_free(space.arrays, a, a + way)) for a, way in zip(free, ways, strict=True)]


def large(points: bool) -> dict[str, float]:
    """Return processor times of making 10 000 boxes or 10^6 points, and spaces of them [s]."""
    import numpy as np

    from cvqmpt_lab.base.poses import pose
    from cvqmpt_lab.problem import PlanningProblem
    from cvqmpt_lab.robot.load import robot_from_source
    from cvqmpt_lab.scene.scene import Scene, SceneObject
    from cvqmpt_lab.scene.shapes import Box, PointCloud
    from cvqmpt_lab.search.space import ConstrainedSpace

    rng, robot = np.random.default_rng(0), robot_from_source({"name": "panda"})
    centres = rng.uniform((0.3, -0.8, 0.0), (0.9, 0.8, 0.9), (10**6 if points else 10_000, 3))
    middle = 0.5 * (robot.lower + robot.upper)

    def objects() -> list[SceneObject]:
        if points:
            return [SceneObject("cloud", PointCloud(centres.copy(), 0.005), np.eye(4))]
        box = Box((0.006,) * 3)
        return [SceneObject(f"box_{k}", box, pose(at)) for k, at in enumerate(centres)]

    def space(made: list[SceneObject]) -> None:
        scene = Scene("large", tuple(made))
        ConstrainedSpace.of(PlanningProblem("large", robot, scene, middle, middle[None]))

    marks = [time.process_time()]
    made, equal = objects(), None
    marks.append(time.process_time())
    space(made)
    marks.append(time.process_time())
    equal = objects()
    skipped = time.process_time() - marks[-1]
    space(equal)
    marks.append(time.process_time() - skipped)
    parts = [after - before for before, after in pairwise(marks)]
    return dict(zip(("objects", "space", "equal"), parts, strict=True))


def commanded(*words: str, empty: bool = False) -> float:
    """Return the processor time of a command of this checkout [s]; empty: without machine code."""
    with TemporaryDirectory() as folder:
        more = {"NUMBA_CACHE_DIR": folder} if empty else {}
        words = tuple(word.format(folder=folder) for word in words)
        before = os.times()
        subprocess.run(
            [sys.executable, "-m", "cvqmpt_lab", *words],
            env=os.environ | more,
            check=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        after = os.times()
    return after.children_user + after.children_system - sum(before[2:4])


JOBS: dict[str, Callable[..., Any]] = {
    job.__name__: job for job in (posed, searched, planned, checked, judged, large, commanded)
}


def answer() -> None:
    """Answer questions (name of a job, arguments, options) until the input ends."""
    for line in sys.stdin:
        name, words, options = json.loads(line)
        print(json.dumps(JOBS[name](*words, **options)), flush=True)


# The parent process, which asks both checkouts in turns.


class Checkout:
    """A process that answers from the sources of a checkout."""

    def __init__(self, folder: Path) -> None:
        source = Path(__file__).read_text(encoding="utf-8")
        from cvqmpt_lab.base.arithmetic import PINNED

        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"__file__ = {__file__!r}\n{source}", "answer"],
            cwd=folder,
            env=os.environ | PINNED | threads | {"PYTHONPATH": str(folder.resolve())},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )

    def __call__(self, name: str, *words: Any, **options: Any) -> Any:
        """Return the answer of a job."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps((name, words, options)) + "\n")
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"{name}{words} failed; its error is above")
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        self._process.kill()


class Target(NamedTuple):
    """A row of the table."""

    name: str
    before: float
    now: float
    most: float  # target of the ratio now / before; negative: the least ratio

    def line(self) -> str:
        """Return the row."""
        ratio = self.now / self.before if self.before else math.nan
        met = ratio >= -self.most if self.most < 0 else ratio <= self.most
        limit = f">= {-self.most:g}" if self.most < 0 else f"<= {self.most:g}"
        reached = "met" if met else "missed"
        values = f"{self.before:.4g} | {self.now:.4g} | {ratio:.2f}"
        return f"| {self.name} | {values} | {limit} | {reached} |"


ON_PROBLEMS = ("searched", "planned", "checked", "judged")  # jobs with a suite and an index
Both = tuple[Checkout, Checkout]  # NOW and BEFORE


def both(checkouts: Both, cases: Sequence[tuple[Any, ...]], **options: Any) -> Iterator[list[Any]]:
    """Yield the answers of both checkouts to each case; they take turns in being first."""
    for number, case in enumerate(cases):
        if case[0] in ON_PROBLEMS:
            checkouts[NOW]("posed", *case[1:3])
        found: list[Any] = [None, None]
        for side in (NOW, BEFORE) if number % 2 else (BEFORE, NOW):
            found[side] = checkouts[side](*case, **options)
        if found[NOW] is not None:
            yield found


def ratio(values: Sequence[tuple[float, float]]) -> float:
    """Return the geometric mean of now / before."""
    return math.exp(fmean(math.log(now / before) for now, before in values))


def mazes(checkouts: Both, count: int) -> Iterator[Target]:
    """What is solved in mazes within 2 s, and in the largest within 5 s."""
    for planner in ("birrt", "roadmap"):
        cases = [("searched", "maze", k, planner, 0) for k in range(count)]
        found = list(both(checkouts, cases, seconds=2.0))
        solved = [sum(run[side][0] for run in found) for side in (NOW, BEFORE)]
        title = f"mazes 0 to {count - 1}, `{planner}`"
        least = -1.4 if planner == "birrt" else -1.0
        yield Target(f"{title}: solved in 2 s", solved[BEFORE], solved[NOW], least)
        for part, name, most in ((1, "time [s]", 0.65), (2, "work", 0.6)):
            if planner == "roadmap":
                # a run without a path counts as longer than all others
                middle = [
                    median(run[side][part] if run[side][0] else math.inf for run in found)
                    for side in (NOW, BEFORE)
                ]
                yield Target(f"{title}: median {name}", middle[BEFORE], middle[NOW], most)
    cases = [("searched", "maze", k, "roadmap", 0) for k in range(2, count, 3)]
    found = list(both(checkouts, cases, seconds=5.0))
    share = [fmean(run[side][0] for run in found) for side in (NOW, BEFORE)]
    yield Target("mazes of 5 x 12 cells, `roadmap`: share solved in 5 s", 1.0, share[NOW], -0.97)


def cages(checkouts: Both, count: int) -> Iterator[Target]:
    """Cages that no choice used: `roadmap` in the column of now, `birrt` of now in the other."""
    cases = [(f"cage-{gap}", 80 + k) for k in range(count) for gap in (0.21, 0.22)]
    runs = {
        name: [
            checkouts[NOW]("searched", *case, name, seed, seconds=3.0)
            for case in cases
            for seed in (0, 1)
        ]
        for name in ("birrt", "roadmap")
    }
    solved = {name: sum(run[0] for run in one if run) for name, one in runs.items()}
    middle = {
        name: median(run[1] if run[0] else math.inf for run in one if run)
        for name, one in runs.items()
    }
    yield Target("cages: solved, `roadmap` to `birrt`", solved["birrt"], solved["roadmap"], -0.95)
    yield Target("cages: median time [s], the same", middle["birrt"], middle["roadmap"], 1.2)


def counts(checkouts: Both, count: int) -> Iterator[Target]:
    """Work and time of problems that both solve."""
    for kind in ("place-task", "line", "plane", "family-cage"):
        for planner in ("birrt", "roadmap"):
            cases = [("searched", kind, k, planner, 0) for k in range(count)]
            found = list(both(checkouts, cases, iterations=8_000))
            solved = [(now[2], before[2]) for now, before in found if now[0] and before[0]]
            yield Target(f"{kind}, `{planner}`: work", 1.0, ratio(solved), 1.02)
            times = [(now[1], before[1]) for now, before in found if now[0] and before[0]]
            yield Target(f"{kind}, `{planner}`: time", 1.0, ratio(times), 1.02)


def units(checkouts: Both, count: int) -> Iterator[Target]:
    """A state check, and the search on lines."""
    found = list(both(checkouts, [("checked", "place-task", 0, 9)] * 3))
    least = [1e6 * min(run[side] for run in found) / 20_000 for side in (NOW, BEFORE)]
    yield Target("state check [us]", least[BEFORE], least[NOW], 0.88)
    cases = [("searched", "line", k, "birrt", seed) for k in range(count) for seed in (0, 1, 2)]
    runs = both(checkouts, cases, iterations=2_000)
    # time per unit of work: the path of the search may differ
    pairs = [(now[1] / now[2], before[1] / before[2]) for now, before in runs]
    yield Target("lines, `birrt`: time per unit of work", 1.0, ratio(pairs), 0.93)


def easy(checkouts: Both, count: int) -> Iterator[Target]:
    """Whole plans on lines."""
    found = list(both(checkouts, [("planned", "line", k, 3) for k in range(count)]))
    middle = [1e3 * median(run[side] for run in found) for side in (NOW, BEFORE)]
    yield Target("lines: median whole plan [ms]", middle[BEFORE], middle[NOW], 0.85)


def scale(checkouts: Both, count: int) -> Iterator[Target]:
    """Ten thousand boxes and a million points."""
    repeats = min(count, 5)
    for points, parts in (
        (False, {"objects": 0.35, "space": 0.7, "equal": 0.1}),
        (True, {"space": 0.6}),
    ):
        found = list(both(checkouts, [("large", points)] * repeats))
        for part, most in parts.items():
            least = [1e3 * min(run[side][part] for run in found) for side in (NOW, BEFORE)]
            title = "10^6 points" if points else "10 000 boxes"
            yield Target(f"{title}: {part} [ms]", least[BEFORE], least[NOW], most)


def commands(checkouts: Both, count: int) -> Iterator[Target]:
    """A timed motion, and the first compilation."""
    words = ("plan", "place-task", "--problem", "0", "--trajectory", "{folder}/motion.json")
    found = list(both(checkouts, [("commanded", *words)] * min(count, 5)))
    least = [min(run[side] for run in found) for side in (NOW, BEFORE)]
    yield Target("`plan --trajectory` [s]", least[BEFORE], least[NOW], 0.65)


def compiling(checkouts: Both, count: int) -> Iterator[Target]:
    """The first compilation."""
    now, before = next(both(checkouts, [("commanded", "warmup")], empty=True))
    yield Target("first compilation [s]", before, now, 75 / 138)


def proofs(checkouts: Both, count: int) -> Iterator[Target]:
    """Verdicts on 1 000 motions of each problem."""
    kinds = ("place-task", "line", "plane", "maze", "family-cage")
    cases = [("judged", kind, k, 1000) for kind in kinds for k in range(math.ceil(count / 5))]
    found = list(both(checkouts, cases))
    motions = [pair for now, before in found for pair in zip(now, before, strict=True)]
    same = sum(now == before for now, before in motions)
    blocked = sum(not now for now, _ in motions)
    yield Target(f"motions with the same verdict ({blocked} blocked)", len(motions), same, -1.0)


def seeds(checkouts: Both, count: int) -> Iterator[Target]:
    """The better of two seeds over their mean: what two idle cores give on hard problems."""
    for kind, indices in (("maze", range(count)), ("line", range(4, min(6 * count, 100), 6))):
        pairs = [
            [checkouts[NOW]("searched", kind, k, "roadmap", seed, seconds=5.0) for seed in (0, 1)]
            for k in indices
        ]
        times = [[run[1] for run in pair] for pair in pairs if pair[0]]
        mean = [fmean(map(fmean, times)), fmean(map(min, times))]
        title = f"{kind}: mean time [s], one seed and the better of two"
        yield Target(title, mean[0], mean[1], 0.6)


PARTS = {
    part.__name__: part
    for part in (mazes, cages, counts, units, easy, scale, commands, compiling, proofs, seeds)
}


def main() -> None:
    """Measure and print."""
    folder, count, *names = Path(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:]
    problems = TemporaryDirectory()
    os.environ[FOLDER] = problems.name
    checkouts = Checkout(HERE), Checkout(folder)
    for checkout in checkouts:
        checkout("commanded", "warmup")
    print("| quantity | before | now | ratio | target | |\n|---|---|---|---|---|---|", flush=True)
    for name in names or PARTS:
        for target in PARTS[name](checkouts, count):
            print(target.line(), flush=True)
    for checkout in checkouts:
        checkout.close()


if __name__ == "__main__":
    answer() if sys.argv[1:] == ["answer"] else main()
