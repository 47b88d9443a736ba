"""Histograms of F^T F before and after the update of codes, and how tight the Markov bound on its tail is.

The paper's figure shows two dictionary values predicted for the place task, one far from the constraint and
one near it; its equation `markov` bounds the share of draws with F^T F >= k by G / k, G their mean.
"""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import write_text
from experiments.figures.code_update import CodeUpdate

BINS = 40
SHOWN = 0.99
"""Share of the draws, before and after, that the even bins cover; what lies beyond is one last wide bin."""
THRESHOLDS = tuple(float(f"{k:.3g}") for k in np.geomspace(1e-3, 10.0, 25))
"""At which the tail is measured and bounded [the constraint's units, squared]."""

HISTOGRAM_FILE, VALUES_FILE, MARKOV_FILE = "histogram.csv", "values.csv", "markov.csv"


@dataclass(frozen=True, eq=False)
class Histogram:
    """Counts of two samples in the same bins: edges (b + 1,), before, after (b,)."""

    edges: np.ndarray
    before: np.ndarray
    after: np.ndarray

    @classmethod
    def of(cls, before: np.ndarray, after: np.ndarray, bins: int = BINS) -> "Histogram":
        """Bin values of 0 or more: even bins from 0 for most, and one for the rest; every value is counted.

        Raises
        ------
        InvalidInputError
            For values that are negative or not finite, or less than one bin.
        """
        both = np.concatenate((before, after))
        if bins < 1 or len(both) == 0 or not (np.isfinite(both).all() and (both >= 0.0).all()):
            raise InvalidInputError(
                f"histogram of {len(both)} values in {bins} bins: give 1 bin or more, and finite values from 0"
            )
        top = float(both.max(initial=0.0))
        most = float(np.quantile(both, SHOWN))
        edges = np.linspace(0.0, most if most > 0.0 else top if top > 0.0 else 1.0, bins + 1)
        if top > edges[-1]:
            edges = np.append(edges, top)
        return cls(edges, *(np.histogram(values, edges)[0] for values in (before, after)))

    @property
    def beyond(self) -> int:
        """Number of wide bins at the end, 0 or 1."""
        return int(np.count_nonzero(np.diff(self.edges) > (1.0 + 1e-6) * self.edges[1]))


@dataclass(frozen=True, eq=False)
class MarkovTail:
    """Share of draws of a value of 0 or more that reach k, and what Markov's inequality allows: all (t,).

    The bound takes the mean of the same draws, so it holds for them exactly; above 1 it says nothing.
    """

    k: np.ndarray
    tail: np.ndarray
    bound: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray, thresholds: Sequence[float] = THRESHOLDS) -> "MarkovTail":
        """Measure values (s,) at thresholds > 0."""
        k = np.asarray(thresholds, dtype=float)
        if len(values) == 0 or not (k > 0.0).all():
            raise InvalidInputError(
                f"Markov bound of {len(values)} values at {thresholds}: give values, and thresholds above 0"
            )
        return cls(k, (values[:, None] >= k).mean(axis=0), values.mean() / k)


@dataclass(frozen=True, eq=False)
class CodeChange:
    """What the figure shows of one code."""

    code: int
    role: str
    histogram: Histogram
    before: MarkovTail
    after: MarkovTail
    g_before: float
    g_after: float

    @property
    def name(self) -> dict[str, object]:
        """The cells that begin its rows."""
        return {"code": self.code, "role": self.role}


def code_changes(update: CodeUpdate) -> list[CodeChange]:
    """The far and the near code."""
    changes = []
    for role, index in update.representatives().items():
        before, after = update.g_before[index], update.g_after[index]
        changes.append(
            CodeChange(
                code=int(update.codes[index]),
                role=role,
                histogram=Histogram.of(before, after),
                before=MarkovTail.of(before),
                after=MarkovTail.of(after),
                g_before=float(before.mean()),
                g_after=float(after.mean()),
            )
        )
    return changes


def write_tables(update: CodeUpdate, changes: Sequence[CodeChange], folder: Path) -> list[Path]:
    """Write the numbers of the figure and those of every predicted code; returns the files."""
    tables = (
        (HISTOGRAM_FILE, _histogram_rows(changes)),
        (VALUES_FILE, value_rows(update)),
        (MARKOV_FILE, _markov_rows(changes)),
    )
    return [write_csv(folder / name, rows) for name, rows in tables]


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> Path:
    """Write a table whose rows are cells by column, numbers to 6 digits, at once or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: f"{x:.6g}" if isinstance(x, float) else x for name, x in row.items()})
    write_text(path, text.getvalue())
    return path


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


def _histogram_rows(changes: Iterable[CodeChange]) -> list[dict[str, object]]:
    return [
        {**change.name, "from": float(low), "to": float(high), "before": int(before), "after": int(after)}
        for change in changes
        for (low, high), before, after in zip(
            pairwise(change.histogram.edges), change.histogram.before, change.histogram.after, strict=True
        )
    ]


def _markov_rows(changes: Iterable[CodeChange]) -> list[dict[str, object]]:
    return [
        {**change.name, "when": when, "k": float(k), "tail": float(tail), "bound": float(bound)}
        for change in changes
        for when, markov in (("before", change.before), ("after", change.after))
        for k, tail, bound in zip(markov.k, markov.tail, markov.bound, strict=True)
    ]
