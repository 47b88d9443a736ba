"""The Gaussians of the codes that `cvq-mpt` predicts for one problem, before and after the paper's Algorithm 2.

They are not widened as planners widen them; draws use the same standard normal numbers before and after. The paper's
figure shows two codes predicted for the place task, one far from the constraint and one near it: histograms of F^T F,
and Markov's bound P(F^T F >= k) <= G / k with the mean G.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cvqmpt_lab.constraints.task_space_region import RegionConstraint
from cvqmpt_lab.errors import InvalidInputError, whole_number
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planners import planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.query import Observation, Query
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.vqmpt.latent_update import LatentOptimizer, LatentSettings
from cvqmpt_lab.vqmpt.learned_sampler import CodeProposal
from cvqmpt_lab.vqmpt.stages import STEPS, codebook_of, model_of
from experiments.figures.drawing import write_csv

PLANNER = "cvq-mpt"
ENOUGH = Budget(seconds=60.0)
FAR, NEAR = "far", "near"
RANKS: Mapping[str, float] = {FAR: 0.9, NEAR: 0.1}  # of the two codes among all predicted, in [0, 1]
BINS = 40
SHOWN = 0.99  # share of the draws that the even bins cover; what lies beyond is one last wide bin
# of F^T F, at which the tail is measured and bounded
THRESHOLDS = tuple(float(f"{k:.3g}") for k in np.geomspace(1e-3, 10.0, 25))
HISTOGRAM_FILE, VALUES_FILE, MARKOV_FILE = "histogram.csv", "values.csv", "markov.csv"
COLOURS = {"before": "#8c96a3", "after": "#1f6fb4"}


@dataclass(frozen=True, kw_only=True)
class UpdateSettings:
    """How an update is measured."""

    seed: int = 0
    samples: int = 2000  # draws of each code's Gaussian, before and after

    def __post_init__(self) -> None:
        whole_number("seed of the update", self.seed)
        whole_number("samples of the update", self.samples, 1)


class Gaussians(NamedTuple):
    """Gaussians of c codes."""

    means: np.ndarray  # (c, n) [rad]
    scales: np.ndarray  # (c, n, n) [rad], lower triangular: q = mean + scale @ noise

    def draws(self, code: int, noise: np.ndarray) -> np.ndarray:
        """Configurations (s, n) [rad] of one code from standard normal noise (s, n)."""
        return self.means[code] + noise @ self.scales[code].T


@dataclass(frozen=True, eq=False)
class CodeUpdate:
    """What a model says of c codes before and after the update; F^T F in the constraint's units, squared."""

    problem: PlanningProblem  # with its goals
    cloud: np.ndarray  # what the model saw (m, 3) [m]
    codes: np.ndarray  # (c,), predicted: rows of the dictionary
    before: Gaussians
    after: Gaussians
    noise: np.ndarray  # (s, n), standard normal
    centre_before: np.ndarray  # F^T F at the means (c,)
    centre_after: np.ndarray
    g_before: np.ndarray  # F^T F at the draws that noise makes (c, s)
    g_after: np.ndarray

    @property
    def kept(self) -> np.ndarray:
        """(c,) bool, codes that stayed where they were."""
        return (self.before.means == self.after.means).all(axis=1)

    def representatives(self) -> dict[str, int]:
        """A code far from the constraint and one near it, by their means' ranks (`RANKS`)."""
        order = np.argsort(self.centre_before, kind="stable")
        return {name: int(order[round(rank * (len(order) - 1))]) for name, rank in RANKS.items()}


