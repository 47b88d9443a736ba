"""What `cvq-mpt` and `opt-cvq-mpt` sample on a problem: the mixture before and after the paper's
Algorithm 2.

The planner's own stages run: the transformer predicts codes from cloud, start and goals, the
decoder makes Gaussians of them, Algorithm 2 moves the codes. Gaussians around goals are part of
what is sampled and are not moved. Draws are taken as they come, before limits and projection, with
the same standard normal numbers before and after. All Gaussians of a mixture are equally likely, so
equally many draws of each are draws of the mixture.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from cvqmpt_lab.constraints.task_space_region import RegionConstraint
from cvqmpt_lab.errors import InvalidInputError, whole_number
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planners import planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.planner_interface import GaussianMixture, Observation, Query
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.vqmpt.learned_sampler import CodeProposal, model_of
from experiments.figures.drawing import write_csv

PLANNER, PUBLISHED = "opt-cvq-mpt", "cvq:published+algorithm-2"
ENOUGH = Budget(seconds=60.0)
BINS = 40
SHOWN = 0.99  # share of the draws that the bins cover
HISTOGRAM_FILE, VALUES_FILE = "histogram.csv", "values.csv"
COLOURS = {"before": "#8c96a3", "after": "#c8452d"}


@dataclass(frozen=True, kw_only=True)
class UpdateSettings:
    """How an update is measured."""

    seed: int = 0
    samples: int = 500  # draws of each Gaussian, before and after

    def __post_init__(self) -> None:
        whole_number("seed of the update", self.seed)
        whole_number("samples of the update", self.samples, 1)


@dataclass(frozen=True, eq=False)
class CodeUpdate:
    """A mixture of c codes and k goals before and after the update;
    F^T F in the constraint's units, squared.
    """

    problem: PlanningProblem  # with its goals
    cloud: np.ndarray  # what the model saw (m, 3) [m]
    codes: np.ndarray  # (c,), predicted: rows of the dictionary
    before: GaussianMixture  # of c codes, then of k goals
    after: GaussianMixture
    noise: np.ndarray  # (s, n), standard normal

    def draws(self, when: str, component: int) -> np.ndarray:
        """Configurations (s, n) [rad] of one Gaussian, before or after."""
        mixture: GaussianMixture = getattr(self, when)
        scale = np.linalg.cholesky(mixture.covariances[component])
        return mixture.means[component] + self.noise @ scale.T

    def g(self, when: str) -> np.ndarray:
        """F^T F at the draws of every Gaussian (c + k, s)."""
        every = range(len(self.before.means))
        return np.array(
            [squared_residual(self.problem.manifold, self.draws(when, i)) for i in every]
        )

    def rows(self) -> list[dict[str, object]]:
        """A row a Gaussian:
        F^T F at its mean, mean of F^T F of its draws, share of them where F is zero.
        """
        centres = {
            when: squared_residual(self.problem.manifold, getattr(self, when).means)
            for when in COLOURS
        }
        g = {when: self.g(when) for when in COLOURS}
        return [
            {
                "problem": self.problem.name,
                "code": int(self.codes[i]) if i < len(self.codes) else "goal",
                **{f"centre_{when}": float(centres[when][i]) for when in COLOURS},
                **{f"g_{when}": float(g[when][i].mean()) for when in COLOURS},
                **{f"satisfied_{when}": float((g[when][i] == 0.0).mean()) for when in COLOURS},
                "kept": int((self.before.means[i] == self.after.means[i]).all()),
            }
            for i in range(len(self.before.means))
        ]


def update_codes(
    problem: PlanningProblem, model: str | None, settings: UpdateSettings
) -> CodeUpdate:
    """Observe the scene, predict, update; model: as of `vqmpt.weights.resolve_model`.

    InvalidInputError: there is no goal, or no code was predicted.
    """
    problem, _ = with_sampled_goals(problem)
    if len(problem.goals) == 0:
        raise InvalidInputError(f"problem {problem.name}: no goal was found; choose another")
    planned, drawn = map(np.random.default_rng, np.random.SeedSequence(settings.seed).spawn(2))
    published = model is not None and model_of(model).config.kind == "published"
    stages = planner_named(PUBLISHED if published else PLANNER, model).stages(problem)
    assert stages.observe is not None and stages.update is not None
    cloud, query = (
        stages.observe(problem.scene),
        Query.of(ConstrainedSpace(problem), ENOUGH, planned),
    )
    proposal = stages.predict(query, Observation(cloud))
    assert isinstance(proposal, CodeProposal)
    before, after = proposal.distribution, stages.update(query, proposal).distribution
    if not isinstance(before, GaussianMixture) or not isinstance(after, GaussianMixture):
        raise InvalidInputError(
            f"problem {problem.name}: the model predicted no codes; choose another problem or model"
        )
    noise = drawn.standard_normal((settings.samples, problem.robot.dof))
    return CodeUpdate(problem, cloud, proposal.codes, before, after, noise)


def squared_residual(constraint: RegionConstraint, q: np.ndarray) -> np.ndarray:
    """F^T F (s,) of configurations (s, n) [rad]; zero where the constraint holds."""
    return np.square(constraint.residual(q)).sum(axis=1)


def histogram_rows(updates: Sequence[CodeUpdate]) -> list[dict[str, object]]:
    """Draws in even bins of |F(q)|, of the codes of all problems and of all that is sampled, goals
    included.
    """
    norms = {when: [np.sqrt(update.g(when)) for update in updates] for when in COLOURS}
    top = float(
        np.quantile(np.concatenate([n.ravel() for side in norms.values() for n in side]), SHOWN)
    )
    edges = np.append(np.linspace(0.0, top if top > 0.0 else 1.0, BINS + 1), np.inf)
    rows: list[dict[str, object]] = []
    for what in ("codes", "all"):
        counts = {
            when: np.histogram(
                np.concatenate(
                    [
                        n[: len(u.codes) if what == "codes" else None].ravel()
                        for n, u in zip(side, updates, strict=True)
                    ]
                ),
                edges,
            )[0]
            for when, side in norms.items()
        }
        rows += [
            {"of": what, "from": low, "to": high, "before": int(b), "after": int(a)}
            for (low, high), b, a in zip(pairwise(map(float, edges)), *counts.values(), strict=True)
        ]
    return rows


def write_tables(updates: Sequence[CodeUpdate], folder: Path) -> list[Path]:
    """Write the numbers of every Gaussian, and of the histogram; returns the files."""
    tables = {
        HISTOGRAM_FILE: histogram_rows(updates),
        VALUES_FILE: [row for update in updates for row in update.rows()],
    }
    return [write_csv(folder / name, rows) for name, rows in tables.items()]


def histogram_figure(updates: Sequence[CodeUpdate]) -> Figure:
    """Histogram of |F| of draws from codes; G of every code;
    G of everything that is sampled, a line a problem.
    """
    figure = Figure(figsize=(13.0, max(4.2, 0.6 + 0.16 * len(updates))), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    draw_norms(left, updates)
    rows = [row for update in updates for row in update.rows()]
    codes = np.array(
        [(row["g_before"], row["g_after"]) for row in rows if row["code"] != "goal"], dtype=float
    )
    lowest = max(codes.min(), 1e-6)
    span = (0.7 * lowest, 1.4 * codes.max())
    middle.plot(span, span, ":", color="0.5", label="not moved")
    middle.scatter(*codes.T, s=14.0, color=COLOURS["after"], alpha=0.7)
    middle.set(
        xscale="log", yscale="log", xlim=span, ylim=span, title=f"$G$ of {len(codes)} codes",
        xlabel="before [rad$^2$]", ylabel="after [rad$^2$]",
    )  # fmt: skip
    for axis in (middle.xaxis, middle.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    middle.legend(frameon=False)
    means = np.array([[update.g(when).mean() for when in COLOURS] for update in updates])
    y = np.arange(len(updates))
    right.hlines(y, means[:, 1], means[:, 0], color="0.8", linewidth=2.0)
    for column, (when, colour) in enumerate(COLOURS.items()):
        right.scatter(means[:, column], y, color=colour, s=30.0, label=when, zorder=3)
    right.set(
        yticks=y, yticklabels=[update.problem.name for update in updates], xlim=(0.0, None),
        title="$G$ of all that is sampled, goals included", xlabel="mean $F(q)^T F(q)$ "
                                                                   "[rad$^2$]", ylabel="problem",
    )  # fmt: skip
    right.invert_yaxis()
    right.legend(frameon=False)
    return figure


def draw_norms(axes: Axes, updates: Sequence[CodeUpdate]) -> None:
    """The histogram of |F| of draws from the codes' Gaussians of some problems;
    the last bin is left out.
    """
    rows = [row for row in histogram_rows(updates) if row["of"] == "codes"]
    edges = [float(str(row["from"])) for row in rows]
    for when, colour in COLOURS.items():
        counts = np.array([row[when] for row in rows], dtype=float)
        share = counts[:-1] / counts.sum()
        norms = np.concatenate([np.sqrt(u.g(when)[: len(u.codes)]).ravel() for u in updates])
        axes.stairs(share, edges, fill=True, color=colour, alpha=0.4)
        axes.stairs(share, edges, color=colour, label=f"{when}: median {np.median(norms):.2f}")
    axes.set(
        title="raw samples of the codes", xlabel="$\\|F(q)\\|$ [rad]", ylabel="share of samples"
    )
    axes.set_xlim(0.0, edges[-1])
    axes.legend(frameon=False)
