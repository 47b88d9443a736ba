"""Experiments (problems, planners, seeds and settings), and profiles of all suites."""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from cvqmpt_lab.base.errors import InvalidInputError, located, require_choice, whole_number
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.results.row import FailReason, ResultRow, RowKey, cell_text
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.benchmarks.suite_parts import Suite
from cvqmpt_lab.experiments.executors import Limit
from cvqmpt_lab.external.names import is_external
from cvqmpt_lab.planning.planners import PLANNERS, planner_named, require_fit
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.anytime import check_units
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import BACKENDS
from cvqmpt_lab.vqmpt.sampler_choice import PREFIX
from cvqmpt_lab.vqmpt.weights import SHIPPED, resolve_model, weights_digest

# full: the committed results, five hours on two cores; paper: Tables I and II with the paper's
# planners, at most 20 minutes; small: a part of everything, 1 to 3 minutes
PROFILES = ("full", "paper", "small")


@dataclass(frozen=True)
class Experiment:
    """Problems x planners x seeds of one suite, under one budget."""

    # its name, or the full path of a folder of problem files, whose name is then the suite's
    suite: str
    problems: tuple[int | str, ...]
    planners: tuple[str, ...]
    seeds: tuple[int, ...]
    budget: Budget
    backend: str = "compiled"
    model: str | None = None  # weights in place of the shipped ones, of planners that use any
    # [rad] longest extension towards a draw, in place of every planner's own; inf: no limit; None:
    # that of the suite, which planners without trees do not have
    reach: float | None = None
    optimize: Budget | None = None  # spent on a better path once there is one

    def __post_init__(self) -> None:
        suite = suite_named(self.suite)
        for index in self.problems:
            if index not in suite.problems:
                suite.item(index)
        for name in self.planners:
            planner_named(name, reach=self.reach)
        # a planner that cannot serve a problem of a folder is refused before anything runs
        for run in self.runs if suite.digests else ():
            problem = suite.solvable(run.item)
            if isinstance(problem, PlanningProblem):
                with located(problem.name):
                    require_fit(run.method, problem)
        for seed in self.seeds:
            whole_number("seed", seed)
        for what, budget in (("budget", self.budget), ("optimize", self.optimize or self.budget)):
            Budget.require(budget, what)
        require_choice("backend", self.backend, BACKENDS)
        if self.optimize is not None:
            check_units(self.budget, self.optimize)
        for what in ("problems", "planners", "seeds"):
            if not getattr(self, what):
                raise InvalidInputError(f"an experiment needs at least one of {what}")

    @property
    def runs(self) -> "list[Run]":
        """All runs; planners of one problem follow each other."""
        every = product(self.seeds, self.problems, self.planners)
        return [Run(self, problem, planner, seed) for seed, problem, planner in every]

    @property
    def suite_reach(self) -> float | None:
        """The longest extension that the suite gives to planners with trees [rad]."""
        return suite_named(self.suite).reach

    @property
    def digests(self) -> dict[str, str]:
        """sha256 of a folder's problems by name; empty for other suites."""
        known = suite_named(self.suite).digests
        return {str(name): known[str(name)] for name in self.problems} if known else {}

    def settings(self) -> dict[str, object]:
        """Return the settings that change rows; they must be equal to continue a run."""
        return {
            "suite": suite_named(self.suite).name,
            "cutoff_s": self.budget.seconds,
            "iterations": self.budget.iterations,
            **_cost_settings(self.budget),
            "backend": self.backend,
            **({"optimize": _limits(self.optimize)} if self.optimize else {}),
            **({"reach_rad": str(reach)} if (reach := self.reach or self.suite_reach) else {}),
            **suite_named(self.suite).settings,
        }

    def limit(self, run: "Run") -> Limit:
        """Return when a run is given up: after far more processor time than any run needs.

        An external planner may hang; the first run of a process warms up all of ours.
        """
        spare, times = (120.0, 6) if run.method.external else (300.0, 30)
        longest = 0.0
        for budget in (self.budget, self.optimize):
            if budget is not None:
                # an iteration takes less than 0.01 s
                by_count = 0.01 * budget.iterations if budget.iterations else math.inf
                # our operations take less time than the prices say
                longest += min(budget.seconds or math.inf, by_count, budget.cost or math.inf)
        limit = Limit(spare + times * longest)
        # an external planner that waits is ended by its budget, and that counts as its failure
        return limit._replace(idle_s=limit.busy_s) if run.method.external else limit