def update_codes(problem: PlanningProblem, model: str | None, settings: UpdateSettings) -> CodeUpdate:
    """Observe the scene, predict, update, draw; model: as of `vqmpt.weights.resolve_model`.

    InvalidInputError: there is no goal, or too few codes to compare two.
    """
    problem, _ = with_sampled_goals(problem)
    if len(problem.goals) == 0:
        raise InvalidInputError(f"problem {problem.name}: no goal was found; choose another")
    planned, drawn = map(np.random.default_rng, np.random.SeedSequence(settings.seed).spawn(2))
    published = model is not None and model_of(model).config.kind == "published"
    method = planner_named("cvq-published" if published else PLANNER, model)
    stages = method.stages(problem)
    assert stages.observe is not None and method.weights is not None
    cloud, query = stages.observe(problem.scene), Query.of(ConstrainedSpace(problem), ENOUGH, planned)
    proposal = stages.predict(query, Observation(cloud))
    assert isinstance(proposal, CodeProposal)
    codes = proposal.codes
    if len(codes) < len(RANKS):
        raise InvalidInputError(
            f"problem {problem.name}: the model predicted {len(codes)} codes, {len(RANKS)} are compared; "
            "choose another problem or model"
        )
    codebook, constraint = codebook_of(method.model or method.weights, problem.robot), problem.manifold
    z = codebook.vectors[codes]
    moved = LatentOptimizer(codebook, LatentSettings(steps=STEPS)).optimize(z, constraint, planned)
    noise = drawn.standard_normal((settings.samples, problem.robot.dof))
    sides = []
    for means, covariances in map(codebook.gaussians, (z, moved.z)):
        side = Gaussians(means, np.linalg.cholesky(covariances))
        g = [squared_residual(constraint, side.draws(k, noise)) for k in range(len(codes))]
        sides.append((side, squared_residual(constraint, means), np.array(g)))
    (before, centre_before, g_before), (after, centre_after, g_after) = sides
    return CodeUpdate(
        problem=problem,
        cloud=cloud,
        codes=codes,
        before=before,
        after=after,
        noise=noise,
        centre_before=centre_before,
        centre_after=centre_after,
        g_before=g_before,
        g_after=g_after,
    )


def squared_residual(constraint: RegionConstraint, q: np.ndarray) -> np.ndarray:
    """F^T F (s,) of configurations (s, n) [rad]; zero where the constraint holds."""
    return np.square(constraint.residual(q)).sum(axis=1)


class Histogram(NamedTuple):
    """Counts of two samples in the same bins."""

    edges: np.ndarray  # (b + 1,)
    before: np.ndarray  # (b,)
    after: np.ndarray  # (b,)
    beyond: int  # wide bins at the end, 0 or 1

    @classmethod
    def of(cls, before: np.ndarray, after: np.ndarray, bins: int = BINS) -> "Histogram":
        """Even bins from 0 for most values, and one for the rest; InvalidInputError for negative or infinite values."""
        both = np.concatenate((before, after))
        if bins < 1 or len(both) == 0 or not (np.isfinite(both).all() and (both >= 0.0).all()):
            raise InvalidInputError(
                f"histogram of {len(both)} values in {bins} bins: give 1 bin or more, and finite values from 0"
            )
        top, most = float(both.max(initial=0.0)), float(np.quantile(both, SHOWN))
        edges = np.linspace(0.0, most if most > 0.0 else top if top > 0.0 else 1.0, bins + 1)
        if top > edges[-1]:
            edges = np.append(edges, top)
        counts = [np.histogram(values, edges)[0] for values in (before, after)]
        beyond = np.count_nonzero(np.diff(edges) > (1.0 + 1e-6) * edges[1])
        return cls(edges, counts[0], counts[1], int(beyond))


class MarkovTail(NamedTuple):
    """Share of draws of a value >= 0 that reach k, and Markov's bound mean / k with the mean of the same draws."""

    mean: float
    k: np.ndarray  # (t,)
    tail: np.ndarray  # (t,)
    bound: np.ndarray  # (t,), mean / k

    @classmethod
    def of(cls, values: np.ndarray, thresholds: Sequence[float] = THRESHOLDS) -> "MarkovTail":
        """Measure values (s,) at thresholds > 0."""
        k = np.asarray(thresholds, dtype=float)
        if len(values) == 0 or not (k > 0.0).all():
            raise InvalidInputError(
                f"Markov bound of {len(values)} values at {thresholds}: give values, and thresholds above 0"
            )
        return cls(float(values.mean()), k, (values[:, None] >= k).mean(axis=0), values.mean() / k)


class CodeChange(NamedTuple):
    """What the figure shows of one code."""

    code: int
    role: str
    histogram: Histogram
    tails: dict[str, MarkovTail]  # before and after


