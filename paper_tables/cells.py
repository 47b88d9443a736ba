"""Cells of tables: numbers, intervals, aligned markdown and LaTeX text."""

import math
from collections.abc import Sequence

from cvqmpt_lab.results.statistics import Interval
from paper_tables.place_task_summary import CONFIDENCE

_LATEX_ESCAPES = {"\\": r"\textbackslash{}", "∞": r"$\infty$", "–": "--", "^": r"\^{}", "~": r"\~{}"}
_LATEX_ESCAPES |= {character: f"\\{character}" for character in "&%$#_{}"}


def latex(text: str) -> str:
    """Text with LaTeX's special characters escaped."""
    return "".join(_LATEX_ESCAPES.get(character, character) for character in text)


def number(value: float | None) -> str:
    """Three significant digits, thousands in full."""
    if value is None:
        return "–"
    if not math.isfinite(value):
        return "∞"
    digits = 2 - math.floor(math.log10(abs(value))) if value else 0
    return f"{value:.{min(max(digits, 0), 6)}f}"


def bounds(interval: Interval) -> str:
    """Its bounds; round brackets where they are the whole range."""
    if interval.low is None or interval.high is None:
        return ""
    text = f"{number(interval.low)}, {number(interval.high)}"
    is_range = interval.coverage is not None and interval.coverage < CONFIDENCE
    return f"({text})" if is_range else f"[{text}]"


def aligned(lines: Sequence[Sequence[str]]) -> str:
    """A markdown table (first line: header) whose columns line up in a terminal."""
    escaped = [[cell.replace("|", "\\|") for cell in line] for line in lines]
    widths = [max(3, *(len(line[i]) for line in escaped)) for i in range(len(escaped[0]))]
    rule = ["-" * width for width in widths]
    shown = [escaped[0], rule, *escaped[1:]]
    padded = ([cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in shown)
    return "\n".join(f"| {' | '.join(line)} |" for line in padded) + "\n"


def exact(value: float | None) -> str:
    """Full precision; nothing for None."""
    return "" if value is None else repr(value)
