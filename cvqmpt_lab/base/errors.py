"""Errors with a message of one line: the wrong value, valid choices, what to do.

The command line prints the message and exits with code 2. That a planner finds no path is a result
(`PlanStatus`), not an exception.
"""

import contextlib
import importlib.util
import reprlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from numbers import Integral
from pathlib import Path
from typing import Any

LONGEST = 120  # characters of a value that a message shows
LONGEST_LINE = 1200  # characters of a message
MOST_CHOICES = 10  # that a message lists


def shown(value: object) -> str:
    """Any value as one short line, for a message."""
    short = reprlib.Repr()
    short.maxlist = short.maxtuple = short.maxdict = 8
    short.maxstring = short.maxlong = short.maxother = 80
    text = " ".join(short.repr(value).split())
    return text if len(text) <= LONGEST else text[:LONGEST] + "..."


def nearest(value: object, choices: Iterable[object]) -> str:
    """The most similar choice, as "; did you mean 'x'?", or "" if none is similar."""
    import difflib  # for errors alone

    plain = {str(choice).lower(): str(choice) for choice in choices}
    found = difflib.get_close_matches(str(value)[:LONGEST].lower(), plain, 1)
    return f"; did you mean {plain[found[0]]!r}?" if found else ""


def one_line(text: str) -> str:
    """A message as one printable line; of a very long one the middle is left out."""
    line = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
    if len(line) <= LONGEST_LINE:
        return line
    return f"{line[: LONGEST_LINE // 2]} ... {line[-LONGEST_LINE // 3 :]}"


class CvqmptError(Exception):
    """Base of all errors of this package; always one line."""

    def __init__(self, message: str = "") -> None:
        super().__init__(one_line(str(message)))


class UnknownChoiceError(CvqmptError):
    """A name that is not in a table of choices."""

    def __init__(self, kind: str, value: object, choices: Iterable[object]) -> None:
        names = [str(choice) for choice in choices]
        more = len(names) - MOST_CHOICES
        listed = ", ".join(names[:MOST_CHOICES]) + (f", and {more} more" if more > 0 else "")
        super().__init__(
            f"unknown {kind} {shown(value)}; valid choices: {listed}{nearest(value, names)}"
        )
        self._asked = kind, value, names

    def __reduce__(self) -> tuple:
        """Pickle by the constructor's arguments, to send it from a worker to the main process."""
        return UnknownChoiceError, self._asked


class InvalidInputError(CvqmptError):
    """A value, file or field that cannot be used as given."""


class InvalidProblemError(InvalidInputError):
    """A planning problem whose start, goals or constraint contradict each other."""


class RunStoreError(InvalidInputError):
    """A results directory that cannot be read, written or continued."""


def whole_number(what: str, value: object, least: int = 0, most: int | None = None) -> int:
    """Return a whole number from least to most (None: no bound); errors call it `what`."""
    number = (
        int(value) if isinstance(value, Integral) and not isinstance(value, bool) else least - 1
    )
    if number >= least and (most is None or number <= most):
        return number
    bounds = f"of {least} or more" if most is None else f"from {least} to {most}"
    raise InvalidInputError(f"{what} {shown(value)}: give a whole number {bounds}")


def require_kind(what: str, value: object, kind: type, cure: str = "") -> None:
    """Refuse a value of another type; InvalidInputError calls it `what` and names both types."""
    if not isinstance(value, kind):
        found = f"{what} is a {type(value).__name__}, {shown(value)}"
        raise InvalidInputError(f"{found}; it must be a {kind.__name__}{cure and f': {cure}'}")


def require_choice(what: str, value: Any, choices: Collection[object]) -> Any:
    """Return a value that is in a table of choices; UnknownChoiceError calls it `what`."""
    if value not in choices:
        raise UnknownChoiceError(what, value, choices)
    return value


@contextlib.contextmanager
def located(where: str) -> Iterator[None]:
    """Put `where` in front of the message of an error raised inside."""
    try:
        yield
    except CvqmptError as error:
        if not where:
            raise
        kind = type(error) if isinstance(error, InvalidInputError) else InvalidInputError
        raise kind(f"{where}: {error}") from error


def unique(names: Iterable[str], where: str) -> None:
    """Refuse a name that occurs twice."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InvalidInputError(f"{where}: {shown(name)} occurs twice; names must be unique")
        seen.add(name)


def at(where: str, field: str) -> str:
    """Where a field is, for error messages: `object.field`."""
    return f"{where}.{field}" if where and not where.endswith(" ") else f"{where}{field}"


def mapping(value: Any, where: str, fields: str = "") -> Mapping[str, Any]:
    """Return a value that is a json object; errors name the fields that it should have."""
    if not isinstance(value, Mapping):
        must = f"an object with {fields}" if fields else "an object"
        raise InvalidInputError(f"{where or 'this'} is {shown(value)}; it must be {must}")
    return value


def in_checkout() -> bool:
    """Whether this runs in a checkout of the project, not as an installed wheel."""
    return (Path(__file__).parents[2] / "constraints.txt").is_file()


def install_command(extra: str) -> str:
    """Command that installs an extra; outside a checkout by its packages, as no index has ours."""
    if in_checkout():
        return f".venv/bin/pip install -c constraints.txt -e '.[{extra}]'"
    from importlib.metadata import requires  # for this message alone

    declared = [text.partition(";") for text in requires("cvqmpt-lab") or ()]
    asked = [repr(name.strip()) for name, _, marker in declared if f'"{extra}"' in marker]
    return f"pip install {' '.join(asked)}"


def require_installed(module: str, what: str, extra: str) -> None:
    """Raise InvalidInputError if a module of an extra, which `what` needs, is not installed."""
    if importlib.util.find_spec(module) is None:
        raise InvalidInputError(
            f"{what} needs {module}, which is not installed: {install_command(extra)}"
        )
