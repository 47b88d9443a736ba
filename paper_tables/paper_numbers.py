"""The paper's numbers, as printed there, from the csv files in ``published``."""

import csv
from dataclasses import dataclass
from pathlib import Path

PUBLISHED = Path(__file__).resolve().parent / "published"


@dataclass(frozen=True)
class PublishedValue:
    """One number of the paper; the fields are the columns of the files."""

    table: str
    environment: str
    planner: str
    paper_name: str
    metric: str
    value: str  # as printed there
    unit: str
    note: str


def read_published(name: str, environment: str | None = None) -> tuple[PublishedValue, ...]:
    """The paper's numbers in a file of ``published``, those of one environment or all."""
    with (PUBLISHED / name).open(encoding="utf-8", newline="") as handle:
        values = [PublishedValue(**record) for record in csv.DictReader(handle)]
    return tuple(value for value in values if environment in (None, value.environment))
