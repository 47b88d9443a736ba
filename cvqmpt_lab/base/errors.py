"""Errors whose message is one line: the wrong value, valid choices, what to do.

The command line prints the message and exits with code 2. A planner that finds no path returns a
result (`PlanStatus`); this is not an error.
"""

import contextlib
import importlib.util
import reprlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from numbers import Integral
from pathlib import Path
from typing import Any

MAX_VALUE_CHARACTERS = 120  # largest number of characters of a value in a message
MAX_MESSAGE_CHARACTERS = 1200


def shown(value: object) -> str:
    """Return a value as one short line for a message."""
    short = reprlib.Repr()
    short.maxlist = short.maxtuple = short.maxdict = 8
    short.maxstring = short.maxlong = short.maxother = 80
    text = " ".join(short.repr(value).split())
    return text if len(text) <= MAX_VALUE_CHARACTERS else text[:MAX_VALUE_CHARACTERS] + "..."


def few(names: Iterable[str], most: int = 8, counted: str = "{} in all") -> str:
    """Return the first `most` names, separated by commas, and the number of all if it is larger."""
    every = list(dict.fromkeys(names))
    if len(every) <= most:
        return ", ".join(every)
    return f"{', '.join(every[:most])}, ... ({counted.format(len(every))})"


def nearest(value: object, choices: Iterable[object]) -> str:
    """Return "; did you mean 'x'?" with the most similar choice, or "" if none is similar."""
    found = similar(value, choices)
    return f"; did you mean {found!r}?" if found else ""


def similar(value: object, choices: Iterable[object], alike: float = 0.6) -> str:
    """Return the most similar choice, whatever its case, or "" if none is similar.

    alike: similarity, from 0 to 1, from which a choice counts as similar.
    """
    import difflib  # imported here: only errors need it

    plain = {str(choice).lower(): str(choice) for choice in choices}
    found = difflib.get_close_matches(str(value)[:MAX_VALUE_CHARACTERS].lower(), plain, 1, alike)
    return plain[found[0]] if found else ""


def one_line(text: str) -> str:
    """Return a message as one printable line; the middle of a very long one is left out."""
    line = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
    if len(line) <= MAX_MESSAGE_CHARACTERS:
        return line
    return f"{line[: MAX_MESSAGE_CHARACTERS // 2]} ... {line[-MAX_MESSAGE_CHARACTERS // 3 :]}"


class CvqmptError(Exception):
    """Base class of all errors of this package; the message is one line."""

    def __init__(self, message: str = "") -> None:
        super().__init__(one_line(str(message)))


class UnknownChoiceError(CvqmptError):
    """A name that is not in a table of choices."""

    def __init__(self, kind: str, value: object, choices: Iterable[object]) -> None:
        names = [str(choice) for choice in choices]
        listed = ", ".join(names[:10])
        if len(names) > 10:
            listed += f", and {len(names) - 10} more"
        super().__init__(
            f"unknown {kind} {shown(value)}; valid choices: {listed}{nearest(value, names)}"
        )
        self._arguments = kind, value, names

    def __reduce__(self) -> tuple:
        """Pickle by the constructor's arguments: workers send errors to the main process."""
        return UnknownChoiceError, self._arguments


class InvalidInputError(CvqmptError):
    """A value, file or field that cannot be used as given."""


class InvalidProblemError(InvalidInputError):
    """A planning problem whose start, goals or constraint contradict each other."""


class RunStoreError(InvalidInputError):
    """A results directory that cannot be read, written or continued."""


def whole_number(what: str, value: object, least: int = 0, most: int | None = None) -> int:
    """Return `value` as an int; refuse anything but a whole number from `least` to `most`.

    Args:
        what: name of the value in errors.
        value: a value of any type.
        least: smallest valid number.
        most: largest valid number; None: no limit.
    """
    number = (
        int(value) if isinstance(value, Integral) and not isinstance(value, bool) else least - 1
    )
    if number >= least and (most is None or number <= most):
        return number
    bounds = f"of {least} or more" if most is None else f"from {least} to {most}"
    raise InvalidInputError(f"{what} {shown(value)}: give a whole number {bounds}")


def require_kind(what: str, value: object, kind: type, cure: str = "") -> None:
    """Refuse a value that is not an instance of `kind`.

    Args:
        what: name of the value in errors.
        value: a value of any type.
        kind: the type that it must have.
        cure: what to give instead, for the message; "": nothing more is said.
    """
    if not isinstance(value, kind):
        found = f"{what} is a {type(value).__name__}, {shown(value)}"
        raise InvalidInputError(f"{found}; it must be a {kind.__name__}{cure and f': {cure}'}")


def require_choice(what: str, value: Any, choices: Collection[object]) -> Any:
    """Return `value` if it is in `choices`; else raise UnknownChoiceError about `what`."""
    if value not in choices:
        raise UnknownChoiceError(what, value, choices)
    return value


@contextlib.contextmanager
def located(where: str) -> Iterator[None]:
    """Put `where` in front of the message of an error that is raised inside the block."""
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
    """Return the place of a field for error messages: `object.field`."""
    return f"{where}.{field}" if where and not where.endswith(" ") else f"{where}{field}"


def mapping(value: Any, where: str, fields: str = "") -> Mapping[str, Any]:
    """Return `value` if it is a JSON object; else refuse it, naming the `fields` of the object."""
    if not isinstance(value, Mapping):
        must = f"an object with {fields}" if fields else "an object"
        raise InvalidInputError(f"{where or 'this'} is {shown(value)}; it must be {must}")
    return value


def known_fields(value: Any, where: str, known: Collection[str]) -> Mapping[str, Any]:
    """Return `value` if it is a JSON object with fields of `known` alone; else refuse it."""
    for key in mapping(value, where, ", ".join(known)):
        require_choice(f"key of {where}", key, known)
    return value


def in_checkout() -> bool:
    """Return whether this code is in a checkout of the project, not in an installed wheel."""
    return (Path(__file__).parents[2] / "constraints.txt").is_file()


def install_command(extra: str) -> str:
    """Return the command that installs an extra; outside a checkout it lists the packages.

    No package index has cvqmpt-lab itself.
    """
    if in_checkout():
        return f".venv/bin/pip install -c constraints.txt -e '.[{extra}]'"
    from importlib.metadata import requires  # imported here: only this message needs it

    declared = [text.partition(";") for text in requires("cvqmpt-lab") or ()]
    packages = [repr(name.strip()) for name, _, marker in declared if f'"{extra}"' in marker]
    return f"pip install {' '.join(packages)}"


def require_installed(module: str, what: str, extra: str) -> None:
    """Refuse to go on without a module that `what` needs; the message has the install command."""
    if importlib.util.find_spec(module) is None:
        raise InvalidInputError(
            f"{what} needs {module}, which is not installed: {install_command(extra)}"
        )