def _limits(budget: Budget) -> dict[str, object]:
    """Return the limits of a budget by name."""
    plain = {"seconds": budget.seconds, "iterations": budget.iterations}
    return plain | _cost_settings(budget)


def _cost_settings(budget: Budget) -> dict[str, object]:
    """Return a budget's limit of cost and its prices; nothing where cost is not limited."""
    return {} if budget.cost is None else {"cost_s": budget.cost, "prices_s": asdict(budget.prices)}


class Run(NamedTuple):
    """One planner on one item of an experiment's suite with one seed."""

    experiment: Experiment
    item: int | str
    planner: str
    seed: int

    @property
    def method(self) -> Method:
        """Planner with its weights."""
        method = planner_named(self.planner, reach=self.experiment.reach)
        model, reach = self.experiment.model, self.experiment.suite_reach
        if reach is not None and self.experiment.reach is None and method.grows:
            method = method.with_reach(reach)
        return method if model is None or method.weights is None else method.with_model(model)

    @property
    def key(self) -> RowKey:
        """Key that the rows of the run have in common."""
        suite = Path(self.experiment.suite).name
        return suite, str(self.item), self.planner, self.seed, self.experiment.backend

    def row(self, problem: str, reason: FailReason | None, detail: str, **values: Any) -> ResultRow:
        """Return a row of this run; it is solved unless a reason is given."""
        suite, _, planner, seed, backend = self.key
        return ResultRow(
            suite=suite,
            problem=problem,
            planner=planner,
            seed=seed,
            backend=backend,
            solved=reason is None,
            fail_reason=reason,
            detail=cell_text(detail),
            **values,
        )


def models_of(planner: str) -> tuple[str, ...]:
    """Return the names of the models that a planner needs."""
    # an external planner needs none, and is perhaps not installed
    if is_external(planner.removeprefix(PREFIX)):
        return ()
    kind = planner_named(planner).weights
    return () if kind is None else (kind,)


def weights_of(planners: Iterable[str], model: str | None = None) -> dict[str, str]:
    """Return digests of the planners' models by name; model: see `Experiment.model`."""
    kinds = {kind for planner in planners for kind in models_of(planner)}
    return {
        kind: weights_digest(resolve_model(model or kind, SHIPPED[kind])) for kind in sorted(kinds)
    }


def externals_of(planners: Iterable[str]) -> dict[str, str]:
    """Return distributions and versions of external planners by the planner's name."""
    made_by = {name: planner_named(name).external for name in planners}
    return {name: text for name, text in made_by.items() if text}


class Part(NamedTuple):
    """An experiment of a profile."""

    folder: str  # folder of its results
    experiment: Experiment
    command: list[str]  # command that runs only this suite, without --out and --jobs


def planners_of(suite: Suite) -> tuple[str, ...]:
    """Return the default planners of a suite, or all that fit every problem of a folder."""
    if not suite.digests:
        return suite.planners
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
    """Return the experiments of a profile in order; UnknownChoiceError lists the profiles."""
    require_choice("profile", profile, PROFILES)
    chosen = [(name, amount) for name, suite in SUITES.items() for amount in suite.amounts]
    chosen = [(name, amount) for name, amount in chosen if amount.profile == profile]
    parts = []
    for name, amount in sorted(chosen, key=lambda each: each[1].late):
        suite = SUITES[name]
        budget = Budget(seconds=amount.cutoff)
        if amount.cost is not None:
            budget = Budget(cost=amount.cost)
        experiment = Experiment(
            suite=name,
            problems=tuple(suite.problems[: amount.problems]),
            planners=amount.planners or planners_of(suite),
            seeds=tuple(range(amount.seeds)),
            budget=budget,
        )
        command = ["cvqmpt", "reproduce", name, "--seeds", str(amount.seeds)]
        limit = ("--cutoff", amount.cutoff) if amount.cost is None else ("--cost", amount.cost)
        command += [limit[0], f"{limit[1]:g}"]
        command += [] if amount.problems is None else ["--problems", str(amount.problems)]
        command += [] if amount.planners is None else ["--planners", ",".join(amount.planners)]
        parts.append(Part(amount.folder or name, experiment, command))
    return parts
