"""`cvqmpt doctor`, `warmup` and `bench`: checks and times of this machine."""

import argparse
import json
import os
import platform
import textwrap
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement

from cvqmpt_lab.base import arithmetic
from cvqmpt_lab.base.errors import CvqmptError, install_command, require_installed
from cvqmpt_lab.benchmarks.results.provenance import cpu_facts
from cvqmpt_lab.cli.main import COMMANDS as COMMAND_NAMES
from cvqmpt_lab.cli.main import THREADS, parser_with
from cvqmpt_lab.cli.options import (
    FLAG,
    Options,
    ProgressBar,
    compiling,
    one_of,
    option,
    own_command,
    positive_int,
    refuse_given,
)

BENCHES = ("stages", "sizes", "paper-check", "paper-seconds")


class Finding(NamedTuple):
    """Result of one check of `cvqmpt doctor`."""

    what: str
    says: str
    cure: str = ""  # how to repair it; empty if nothing is wrong
    needed: bool = True  # whether planning fails without it


def doctor(args: argparse.Namespace) -> int:
    """Check everything; return 1 if something that planning needs is broken."""
    cores = f"{len(os.sched_getaffinity(0))} of {os.cpu_count()} cores for this process"
    threads = [f"{name}={os.environ.get(name, 'not set')}" for name in THREADS]
    found = [
        Finding("machine", f"Python {platform.python_version()}, {platform.platform()}, {cores}"),
        Finding("processor", ", ".join(dict.fromkeys(cpu_facts(r"^model name\s*: (.*)$")))),
        Finding("threads", ", ".join(threads)),
        _arithmetic(),
        *_packages(),
        *_weights(),
        _kernels(),
    ]
    for what, says, cure, needed in found:
        state, text = "ok", says
        if cure:
            state = "BROKEN" if needed else "without"
            text = f"{says}; {cure}"
        line = f"{state:8} {what:10} {text}"
        print(textwrap.fill(line, 100, subsequent_indent=" " * 20, break_long_words=False))
    broken = [item.what for item in found if item.cure and item.needed]
    without = [item.what for item in found if item.cure and not item.needed]
    ends = f"BROKEN: {', '.join(broken)}" if broken else "OK"
    print(f"{ends}; without: {', '.join(without)}" if without else ends)
    return 1 if broken else 0


def _arithmetic() -> Finding:
    """Return what computes here, and variables that say otherwise."""
    given = arithmetic.GIVEN
    try:
        found = arithmetic.facts()
    except ImportError as error:
        return Finding("arithmetic", f"unknown: {error}", "see packages", needed=False)
    says = ", ".join(f"{name} {used}" for name, used in found.items())
    other = [f"{n}={given[n]}" for n in given if given[n] != arithmetic.PINNED[n]]
    if other:
        native = os.environ.get(arithmetic.NATIVE)
        what = "is taken as the libraries take it" if native else "was replaced"
        says = f"{says}; {' '.join(other)} {what}"
    cure = "" if arithmetic.is_pinned() else f"{arithmetic.EFFECT} (docs/guard.md)"
    return Finding("arithmetic", says, cure, needed=False)


def _packages() -> Iterator[Finding]:
    """Check the packages of the project, and those of each extra."""
    try:
        declared = [Requirement(text) for text in metadata.requires("cvqmpt-lab") or ()]
    except metadata.PackageNotFoundError:
        cure = "pip install -e . in its folder"
        yield Finding("packages", "cvqmpt-lab itself is not installed", cure)
        return
    always = [one for one in declared if one.marker is None or one.marker.evaluate({"extra": ""})]
    yield _finding("packages", always)
    for extra in sorted(metadata.metadata("cvqmpt-lab").get_all("Provides-Extra") or ()):
        more = [one for one in declared if one.marker and one.marker.evaluate({"extra": extra})]
        yield _finding(extra, [one for one in more if one not in always], extra=True)


