"""Text of tables: numbers, intervals, aligned text, Markdown and LaTeX."""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

from cvqmpt_lab.benchmarks.results.statistics import CONFIDENCE, Interval

_LATEX_ESCAPES = {
    "\\": r"\textbackslash{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "−": "$-$",
    "∞": r"$\infty$",
    "–": "--",
    "^": r"\^{}",
    "~": r"\~{}",
}
_LATEX_ESCAPES |= {character: f"\\{character}" for character in "&%$#_{}"}
PAGE_WIDTH = 100  # characters of a line of Markdown
LABELS = "planner", "against"  # titles of the last columns that every part of a wide table repeats
BOLD = re.compile(r"\*\*(.+?)\*\*")


class Ratio(str):
    """Title of a column of ratios, which pages colour where the interval is on one side of 1."""

    __slots__ = ()


Lines = Sequence[Sequence[str]]  # a table as lines of cells, the header first
# by title; what has no title is plain text and comes first
Sections = Mapping[str, Lines | Sequence[str]]


def latex(text: str) -> str:
    """Return text with LaTeX's special characters escaped, and the part between ** bold."""
    escaped = "".join(_LATEX_ESCAPES.get(character, character) for character in text)
    return BOLD.sub(r"\\textbf{\1}", escaped)


def bold(cell: str) -> str:
    """Return a cell whose number, but not its interval, is marked as the best one."""
    value, space, rest = cell.partition(" ")
    return f"**{value}**{space}{rest}"


def number(value: float | None) -> str:
    """Three significant digits, thousands in full."""
    if value is None:
        return "–"
    if not math.isfinite(value):
        return "∞"
    digits = 2 - math.floor(math.log10(abs(value))) if value else 0
    return f"{value:.{min(max(digits, 0), 6)}f}"


def bounds(interval: Interval) -> str:
    """Bounds; round brackets if they are the whole range."""
    if interval.low is None or interval.high is None:
        return ""
    text = f"{number(interval.low)}, {number(interval.high)}"
    is_range = interval.coverage is not None and interval.coverage < CONFIDENCE
    return f"({text})" if is_range else f"[{text}]"


def estimate(interval: Interval) -> str:
    """Return the number and its bounds."""
    return f"{number(interval.estimate)} {bounds(interval)}".strip()


def rounded(interval: Interval, digits: int) -> str:
    """The number alone, with some significant digits; empty where undefined."""
    return "" if interval.estimate is None else f"{interval.estimate:.{digits}g}"


def change(ratio: Interval) -> str:
    """Return a ratio as a signed change [%]."""
    changes = ratio.mapped(lambda x: 100.0 * (x - 1.0))
    sign = "+" if (changes.estimate or 0.0) > 0.0 else ""
    return sign + estimate(changes).replace("-", "−")


