"""The solution of a planning problem, and its report."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from cvqmpt_lab.base.reports import Entry, Report
from cvqmpt_lab.base.values import bound_text
from cvqmpt_lab.certificate.certificate import Certificate
from cvqmpt_lab.constraints.report import BoundUse, bound_usage
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.anytime import Improvement
from cvqmpt_lab.search.planner_interface import SamplingDistribution
from cvqmpt_lab.search.result import JointPath, PlanResult, PlanStatus
from cvqmpt_lab.search.shortcut import Simplified


@dataclass(frozen=True)
class Solution:
    """The solution of a planning problem: path, certificate, times and counts."""

    problem: PlanningProblem
    plan: PlanResult
    simplified: Simplified | None = None  # the shortened path; None without a path
    certificate: Certificate | None = None  # certificate of the shortened path; None without a path
    goal_seconds: float = 0.0  # time of drawing goals [s]
    # time of rendering or reading the cloud [s], which counts for no planner
    observe_seconds: float = 0.0
    # time of the whole call up to the path, without goals and cloud [s]
    wall_seconds: float | None = None
    certificate_seconds: float | None = None  # time of certificates before `improvement` [s]
    # record of the optimization; `simplified` then has the best path
    improvement: Improvement | None = None
    # sampling distribution of the search; None if it used none
    distribution: SamplingDistribution | None = None
    left_out: tuple[str, ...] = ()  # goals of the problem that cannot be used, with the reasons
    # goals of the search (k, n): the given ones that can be used, or drawn ones [rad or m]
    goals: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    seed: int | None = None  # of the run that found the path; None: no search was needed
    seeds: int = 1  # number of runs in threads, with one seed after another

    def __repr__(self) -> str:
        outcome = self.verdict or "not solved"
        brief = self.report().only("note", "status", "left out", "length", "certificate")
        return "\n".join([f"Solution of {self.problem.name!r}: {outcome}", *brief.lines])

    @property
    def path(self) -> JointPath | None:
        """The shortened path, which `certificate` is about; None without a path."""
        return self.simplified.path if self.simplified else None

    @property
    def solved(self) -> bool:
        """Whether there is a certified path."""
        return self.certificate is not None and self.certificate.valid

    @property
    def verdict(self) -> str:
        """What is certified, and what of the constraint is not proven; "" if nothing is."""
        if self.certificate is None or not self.solved:
            return ""
        return "; ".join(filter(None, ("solved and certified", self.certificate.constraint_gap)))

    @property
    def status(self) -> str:
        """Status of the planning run; "refused" if the certificate refused its path."""
        refused = self.certificate is not None and not self.certificate.valid
        return "refused" if refused else str(self.plan.status)

    @property
    def bound_uses(self) -> tuple[BoundUse, ...]:
        """Used part of every bound of the constraint along the path, or at the start."""
        states = self.problem.start[None] if self.path is None else self.path.states
        return bound_usage(self.problem.robot, self.problem.regions, states)

    def report(
        self,
        planner: str = "",
        why: str = "",
        record: Callable[[], Mapping[str, Any] | None] = lambda: None,
    ) -> Report:
        """Return the report; its data have states and certificate.

        Args:
            planner: name of the planner.
            why: the reason if the planner was chosen by default.
            record: makes the record of the certificate for the data, see
                `features.motion.record.record_of`.
        """
        plan, shorter, counts = self.plan, self.simplified, self.plan.counted
        samples = f"samples: {plan.sampler}"
        chosen = f"{planner} ({why})" if why else planner
        times = f"goals {1e3 * self.goal_seconds:.1f} ms, plan {1e3 * plan.seconds:.1f} ms"
        if shorter is not None:
            times += f", simplify {1e3 * shorter.seconds:.1f} ms"
        lines = [
            (
                "problem",
                f"{self.problem.name}: robot {self.problem.robot.name}, {len(self.goals)} goals",
            ),
            *(("note", note) for note in self.problem.notes),
            *_left_out(self.left_out),
            ("constraint", _bounds(self)),
            *_functions(self.problem),
            ("planner", f"{chosen}, {samples}" if planner else samples),
            ("status", _status(self)),
            ("time", times),
        ]
        if self.seeds > 1:
            lines.append(("seed", f"{self.seed} of {self.seeds}: --seed {self.seed} repeats it"))
        if counts is not None:
            told = (
                f"{counts.projections} projections, {counts.newton_iterations} Newton "
                f"iterations, {counts.state_checks} state checks"
            )
            lines.append(("counts", told if plan.as_is else f"{told}, {plan.vertices} vertices"))
        if plan.path is not None and shorter is not None:
            lines.append(
                ("length", f"{plan.path.length:.2f} rad, simplified {shorter.path.length:.2f} rad")
            )
        if self.improvement is not None:
            lines.append(("optimize", _gain(self.improvement)))
        if self.certificate is not None:
            lines += _certificate(self.certificate)
        if pairs := self.problem.robot.uncompared:
            lines.append(("uncompared", pairs))
        return Report.of(lines, lambda: _data(self, planner, record(), why))


def _functions(problem: PlanningProblem) -> list[Entry]:
    """Return a line for each function of the user's own: how it is called, and its price."""
    prices = ((one, one.price(problem.start)) for one in problem.manifold.functions)
    return [("function", f"{one.describe()}: {price}") for one, price in prices if price]


def _left_out(goals: Sequence[str], listed: int = 2) -> list[Entry]:
    """Return lines for the first goals that were left out; the last one counts the others."""
    lines = [("left out", text) for text in goals[:listed]]
    more = len(goals) - listed
    if more > 0:
        label, text = lines[-1]
        lines[-1] = label, f"{text}; and {more} more"
    return lines


