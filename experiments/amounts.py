"""How much is run: planners of a suite where none are named, and the profiles of all suites."""

from typing import NamedTuple

from cvqmpt_lab.benchmarks.suite import Suite, suite_named
from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.planners import PLANNERS
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import Budget
from experiments.experiment import Experiment
from paper_tables.suites import SUITES, Amount

# what is committed, two hours on two cores, and a little of it, three minutes
PROFILES = ("full", "small")


class Part(NamedTuple):
    """An experiment of a profile."""

    folder: str  # of its results
    experiment: Experiment
    command: list[str]  # that runs it alone, without --out and --jobs


def planners_of(suite: Suite) -> tuple[str, ...]:
    """What runs on a suite unless others are named; on a folder those that can serve all of it."""
    if not suite.digests:
        return SUITES[suite.name].planners
    problems = [suite.solvable(name) for name in suite.problems]
    return tuple(
        name
        for name, method in PLANNERS.items()
        if not any(
            isinstance(problem, PlanningProblem) and method.incompatibility(problem)
            for problem in problems
        )
    )


def parts_of(profile: str) -> list[Part]:
    """What a profile runs, in order; UnknownChoiceError lists the profiles."""
    if profile not in PROFILES:
        raise UnknownChoiceError("profile", profile, PROFILES)
    chosen = [
        (name, amount)
        for name, suite in SUITES.items()
        for amount in suite.amounts
        if amount.profile == profile
    ]
    return [_part(*each) for each in sorted(chosen, key=lambda each: each[1].late)]


def _part(name: str, amount: Amount) -> Part:
    suite = suite_named(name)
    experiment = Experiment(
        suite=name,
        problems=tuple(suite.problems[: amount.problems]),
        planners=amount.planners or planners_of(suite),
        seeds=tuple(range(amount.seeds)),
        budget=Budget(seconds=amount.cutoff),
    )
    command = ["cvqmpt", "reproduce", name]
    command += ["--seeds", str(amount.seeds), "--cutoff", f"{amount.cutoff:g}"]
    if amount.problems is not None:
        command += ["--problems", str(amount.problems)]
    if amount.planners is not None:
        command += ["--planners", ",".join(amount.planners)]
    return Part(amount.folder or name, experiment, command)