def padded(lines: Lines) -> list[list[str]]:
    """Cells of equal width in every column."""
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
    return [[cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines]


def text_lines(lines: Lines) -> list[str]:
    """A table for a terminal."""
    plain = [[BOLD.sub(r"\1", cell) for cell in line] for line in lines]
    return ["  ".join(line).rstrip() for line in padded(plain)]


def markdown_text(text: str) -> str:
    """Text of one line for Markdown; a name that it quotes becomes neither html nor an image."""
    without_html = re.sub(r"<(?=[A-Za-z/!?])", "&lt;", text)
    return without_html.replace("![", "!\\[").replace("\n", " ")


def markdown_table(lines: Lines) -> str:
    """A Markdown table whose columns line up in a terminal; "None." when there is only a header."""
    if len(lines) < 2:
        return "None.\n"
    escaped = [
        [markdown_text(cell).replace("|", "\\|").ljust(3) for cell in line] for line in lines
    ]
    header, *rest = padded(escaped)
    rule = ["-" * len(cell) for cell in header]
    return "\n".join(f"| {' | '.join(line)} |" for line in (header, rule, *rest)) + "\n"


def markdown_tables(lines: Lines) -> str:
    """A table for Markdown; one that is wider than a page becomes several."""
    return "\n".join(map(markdown_table, narrow(lines)))


def markdown(sections: Sections) -> str:
    """Sections as Markdown; empty ones are left out."""
    return "\n".join(
        f"## {markdown_text(title)}\n\n{_section(part)}"
        if title
        else "".join(f"{markdown_text(str(text))}\n" for text in part)
        for title, part in sections.items()
        if part
    )


def _section(part: Lines | Sequence[str]) -> str:
    lines = [line for line in part if not isinstance(line, str)]
    return (
        markdown_tables(lines)
        if lines
        else "".join(f"- {markdown_text(str(text))}\n" for text in part)
    )


def narrow(lines: Lines) -> list[Lines]:
    """Split a table into several of at most PAGE_WIDTH characters, except cells that are sentences.

    Each has the label columns: the first, and all up to those titled "planner" and "against".
    """
    labels = 1 + max((lines[0].index(x) for x in LABELS if x in lines[0]), default=0)
    widths = [max(3, *(len(line[k]) for line in lines)) + 3 for k in range(len(lines[0]))]
    if sum(widths[:labels]) + max(widths[labels:], default=0) >= PAGE_WIDTH:
        return [lines]
    parts: list[list[int]] = [[]]
    for k in range(labels, len(widths)):
        taken = 1 + sum(widths[:labels]) + sum(widths[j] for j in parts[-1])
        if parts[-1] and taken + widths[k] > PAGE_WIDTH:
            parts.append([])
        parts[-1].append(k)
    return [[[*line[:labels], *(line[k] for k in part)] for line in lines] for part in parts]


def side_by_side(
    labels: int, widths: Sequence[int], most: int = 5, across: int = 118
) -> Iterator[range]:
    """Yield the columns of one table of LaTeX after the other.

    Args:
        labels: width of the columns with labels [characters].
        widths: width of every other column [characters].
        most: largest number of columns of a table, without labels.
        across: width of a page [characters].
    """
    first = 0
    while first < len(widths):
        last, taken = first + 1, labels + widths[first]
        while last < min(len(widths), first + most) and taken + widths[last] + 2 <= across:
            taken += widths[last] + 2
            last += 1
        yield range(first, last)
        first = last


def latex_table(
    caption: str, label: str, parts: Iterable[Sequence[Lines]], most_lines: int = 70
) -> str:
    """Tables over two columns (booktabs), two label columns first; the caption stands at the first.

    Args:
        caption: caption of the first table.
        label: name of its label; the others have it with their number.
        parts: tables, each as blocks of lines with a rule between them, the header first.
        most_lines: number of lines of a page; longer tables are cut, and have the header again.
    """
    name, texts, cut = "".join(c if c.isalnum() else "-" for c in label), [], []
    for header, *blocks in parts:
        cut.append([header])
        for block in blocks:
            for first in range(0, len(block), most_lines):
                piece = block[first : first + most_lines]
                if sum(map(len, cut[-1])) + len(piece) > most_lines and len(cut[-1]) > 1:
                    cut.append([header])
                cut[-1].append(piece)
    for number, blocks in enumerate(cut, start=1):
        text = latex(caption) if number == 1 else "Continued."
        place = f"tab:{name}" if number == 1 else f"tab:{name}-{number}"
        texts.append(_latex_float(rf"\caption{{{text}}}\label{{{place}}}", blocks))
    return "".join(texts)


def _latex_float(caption: str, blocks: Sequence[Lines]) -> str:
    lines = [line for block in blocks for line in block]
    labels = [k for k in range(2) if any(line[k] for line in lines)]  # without empty columns
    numbers = range(2, len(lines[0]))
    body: list[str] = []
    for block in blocks:
        body += [r"\midrule"] if body else []
        for line in block:
            row = " & ".join(latex(line[k]) for k in (*labels, *numbers))
            # a row that begins with [ or * would be read as an argument of the \\ before it
            body.append(("{}" if row.startswith(("[", "*")) else "") + row + r" \\")
    return "\n".join(
        [
            r"\begin{table*}[t]",
            r"  \centering\scriptsize\setlength{\tabcolsep}{3pt}",
            f"  {caption}",
            rf"  \begin{{tabular}}{{{'l' * len(labels)}{'c' * len(numbers)}}}",
            r"    \toprule",
            *(f"    {line}" for line in body),
            r"    \bottomrule",
            r"  \end{tabular}",
            r"\end{table*}",
            "",
        ]
    )
