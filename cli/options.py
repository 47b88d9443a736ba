"""Options and checks shared by commands; it imports little, so that training needs little."""

import argparse
import contextlib
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.base.files import finite, picture_format, require_regular_file

# Keys: names of an option (`-v --verbose`), with arguments of argparse's add_argument; or the title
# of a group, with its options.
Options = Mapping[str, Mapping[str, Any]]
ONE_OF, EXACTLY_ONE_OF = "one of", "exactly one of"  # titles of groups of exclusive options
REPEATED: Mapping[str, Any] = {"action": "append", "default": []}
FLAG: Mapping[str, Any] = {"action": "store_true"}


def option(text: str, **settings: Any) -> dict[str, Any]:
    """Return an option: its help text and other arguments of argparse's add_argument."""
    return {"help": text, **settings}


WEIGHTS: Options = {
    "--model": option("folder of the planner's weights (the shipped ones)", metavar="DIR")
}


def _number(
    kind: type, holds: Callable[[float], bool], must: str, most: float = sys.float_info.max
) -> Callable[[str], Any]:
    """Return the type of an option whose value is a number that meets a condition.

    Args:
        kind: int or float.
        holds: condition.
        must: description of valid numbers, for the error message.
        most: largest absolute value.
    """

    def read(text: str) -> Any:
        with contextlib.suppress(ValueError, OverflowError):
            value = kind(text)
            if abs(value) <= most and holds(value):
                return abs(value)  # -0 is 0
        raise argparse.ArgumentTypeError(f"{text!r} is not {must}")

    return read


positive_int = _number(int, lambda x: x >= 1, "a whole number of 1 or more")
not_negative_int = _number(int, lambda x: x >= 0, "a whole number of 0 or more")
positive = _number(float, lambda x: x > 0, "a positive number")
not_negative = _number(float, lambda x: x >= 0, "a number of 0 or more")
rate = _number(float, lambda x: 1.0 <= x <= 1000.0, "a rate from 1 to 1000 Hz")
SEED: Options = {
    "--seed": option("seed of all randomness (0)", type=not_negative_int, default=0, metavar="S")
}


REACH: Options = {
    "--reach": option(
        "longest extension of a tree towards a sample [rad], inf: no limit (default: that of the "
        "planner)",
        type=_number(float, lambda x: x > 0, "a positive number or inf", math.inf),
        metavar="RAD",
    )
}


def one_of(what: str, known: Collection[str]) -> Callable[[str], str]:
    """Return the type of an option whose value is one of the `known` names of a `what`."""

    def read(text: str) -> str:
        return require_choice(what, text, known)

    return read


