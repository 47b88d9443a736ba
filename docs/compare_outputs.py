"""Compare what notebooks print with their stored outputs, after the build of the site ran them.

`python docs/compare_outputs.py build/jupyter_execute` prints differences and ends with 1 if there
are some. Outputs must be equal where the arithmetic is pinned (docs/guard.md); elsewhere, numbers
up to a tolerance. Times are left out, and so are cells with the tag `not-compared`: what they show
depends on a time limit.
"""

import re
import sys
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import nbformat

from cvqmpt_lab.base.arithmetic import is_pinned

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"


def numbers_and_text(line: str) -> tuple[str, list[str]]:
    """Return a line with # for each number, without times, and the numbers as they are written."""
    line = re.sub(r"\d+(\.\d+)? (ms|s|minutes)\b", "# s", line.replace("−", "-"))
    number = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])")
    return re.sub(r"[\s-]+", " ", number.sub("#", line)), number.findall(line)


def close(was: str, now: str, tolerance: float = 0.02) -> bool:
    """Return whether two numbers are equal, or differ by little where the arithmetic may differ."""
    a, b = float(was), float(now)
    if a == b or is_pinned():
        return a == b
    digits = min(len(text.partition(".")[2]) for text in (was, now))
    return abs(a - b) <= max(tolerance * max(abs(a), abs(b)), 1.01 * 10.0**-digits)


def differences(shown: str, now: str) -> Iterator[str]:
    """Yield a text for each line of an output that differs from the one that is shown."""
    for line, other in zip_longest(without_times(shown), without_times(now), fillvalue=""):
        text, numbers = numbers_and_text(line)
        other_text, others = numbers_and_text(other)
        if text != other_text or not all(map(close, numbers, others)):
            yield f"shown {line!r}, now {other!r}"


def without_times(text: str) -> list[str]:
    """Return lines without sections on time, and without cells of columns in [s] or [ms]."""
    lines, timed, left_out = [], set[int](), False
    for line in text.strip().splitlines():
        if line.startswith("#"):
            left_out = "Time" in line
        if left_out:
            continue
        cells = line.split("|")
        if len(cells) < 3:
            timed = set()
        timed |= {k for k, cell in enumerate(cells) if "[s]" in cell or "[ms]" in cell}
        kept = ["" if k in timed else cell for k, cell in enumerate(cells)]
        lines.append("|".join(kept).rstrip())
    return lines


def texts(path: Path) -> list[str]:
    """Return the text that each compared cell of a notebook shows."""
    found = []
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "code" and "not-compared" not in cell.metadata.get("tags", ()):
            parts = [output for output in cell.outputs if output.get("name") != "stderr"]
            # a stream may be stored in several parts
            shown = [
                part.text
                if part.output_type == "stream"
                else f"{part.data.get('text/markdown') or part.data.get('text/plain', '')}\n"
                for part in parts
            ]
            found.append("".join(shown))
    return found


def main(executed: Path) -> int:
    """Compare all notebooks; return 1 if one differs."""
    count = 0
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        cells = zip_longest(texts(path), texts(executed / "notebooks" / path.name), fillvalue="")
        for shown, now in cells:
            for difference in differences(shown, now):
                print(f"{path.name}: {difference}")
                count += 1
    if count:
        print(f"{count} lines of outputs differ; to store the new ones: make notebooks")
    return 1 if count else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
