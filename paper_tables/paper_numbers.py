"""The paper's numbers, as printed there, from the csv files in ``published``."""

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from cvqmpt_lab.errors import InvalidInputError

PUBLISHED = Path(__file__).resolve().parent / "published"
COLUMNS = ("table", "environment", "planner", "paper_name", "metric", "value", "unit", "note")


@dataclass(frozen=True)
class PublishedValue:
    """One number of the paper; ``printed`` is its text there."""

    environment: str
    planner: str
    paper_name: str
    metric: str
    printed: str
    unit: str
    note: str


def read_published(path: Path, environment: str | None = None) -> tuple[PublishedValue, ...]:
    """Read the paper's numbers, those of one environment or all.

    Raises
    ------
    InvalidInputError
        When the columns are not `COLUMNS` or a value is not a number.
    """
    with Path(path).open(encoding="utf-8", newline="") as handle:
        reader = csv.DictReader(handle)
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise InvalidInputError(f"{path}, line 1: columns must be {','.join(COLUMNS)}")
        values = []
        for record in reader:
            try:
                float(record["value"])
            except (TypeError, ValueError):
                message = f"{path}, line {reader.line_num}, column value: {record['value']!r} is no number"
                raise InvalidInputError(message) from None
            if environment in (None, record["environment"]):
                fields = {name: record[name] for name in COLUMNS if name not in ("table", "value")}
                values.append(PublishedValue(printed=record["value"], **fields))
    return tuple(values)


def notes_on(published: Iterable[PublishedValue]) -> list[str]:
    """Notes on the paper's numbers, each once, with the metric and the planners it belongs to."""
    owners: dict[tuple[str, str], list[str]] = {}
    for value in published:
        if value.note:
            owners.setdefault((value.metric, value.note), []).append(value.paper_name)
    return [f"{metric} ({', '.join(names)}): {note}" for (metric, note), names in owners.items()]