def _finding(name: str, asked: Sequence[Requirement], extra: bool = False) -> Finding:
    """Return which of these packages are installed, and how to install the rest."""
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
    """Read all shipped weights and compare their digests."""
    from cvqmpt_lab.vqmpt.weights import SHIPPED, read_model, resolve_model, weights_digest

    for name in SHIPPED:
        try:
            folder = resolve_model(name)
            read_model(folder)
            yield Finding(name, f"weights sha256 {weights_digest(folder)[:16]}, {folder}")
        except CvqmptError as error:
            yield Finding(name, str(error), "install cvqmpt-lab again")


def _kernels() -> Finding:
    try:
        from cvqmpt_lab.base import jit
    except ImportError as error:
        cure = "pip install --force-reinstall numba llvmlite"
        return Finding("kernels", f"numba cannot be used: {error}", cure)
    if jit.folder() is None:
        cure = "set NUMBA_CACHE_DIR to a writable folder"
        return Finding("kernels", "no folder to store them", cure, needed=False)
    if not jit.compiled_before():
        return Finding(
            "kernels", f"not compiled yet in {jit.folder()}", "cvqmpt warmup", needed=False
        )
    return Finding("kernels", f"compiled in {jit.folder()}")


def warmup(args: argparse.Namespace) -> None:
    """Compile every kernel ahead of time, or load compiled ones."""
    from cvqmpt_lab.planning.warm_up import compile_kernels

    seconds = compile_kernels(compiling())
    print(f"kernels ready after {seconds:.1f} s")


def completion(args: argparse.Namespace) -> None:
    """Print the script by which a shell completes commands and options."""
    require_installed("shtab", "completion", "completion")
    import shtab

    print(shtab.complete(parser_with(COMMAND_NAMES), shell=args.shell))


def bench(args: argparse.Namespace) -> None:
    """Measure and print a table."""
    from cvqmpt_lab.experiments.bench.paper_check import paper_check
    from cvqmpt_lab.experiments.bench.paper_seconds import (
        paper_seconds,
        ratios,
        write_paper_seconds,
    )
    from cvqmpt_lab.experiments.bench.size_times import size_times
    from cvqmpt_lab.experiments.bench.stage_times import stage_times, tuning_problems
    from cvqmpt_lab.planning.warm_up import compile_kernels

    if args.bench != "paper-seconds":
        refuse_given(args, ("out",), "goes with bench paper-seconds")
    compile_kernels(compiling())
    if args.bench == "stages":
        figures = stage_times(args.problems)
    elif args.bench == "sizes":
        figures = size_times(args.problems)
    elif args.bench == "paper-seconds":
        runs = paper_seconds(tuning_problems(args.problems), ProgressBar("paper-seconds"))
        figures = ratios(runs)
        if args.out:
            write_paper_seconds(args.out, runs, own_command())
    else:
        figures = paper_check(tuning_problems(1)[0])
    if args.json:
        print(json.dumps({"figures": [figure._asdict() for figure in figures]}, indent=1))
        return
    width = max(len(figure.name) for figure in figures)
    for figure in figures:
        spread = f"  [{figure.low:.4g} .. {figure.high:.4g}]" if figure.low != figure.high else ""
        print(f"{figure.name:{width}}  {figure.median:.4g} {figure.unit}{spread}")


OPTIONS: Options = {
    "bench": option(", ".join(BENCHES), type=one_of("bench", BENCHES)),
    "--problems": option(
        "number of problems for stages, sizes and paper-seconds (20)",
        type=positive_int,
        default=20,
        metavar="N",
    ),
    "--json": option("print one json object instead of the report", **FLAG),
    "--out": option(
        "for paper-seconds: folder for runs, ratios and provenance", type=Path, metavar="DIR"
    ),
}
SHELLS = ("bash", "zsh")
SHELL: Options = {"shell": option(", ".join(SHELLS), type=one_of("shell", SHELLS))}
COMMANDS = {
    "doctor": (doctor, {}),
    "warmup": (warmup, {}),
    "completion": (completion, SHELL),
    "bench": (bench, OPTIONS),
}