def refuse_given(args: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Refuse options that cannot be combined with others.

    Args:
        args: parsed command line.
        names: names of the options in `args`.
        why: reason and cure, which follow the option in the message.
    """
    for name in names:
        if getattr(args, name):
            raise InvalidInputError(f"--{name.replace('_', '-')} {why}")


def refuse_changed(args: argparse.Namespace, options: Options, why: str) -> None:
    """Refuse options whose values are not their defaults, where they would have no effect.

    Args:
        args: parsed command line.
        options: the options, perhaps in groups.
        why: reason and cure, which follow option and value in the message.
    """
    for names, settings in options.items():
        if all(isinstance(setting, Mapping) for setting in settings.values()):
            refuse_changed(args, settings, why)
            continue
        name = names.split()[-1]
        value = getattr(args, name.lstrip("-").replace("-", "_"))
        flag = settings.get("action") == "store_true"
        if value != settings.get("default", False if flag else None):
            if isinstance(value, tuple):  # of --margin and --cost
                mark = ":" if isinstance(value[-1], str) else ","
                value = mark.join(map(str, value))
            # values that argparse has changed otherwise are not shown
            shown = isinstance(value, str | int | float | Path) and not flag
            raise InvalidInputError(f"{name} {value} {why}" if shown else f"{name} {why}")


NOTES: list[str] = []  # printed on standard error at the end of a command that is not refused


def log(text: str) -> None:
    """Print a line on standard error at once."""
    print(text, file=sys.stderr, flush=True)


def own_command() -> list[str]:
    """Return the words of this command line, for provenance."""
    return ["cvqmpt", *sys.argv[1:]]


def add_options(parser: Any, options: Options) -> None:
    """Add options to an argparse parser or to a group of its options."""
    for names, settings in options.items():
        if names in (ONE_OF, EXACTLY_ONE_OF):
            required = names == EXACTLY_ONE_OF
            add_options(parser.add_mutually_exclusive_group(required=required), settings)
        elif all(isinstance(setting, Mapping) for setting in settings.values()):
            add_options(parser.add_argument_group(names), settings)
        else:
            parser.add_argument(*names.split(), **settings)


def as_json(data: dict[str, Any]) -> str:
    """Return JSON text; numbers that are not finite become null."""
    return json.dumps(finite(data), indent=1, allow_nan=False)


def writable_file(name: Path | str) -> Path:
    """Return the path after checking that it can be written; also the type of an option."""
    path = Path(name)
    if not path.parent.is_dir():
        raise InvalidInputError(
            f"cannot write {path}: folder {path.parent} does not exist; make it first"
        )
    if path.is_dir():
        raise InvalidInputError(f"cannot write {path}: it is a folder; name a file in it")
    require_regular_file(path, "file", "write")
    try:
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise InvalidInputError(
            f"cannot write {path}: {error.strerror}; choose a writable folder"
        ) from error
    return path


def picture_file(name: Path | str) -> Path:
    """Return a `writable_file` with the suffix of a format of pictures."""
    path = writable_file(name)
    picture_format(path)
    return path


def file_of_kind(option: str, suffixes: Sequence[str], name: Path | str) -> Path:
    """Return a `writable_file` with one of these suffixes."""
    path = writable_file(name)
    require_choice(f"{option} {path}: suffix", path.suffix, suffixes)
    return path


def numbers(option: str, text: str, names: Sequence[str] = ()) -> list[float]:
    """Return finite numbers separated by commas or blanks, one for each of `names` if given."""
    try:
        found = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        found = [math.nan]
    wrong_count = len(found) != len(names) if names else not found
    if wrong_count or not all(map(math.isfinite, found)):
        wanted = f"{len(names)} numbers, {', '.join(names)}," if names else "numbers"
        raise InvalidInputError(f"{option} {text!r}: write {wanted} separated by commas")
    return found


def one_or_two(option: str, form: str, text: str) -> list[float]:
    """Return the one or two numbers above 0 of an option; form: how they are written."""
    found = numbers(option, text)
    if len(found) > 2 or min(found) <= 0.0:
        raise InvalidInputError(f"{option} {text!r}: write {form}")
    return found


class ProgressBar:
    """Progress bar with the time left, on standard error; outside a terminal a line per tenth.

    Args:
        label: name of the work.
        heading: line that is logged before the bar is shown first; "": none.
    """

    def __init__(self, label: str, heading: str = "") -> None:
        self._label, self._heading = label, heading
        self._began, self._first = time.perf_counter(), 0
        self._terminal = sys.stderr.isatty()
        self._tenth = -1

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """Show that `done` of `total` steps are made."""
        if self._tenth < 0:
            self._first, self._tenth = done, 0
            if self._heading:
                log(self._heading)
        elapsed = time.perf_counter() - self._began
        made = done - self._first
        left = f"{elapsed / made * (total - done):.0f} s left" if made else "estimating"
        if self._terminal:
            filled = 30 * done // max(total, 1)
            bar = "#" * filled + "-" * (30 - filled)
            end = "\n" if done == total else ""
            line = f"\r{self._label} [{bar}] {done}/{total}  {left}  {note[:40]:40}"
            print(line, end=end, file=sys.stderr, flush=True)
        elif 10 * done // max(total, 1) > self._tenth or done == total:
            self._tenth = 10 * done // max(total, 1)
            log(f"{self._label} {done}/{total}, {left}  {note}".rstrip())


def compiling() -> ProgressBar:
    """Return the bar of `jit.compile_in_processes`."""
    return ProgressBar("compiling kernels, once per machine and version")