def code_changes(update: CodeUpdate) -> list[CodeChange]:
    """The far and the near code."""
    changes = []
    for role, index in update.representatives().items():
        before, after = update.g_before[index], update.g_after[index]
        tails = {"before": MarkovTail.of(before), "after": MarkovTail.of(after)}
        changes.append(CodeChange(int(update.codes[index]), role, Histogram.of(before, after), tails))
    return changes


def write_tables(update: CodeUpdate, changes: Sequence[CodeChange], folder: Path) -> list[Path]:
    """Write the numbers of the figure and those of every predicted code; returns the files."""
    counted = [
        {"code": code, "role": role, "from": float(low), "to": float(high), "before": int(b), "after": int(a)}
        for code, role, found, _ in changes
        for (low, high), b, a in zip(pairwise(found.edges), found.before, found.after, strict=True)
    ]
    bounded = [
        {"code": code, "role": role, "when": when, "k": float(k), "tail": float(tail), "bound": float(bound)}
        for code, role, _, tails in changes
        for when, markov in tails.items()
        for k, tail, bound in zip(markov.k, markov.tail, markov.bound, strict=True)
    ]
    tables = {HISTOGRAM_FILE: counted, VALUES_FILE: value_rows(update), MARKOV_FILE: bounded}
    return [write_csv(folder / name, rows) for name, rows in tables.items()]


def value_rows(update: CodeUpdate) -> list[dict[str, object]]:
    """A row for every predicted code: F^T F at its mean, mean of F^T F of draws, share of these where F is zero."""
    roles = {index: role for role, index in update.representatives().items()}
    return [
        {
            "code": int(update.codes[i]),
            "role": roles.get(i, ""),
            "centre_before": float(update.centre_before[i]),
            "centre_after": float(update.centre_after[i]),
            "g_before": float(before.mean()),
            "g_after": float(after.mean()),
            "satisfied_before": float((before == 0.0).mean()),
            "satisfied_after": float((after == 0.0).mean()),
            "kept": int(update.kept[i]),
        }
        for i, (before, after) in enumerate(zip(update.g_before, update.g_after, strict=True))
    ]


def histogram_figure(changes: Sequence[CodeChange]) -> Figure:
    """A row for each code: histogram of F^T F, and its tail below the Markov bound."""
    figure = Figure(figsize=(9.0, 3.1 * len(changes)), layout="constrained")
    rows = figure.subplots(len(changes), 2, squeeze=False)
    for (left, right), change in zip(rows, changes, strict=True):
        _draw_histogram(left, change)
        _draw_tails(right, change.tails)
    return figure


def _draw_histogram(axes: Axes, change: CodeChange) -> None:
    edges = change.histogram.edges
    shown = len(edges) - 1 - change.histogram.beyond
    for when, colour in COLOURS.items():
        counts, mean = getattr(change.histogram, when), change.tails[when].mean
        share, label = counts[:shown] / counts.sum(), f"{when}: mean {mean:#.3g}"
        axes.stairs(share, edges[: shown + 1], fill=True, color=colour, alpha=0.45)
        axes.stairs(share, edges[: shown + 1], color=colour, linewidth=1.4, label=label)
        axes.axvline(mean, color=colour, linestyle=":", linewidth=1.4)
    place = {FAR: "far from the constraint", NEAR: "near the constraint"}[change.role]
    axes.set(
        title=f"{place}: code {change.code}",
        xlabel="$F(q)^T F(q)$ [rad$^2$]",
        ylabel="share of draws",
        xlim=(0.0, edges[shown]),
    )
    axes.legend(frameon=False)


def _draw_tails(axes: Axes, tails: Mapping[str, MarkovTail]) -> None:
    for when, markov in tails.items():
        k, colour = np.geomspace(markov.k[0], markov.k[-1], 400), COLOURS[when]
        axes.plot(k, np.minimum(markov.mean / k, 1.0), "--", color=colour, label=f"{when}: bound $G/k$")
        axes.plot(markov.k, markov.tail, ".-", color=colour, label=f"{when}: measured")
    axes.set(
        xscale="log",
        title="tail and its Markov bound",
        xlabel="$k$ [rad$^2$]",
        ylabel="$P(F^T F \\geq k)$",
        ylim=(0.0, 1.05),
    )
    axes.legend(frameon=False, fontsize="small", loc="lower left")
