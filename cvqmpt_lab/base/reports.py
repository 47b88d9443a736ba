"""Reports that commands print as lines, or as json with --json."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

Entry = tuple[str, str]
"""Label and text of a line."""


@dataclass(frozen=True, eq=False)
class Report:
    """Labelled lines for people, and the same as data for json; `print` shows the lines."""

    entries: tuple[Entry, ...]
    make_data: Callable[[], Mapping[str, Any]] = dict  # called when the data are first read
    width: int = 12  # of the labels in characters; longer labels are printed whole

    @classmethod
    def of(
        cls,
        entries: Iterable[Entry],
        data: Callable[[], Mapping[str, Any]] = dict,
        width: int = 12,
    ) -> Self:
        """Return a report of any labelled lines."""
        return cls(tuple(entries), data, width)

    @cached_property
    def data(self) -> dict[str, Any]:
        """The report as plain data for json."""
        return dict(self.make_data())

    @property
    def lines(self) -> list[str]:
        """The lines, each with its label."""
        return [
            f"{label + ' ' if label else '':{self.width}}{text}" for label, text in self.entries
        ]

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def only(self, *labels: str) -> Self:
        """Return the report with the lines of some labels; the data stay complete."""
        return type(self)(
            tuple(entry for entry in self.entries if entry[0] in labels), self.make_data, self.width
        )

    def with_entry(self, label: str, text: str, /, **data: Any) -> Self:
        """Return the report with one more line, and more data."""
        entries = (*self.entries, (label, text))
        return type(self)(entries, lambda: self.data | data, self.width)
