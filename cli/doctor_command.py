"""`cvqmpt doctor`: what is installed here, what is missing and how to get it."""

import argparse
import os
import platform
import textwrap
from collections.abc import Iterator, Sequence
from importlib import metadata
from typing import NamedTuple

from packaging.requirements import Requirement

from cli.main import THREADS
from cvqmpt_lab.errors import CvqmptError, install_command
from cvqmpt_lab.show.viewer import check_viewer
from cvqmpt_lab.vqmpt.weights import SHIPPED, read_model, resolve_model, weights_digest

EXAMPLES = ("cvqmpt doctor",)
PROJECT = "cvqmpt-lab"


class Finding(NamedTuple):
    """One thing that was checked."""

    what: str
    says: str
    cure: str = ""  # how to mend it; empty when it is fine
    needed: bool = True  # whether planning fails without it


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """None."""


def run(args: argparse.Namespace) -> int:
    """Check everything; exit code 1 when something that planning needs is broken."""
    found = [*_machine(), *_packages(), *_weights(), _kernels(), _display()]
    for what, says, cure, needed in found:
        state = "ok" if not cure else "BROKEN" if needed else "without"
        head, text = f"{state:8} {what:10} ", f"{says}; {cure}" if cure else says
        print(textwrap.fill(head + text, 100, subsequent_indent=" " * 20, break_long_words=False))
    return 1 if any(item.cure and item.needed for item in found) else 0


def _machine() -> Iterator[Finding]:
    cores = f"{len(os.sched_getaffinity(0))} of {os.cpu_count()} cores for this process"
    yield Finding("machine", f"Python {platform.python_version()}, {platform.platform()}, {cores}")
    yield Finding(
        "threads", ", ".join(f"{name}={os.environ.get(name, 'not set')}" for name in THREADS)
    )


def _packages() -> Iterator[Finding]:
    """What the project needs, and what each of its extras would add."""
    try:
        declared = [Requirement(text) for text in metadata.requires(PROJECT) or ()]
    except metadata.PackageNotFoundError:
        yield Finding(
            "packages", f"{PROJECT} itself is not installed", "pip install -e . in its folder"
        )
        return
    always = [
        item for item in declared if item.marker is None or item.marker.evaluate({"extra": ""})
    ]
    yield _finding("packages", always)
    for extra in sorted(metadata.metadata(PROJECT).get_all("Provides-Extra") or ()):
        more = [item for item in declared if item.marker and item.marker.evaluate({"extra": extra})]
        yield _finding(extra, [item for item in more if item not in always], extra=True)


def _finding(name: str, asked: Sequence[Requirement], extra: bool = False) -> Finding:
    """What of the packages that are asked for is there, and how to get the rest."""
    versions, missing = [], []
    for item in asked:
        try:
            version = metadata.version(item.name)
        except metadata.PackageNotFoundError:
            version = "MISSING"
        versions.append(f"{item.name} {version}")
        if version == "MISSING" or not item.specifier.contains(version, prereleases=True):
            missing.append(repr(str(item).partition(";")[0].strip()))
    how = install_command(name) if extra else f"pip install {' '.join(missing)}"
    cure = how if missing else ""
    return Finding(f"[{name}]" if extra else name, ", ".join(versions), cure, needed=not extra)


def _weights() -> Iterator[Finding]:
    """Every byte of the shipped weights is read and compared with its digest."""
    for name in SHIPPED:
        try:
            folder = resolve_model(name)
            read_model(folder)
            yield Finding(name, f"weights sha256 {weights_digest(folder)[:16]}, {folder}")
        except CvqmptError as error:
            yield Finding(name, str(error), f"install {PROJECT} again")


def _kernels() -> Finding:
    try:
        from cvqmpt_lab.jit import compiled_before, folder
    except ImportError as error:
        cure = "pip install --force-reinstall numba llvmlite"
        return Finding("kernels", f"numba cannot be used: {error}", cure)
    if folder() is None:
        cure = "set NUMBA_CACHE_DIR to a writable folder"
        return Finding("kernels", "no place to keep them", cure, needed=False)
    if not compiled_before():
        return Finding("kernels", f"not compiled yet in {folder()}", "cvqmpt warmup", needed=False)
    return Finding("kernels", f"compiled in {folder()}")


def _display() -> Finding:
    try:
        check_viewer()
    except CvqmptError:
        cure = "open recordings where there is one: rerun RUN.rrd"
        return Finding("display", "none; pictures and films need none", cure, needed=False)
    return Finding("display", "the rerun viewer can open a window")
