"""The latest figures of the attack, kept in a page of the documentation between two marks."""

import fcntl
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import date
from pathlib import Path

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_text, write_text
from experiments.trust.check import Finding

BEGIN, END = "<!-- figures: written by cvqmpt trust -->", "<!-- end of figures -->"
HEAD = "| part | promise | tried | faults | form | made |\n|---|---|---|---|---|---|"


def record(page: Path, findings: Iterable[Finding], form: str, today: date) -> None:
    """Put findings into the page's table, in place of earlier ones of the same part and promise.

    Raises
    ------
    InvalidInputError
        When the page cannot be read or written, or has not the two marks.
    """
    with _alone(page):
        text = read_text(page)
        if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
            raise InvalidInputError(f"{page} must hold, once each: {BEGIN} ... {END}")
        before, rest = text.split(BEGIN)
        inside, after = rest.split(END)
        rows = {_key(line): line for line in inside.strip().splitlines()[2:]}
        rows |= {_key(line): line for line in (_row(finding, form, today) for finding in findings)}
        table = "\n".join((HEAD, *(rows[key] for key in sorted(rows))))
        write_text(page, f"{before}{BEGIN}\n{table}\n{END}{after}")


@contextmanager
def _alone(page: Path) -> Iterator[None]:
    """While no other process records in the page's folder; not by the page, which is replaced."""
    folder = os.open(page.parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def _row(finding: Finding, form: str, today: date) -> str:
    check, trial = finding.check, finding.trial
    cells = (
        finding.part,
        check.promise,
        f"{trial.tried:,} {check.unit}".replace(",", " "),
        str(len(trial.faults)),
        form,
        str(today),
    )
    return f"| {' | '.join(cells)} |"


def _key(row: str) -> tuple[str, ...]:
    return tuple(cell.strip() for cell in row.split("|")[1:3])
