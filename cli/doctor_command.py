"""`cvqmpt doctor`: what is installed here, what is missing and how to get it."""

import argparse
import os
import platform
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata

from packaging.requirements import Requirement

from cli.main import THREADS
from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.show.viewer import check_viewer
from cvqmpt_lab.vqmpt.weights import SHIPPED, read_model, resolve_model, weights_digest

EXAMPLES = ("cvqmpt doctor",)
PROJECT = "cvqmpt-lab"


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    what: str
    says: str
    cure: str = ""
    """How to mend it; empty when it is fine."""
    needed: bool = True
    """Whether planning fails without it."""

    def lines(self) -> str:
        """As a person reads it."""
        state = "ok" if not self.cure else "BROKEN" if self.needed else "without"
        text = f"{self.says}; {self.cure}" if self.cure else self.says
        return textwrap.fill(
            text,
            100,
            initial_indent=f"{state:8} {self.what:10} ",
            subsequent_indent=" " * 20,
            break_long_words=False,
        )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """None."""


def run(args: argparse.Namespace) -> int:
    """Look at everything; exit code 1 when something that planning needs is broken."""
    broken = False
    for finding in (*_machine(), *_packages(), *_weights(), _kernels(), _display()):
        print(finding.lines())
        broken |= bool(finding.cure) and finding.needed
    return 1 if broken else 0


def _machine() -> Iterator[Finding]:
    cores = f"{len(os.sched_getaffinity(0))} of {os.cpu_count()} cores for this process"
    yield Finding("machine", f"Python {platform.python_version()}, {platform.platform()}, {cores}")
    yield Finding("threads", ", ".join(f"{name}={os.environ.get(name, 'not set')}" for name in THREADS))


def _packages() -> Iterator[Finding]:
    """What the project needs, and what each of its extras would add."""
    try:
        declared = [Requirement(text) for text in metadata.requires(PROJECT) or ()]
    except metadata.PackageNotFoundError:
        yield Finding("packages", f"{PROJECT} itself is not installed", "pip install -e . in its folder")
        return
    extras = sorted(metadata.metadata(PROJECT).get_all("Provides-Extra") or ())
    for extra in ("", *extras):
        asked = [item for item in declared if _asks_for(item, extra)]
        unfit = [str(item).partition(";")[0].strip() for item in asked if not _fits(item)]
        versions = ", ".join(f"{item.name} {_version(item.name)}" for item in asked)
        cure = (
            f"pip install {' '.join(map(repr, unfit))}" if not extra else f"pip install '{PROJECT}[{extra}]'"
        )
        yield Finding(
            f"[{extra}]" if extra else "packages", versions, cure if unfit else "", needed=not extra
        )


def _asks_for(item: Requirement, extra: str) -> bool:
    """Whether a requirement is of an extra, or, without one, of the package itself."""
    alone = item.marker is None or item.marker.evaluate({"extra": ""})
    return (
        alone
        if not extra
        else not alone and item.marker is not None and item.marker.evaluate({"extra": extra})
    )


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "MISSING"


def _fits(item: Requirement) -> bool:
    version = _version(item.name)
    return version != "MISSING" and item.specifier.contains(version, prereleases=True)


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
        return Finding(
            "kernels", f"numba cannot be used: {error}", "pip install --force-reinstall numba llvmlite"
        )
    if folder() is None:
        return Finding(
            "kernels", "no place to keep them", "set NUMBA_CACHE_DIR to a writable folder", needed=False
        )
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
