"""Options and checks that commands share; light, so that training runs on a bare machine."""

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
from cvqmpt_lab.base.files import finite, require_regular_file

# By names of options (`-v --verbose`), arguments of argparse's add_argument; by a title, a group.
Options = Mapping[str, Mapping[str, Any]]
ONE_OF, EXACTLY_ONE_OF = "one of", "exactly one of"  # titles of options that exclude each other
REPEATED: Mapping[str, Any] = {"action": "append", "default": []}
FLAG: Mapping[str, Any] = {"action": "store_true"}


def option(text: str, **settings: Any) -> dict[str, Any]:
    """An option: its help and other arguments of argparse's add_argument."""
    return {"help": text, **settings}


WEIGHTS: Options = {
    "--model": option("folder of the planner's weights (those of the package)", metavar="DIR")
}


def _number(
    kind: type, holds: Callable[[float], bool], must: str, most: float = sys.float_info.max
) -> Callable[[str], Any]:
    """The type of an option that is a number which meets a condition; most: that it may be."""

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
SEED: Options = {
    "--seed": option("seed of all randomness (0)", type=not_negative_int, default=0, metavar="S")
}


REACH: Options = {
    "--reach": option(
        "longest extension of trees towards a sample [rad], inf: none (the planner's own)",
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
    """Refuse options, by their names in args, that do not go with others; why: after the option."""
    for name in names:
        if getattr(args, name):
            raise InvalidInputError(f"--{name.replace('_', '-')} {why}")


def log(text: str) -> None:
    """Print a line on standard error at once."""
    print(text, file=sys.stderr, flush=True)


def own_command() -> list[str]:
    """The words of this command line, for provenance."""
    return ["cvqmpt", *sys.argv[1:]]


def add_options(parser: Any, options: Options) -> None:
    """Add options to an argparse parser, or to a group of one."""
    for names, settings in options.items():
        if names in (ONE_OF, EXACTLY_ONE_OF):
            required = names == EXACTLY_ONE_OF
            add_options(parser.add_mutually_exclusive_group(required=required), settings)
        elif all(isinstance(setting, Mapping) for setting in settings.values()):
            add_options(parser.add_argument_group(names), settings)
        else:
            parser.add_argument(*names.split(), **settings)


def as_json(data: dict[str, Any]) -> str:
    """Json text; undefined numbers are null."""
    return json.dumps(finite(data), indent=1, allow_nan=False)


def writable_file(name: Path | str) -> Path:
    """The path, after checking that a file can be made there; also the type of an option."""
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


def file_of_kind(option: str, suffixes: Sequence[str], name: Path | str) -> Path:
    """A `writable_file` with one of these suffixes."""
    path = writable_file(name)
    require_choice(f"{option} {path}: suffix", path.suffix, suffixes)
    return path


def numbers(option: str, text: str, names: Sequence[str] = ()) -> list[float]:
    """Finite numbers separated by commas or blanks; as many as names, if there are any."""
    try:
        found = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        found = [math.nan]
    if not found or not all(map(math.isfinite, found)) or len(found) != (len(names) or len(found)):
        wanted = (
            f"{len(names)} numbers, {', '.join(names)}" if names else "numbers separated by commas"
        )
        raise InvalidInputError(f"{option} {text!r}: write {wanted}")
    return found


class ProgressBar:
    """A bar with the time left on standard error; a line per tenth where it is no terminal."""

    def __init__(self, label: str) -> None:
        self._label, self._began, self._first = label, time.perf_counter(), 0
        self._terminal = sys.stderr.isatty()
        self._tenth = -1

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """Show `done` of `total`."""
        if self._tenth < 0:
            self._first, self._tenth = done, 0
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