def _bounds(solution: Solution) -> str:
    """Return the used part of all bounds of the constraint in words."""
    if not solution.problem.constraint:
        return "none: the hand may tilt and move as it likes"
    functions = [function.describe() for function in solution.problem.manifold.functions]
    uses = solution.bound_uses
    if not uses:
        return "; ".join(functions) or "all entries free"
    where = " at the start" if solution.simplified is None else " at most"
    return "; ".join([*functions, *map(str, uses)]) + where


def _status(solution: Solution) -> str:
    """Return the status, and the method that found the path if the planner has another name."""
    plan, text = solution.plan, solution.status.replace("_", " ")
    if solution.status != plan.status:
        return f"{text} by the certificate"
    if plan.fallback:
        text += f" by {plan.fallback}"
    if plan.status in (PlanStatus.TIMEOUT, PlanStatus.ITERATION_LIMIT):
        iterations = plan.counters.iterations
        text += f": no path found within {plan.seconds:.3g} s and {iterations} iterations"
    if plan.status is PlanStatus.COST_LIMIT:
        text += f": no path found within the cost, after {plan.counters.iterations} iterations"
    if plan.path is not None and plan.detail.endswith("draws reached the constraint"):
        return text  # a reason for no path, see `birrt.GrowingTrees.warning`
    if plan.detail.startswith(text):
        return plan.detail
    return f"{text} ({plan.detail})" if plan.detail else text


def _gain(made: Improvement) -> str:
    """Return the used part of an optimization's budget, and the gain in length."""
    used, budget = f"{1e3 * made.seconds:.1f} ms", made.budget
    if budget.seconds is not None:
        used = f"{1e3 * made.seconds:.1f} of {1e3 * budget.seconds:g} ms"
    if budget.iterations is not None:
        used += f", {made.iterations} of {budget.iterations} iterations"
    (_, first), (_, last) = made.lengths[0], made.lengths[-1]
    gain = f"{first:.2f} to {last:.2f} rad ({made.gained:.0%} shorter)"
    return f"{used}: {made.searches} searches, {gain}"


def _certificate(certificate: Certificate) -> list[Entry]:
    """Return the lines of a certificate: verdict, smallest distances, tolerated deviation."""
    verdict, proven = "certified", ", motion between them proven,"
    if certificate.constraint_gap:
        proven = f", motion between them proven free; {certificate.constraint_gap};"
    if not certificate.valid:
        verdict, proven = f"not certified: {'; '.join(certificate.reasons)}", ","
    lines = [
        (
            "certificate",
            f"{verdict} ({certificate.states_checked} states{proven} clearance "
            f"{_distances(certificate)})",
        )
    ]
    if certificate.valid and certificate.tolerated:
        lines.append(("tolerates", str(certificate.tolerated)))
    return lines


def _distances(certificate: Certificate, small: float = 0.002) -> str:
    """Return the smallest distances to obstacles and between the robot's own links in words.

    Below `small` [m], the pair at the smallest distance to obstacles is named.
    """
    texts = []
    for what, clearance in (
        ("obstacles", certificate.obstacle_clearance),
        ("self", certificate.self_clearance),
    ):
        if clearance is None:
            continue
        text = f"{what} {1e3 * clearance.distance_m:.1f} mm"
        if not clearance.measured:
            least = bound_text(1e3 * clearance.at_least_m, up=False)
            proven = np.isfinite(clearance.at_least_m)
            text = f"{what} at least {least} mm" if proven else f"{what} unknown"
        elif what == "obstacles" and clearance.distance_m < small:
            text += f" (small: {clearance.pair})"
        texts.append(text)
    return ", ".join(texts) or "from nothing: no pair to compare"


def _data(
    solution: Solution, planner: str, certificate: Mapping[str, Any] | None, why: str
) -> dict[str, Any]:
    """Return a solution as plain data for json, with states and certificate.

    Args:
        solution: the solution.
        planner: name of the planner.
        certificate: record of the certificate, see `features.motion.record.record_of`.
        why: the reason if the planner was chosen by default.
    """
    plan, shorter, counts = solution.plan, solution.simplified, solution.plan.counted
    problem, more = solution.problem, solution.improvement
    return {
        "problem": problem.name,
        "robot": problem.robot.name,
        "joints": list(problem.robot.joint_names),
        "goals": len(solution.goals),
        "goals_left_out": list(solution.left_out),
        "pairs_left_out": [list(pair) for pair in problem.robot.left_out_pairs],
        "constraint": [vars(use) for use in solution.bound_uses],
        "planner": planner,
        "chosen_because": why,
        "sampler": plan.sampler,
        "seed": solution.seed,
        "status": solution.status,
        "fallback": plan.fallback,
        "detail": plan.detail,
        "solved": solution.solved,
        "seconds": {
            "goals": solution.goal_seconds,
            "observe": solution.observe_seconds,
            "encode": plan.timings.encode,
            "predict": plan.timings.predict,
            "optimize": plan.timings.optimize,
            "search": plan.search_seconds,
            "simplify": shorter.seconds if shorter else None,
        },
        "counts": counts and vars(counts) | {"vertices": None if plan.as_is else plan.vertices},
        "length_rad": shorter.path.length if shorter else None,
        "optimize": more and vars(more) | {"budget": asdict(more.budget), "gained": more.gained},
        "certificate": certificate,
        "path": shorter.path.states.tolist() if shorter else None,
    }
