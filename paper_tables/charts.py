"""Charts of rows for the html report, as small svg text that is written without matplotlib."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from cvqmpt_lab.paper_tables.measures import VALUES, Value
from cvqmpt_lab.paper_tables.plots import Groups, is_own, line_style


@dataclass(frozen=True)
class _Axis:
    """The horizontal axis of a chart; lengths in units of the svg."""

    low: float  # values at both ends
    high: float
    log: bool
    label: str
    left: float  # of the area of values
    right: float = 512.0

    @staticmethod
    def over(values: Sequence[float], log: bool, label: str, left: float) -> "_Axis":
        """Return an axis that contains values; from zero if it is not logarithmic.

        Args:
            values: the values that are drawn.
            log: whether the axis is logarithmic.
            label: its title.
            left: where it begins on the page.
        """
        high = max(values, default=1.0)
        low = min((x for x in values if x > 0.0), default=0.1 * high) if log else 0.0
        return _Axis(low, 1.05 * max(high, 1e-9 + low), log, label, left)

    def at(self, value: float) -> float:
        """Return the place of a value."""
        if self.log:
            part = math.log(max(value, self.low) / self.low) / math.log(self.high / self.low)
        else:
            part = (value - self.low) / (self.high - self.low)
        return round(self.left + min(part, 1.0) * (self.right - self.left), 1)

    def ticks(self) -> list[float]:
        """Return powers of ten, or multiples of 1, 2 or 5 where fewer than two are inside."""
        first, last = math.log10(max(self.low, 1e-12)), math.log10(self.high)
        powers = [10.0**k for k in range(math.ceil(first), math.floor(last) + 1)]
        if self.log and len(powers) > 1:
            return powers
        rough = 10.0 ** math.floor(math.log10((self.high - self.low) / 3.0))
        step = max(rough * k for k in (1, 2, 5) if rough * k <= (self.high - self.low) / 3.0)
        multiples = range(math.ceil(self.low / step), math.floor(self.high / step) + 1)
        return [k * step for k in multiples]

    def drawn(self, bottom: float) -> str:
        """Return lines and numbers of the ticks, and the label below."""
        lines = "".join(f"M{self.at(x)} 4V{bottom:g}" for x in self.ticks())
        numbers = "".join(
            f'<text x="{self.at(x)}" y="{bottom + 14:g}" text-anchor="middle">{x:g}</text>'
            for x in self.ticks()
        )
        middle = 0.5 * (self.left + self.right)
        return (
            f'<path class="grid" d="{lines}"/>{numbers}<text x="{middle:g}" y="{bottom + 29:g}" '
            f'text-anchor="middle">{escape(self.label)}</text>'
        )


def _svg(height: float, body: str) -> str:
    return f'<svg viewBox="0 0 520 {height:g}" role="img">{body}</svg>'


def _rows(parts: Mapping[str, str], axis: _Axis) -> str:
    """Return a chart with a line for each planner; parts: svg around y = 0, by its name."""
    above = axis.left < 100.0  # names stand above their line
    line, rise, x, anchor = (31.0, 12.0, 8.0, "start") if above else (19.0, 0.0, 112.0, "end")
    bottom = 6.0 + line * len(parts)
    names = "".join(
        f'<g transform="translate(0 {line * k + 13.5 + rise:g})">{drawn}</g>'
        f'<text x="{x:g}" y="{line * k + 17.3 - 0.3 * rise:g}" text-anchor="{anchor}">'
        f"{escape(name)}</text>"
        for k, (name, drawn) in enumerate(parts.items())
    )
    return _svg(bottom + 34.0, axis.drawn(bottom) + names)


def _left(groups: Groups) -> float:
    """Return the left end of the area of values; long names of planners stand above it."""
    return 8.0 if any(len(name) > 17 for name in groups) else 118.0


def solved_within(groups: Groups, most_points: int = 60) -> str:
    """Return the share of solved runs against time; long curves have `most_points` steps."""
    time = VALUES["time"]
    known = {
        name: np.sort([x for row in rows if row.solved and (x := time(row))])
        for name, rows in groups.items()
    }
    axis = _Axis.over(
        np.concatenate(list(known.values())).tolist(), True, "time, everything counted [s]", 34.0
    )
    lines = []
    for name, times in sorted(known.items(), key=lambda item: is_own(item[0])):
        kept = np.unique(np.linspace(0, len(times) - 1, min(len(times), most_points)).astype(int))
        share = 100.0 / len(groups[name])
        steps = [f"H{axis.at(times[k])}V{_level(share * (k + 1))}" for k in kept]
        if steps:
            style = line_style(name)
            dash = {"--": "5 3", ":": "2 2"}.get(style["linestyle"], "none")
            lines.append(
                f'<path d="M{axis.at(times[0])} {_level(0.0)}{"".join(steps)}" fill="none" '
                f'stroke="{style["color"]}" stroke-width="{style["linewidth"]}" '
                f'stroke-dasharray="{dash}"><title>{escape(name)}</title></path>'
            )
    scale = "".join(
        f'<text x="30" y="{_level(share) + 4:g}" text-anchor="end">{share}</text>'
        f'<path class="grid" d="M34 {_level(share)}H512"/>'
        for share in (0, 25, 50, 75, 100)
    )
    return _svg(284.0, axis.drawn(_level(0.0)) + scale + "".join(lines))


def _level(share: float) -> float:
    """Return the height of a share [%] in `solved_within`."""
    return round(250.0 - 2.4 * share, 1)


def distribution(groups: Groups, value: Value, label: str, log: bool = True) -> str:
    """Return a box for each planner over its solved runs: quartiles, whiskers at 5 and 95 %.

    Args:
        groups: rows by planner.
        value: function that returns the value of a row.
        label: label of the axis.
        log: whether the axis is logarithmic.

    Returns:
        The chart; "" where no solved run has a value.
    """
    known = {
        name: np.percentile(found, (5, 25, 50, 75, 95))
        for name, rows in groups.items()
        if (found := [float(x) for row in rows if row.solved and (x := value(row))])
    }
    if not known:
        return ""
    axis = _Axis.over(np.concatenate(list(known.values())).tolist(), log, label, _left(groups))
    parts = {}
    for name, numbers in known.items():
        least, low, middle, high, most = map(axis.at, numbers)
        parts[name] = (
            f'<path class="whisker" d="M{least} 0H{most}"/>'
            f'<rect x="{low}" y="-6" width="{high - low:.1f}" height="12" '
            f'fill="{line_style(name)["color"]}"/><path class="middle" d="M{middle} -6V6"/>'
        )
    return _rows(parts, axis)


def stage_times(groups: Groups) -> str:
    """Return the mean time of every stage of planning, stacked, with the colours of the stages."""
    stages = {  # stages of a run: the column of their time, and their colour
        "goals": ("t_goals_s", "#66c2a5"),
        "encode": ("t_encode_s", "#fc8d62"),
        "predict": ("t_predict_s", "#8da0cb"),
        "update": ("t_optimize_s", "#e78ac3"),
        "search": ("t_plan_s", "#a6d854"),
        "shorten": ("t_simplify_s", "#ffd92f"),
    }
    means = {
        name: [
            1e3 * sum(getattr(row, column) or 0.0 for row in rows) / len(rows)
            for column, _ in stages.values()
        ]
        for name, rows in groups.items()
    }
    totals = [sum(parts) for parts in means.values()]
    longest, middle = max(totals), float(np.median(totals))
    shown = longest if longest < 8.0 * middle else middle  # one slow planner hides no other
    axis = _Axis.over([shown], False, "mean time [ms], failures with what they took", _left(groups))
    parts = {}
    for name, own in means.items():
        done, drawn = 0.0, ""
        for spent, (_, colour) in zip(own, stages.values(), strict=True):
            begin, end = axis.at(done), axis.at(done + spent)
            done += spent
            if end > begin:
                drawn += f'<rect x="{begin}" y="-6" width="{end - begin:.1f}" height="12" '
                drawn += f'fill="{colour}"/>'
        if done > axis.high:
            drawn += f'<text x="508" y="4" text-anchor="end">{done:.0f} ms →</text>'
        parts[name] = drawn
    legend = "".join(
        f'<rect x="{4 + 84 * k}" y="6" width="10" height="10" fill="{colour}"/>'
        f'<text x="{18 + 84 * k}" y="15">{stage}</text>'
        for k, (stage, (_, colour)) in enumerate(stages.items())
    )
    return _rows(parts, axis) + f'<svg viewBox="0 0 520 22" aria-label="stages">{legend}</svg>'
