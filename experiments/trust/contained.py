"""Hostile input in a process of its own: bounded memory and time, and every attempt to reach beyond is noticed."""

import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import LONGEST_LINE, CvqmptError
from experiments.trust.check import Trial

MEMORY = 2**30  # [bytes] more than the process had at first
HANG = 20.0  # [s] of wall time after which an input is given up
FORBIDDEN = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect", "socket.bind")
CHANGING = (
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.mkdir",
    "os.link",
    "os.symlink",
    "os.chmod",
    "shutil.rmtree",
)

Use = Callable[[Path], object]


@dataclass(frozen=True)
class Hostile:
    """Files of one kind."""

    file: str
    """Name that they are given."""
    variant: Callable[[np.random.Generator], bytes]
    """Makes one."""
    use: Use
    """Reads and uses one; any CvqmptError in one line is a good answer, and so is none."""
    seconds: float = 1.0
    """Processor time [s] that this may take."""


def attacked(hostile: Hostile, count: int, first: int = 0) -> Trial:
    """Use so many variants; a fault for each that crashes, hangs, takes too much, or reaches beyond its folder."""
    context = multiprocessing.get_context("fork")
    reached = context.Value("q", first)
    faults: list[str] = []
    end = first + count
    hostile.variant(np.random.default_rng(first))  # makes the good file once, for all processes
    with tempfile.TemporaryDirectory() as folder:
        while reached.value < end:
            receiver, sender = context.Pipe(duplex=False)
            process = context.Process(target=_child, args=(hostile, Path(folder), end, reached, sender))
            process.start()
            sender.close()
            _watch(process, reached)
            while receiver.poll():
                try:
                    faults.append(receiver.recv())
                except EOFError:
                    break
            if reached.value < end:
                faults.append(f"{hostile.file}, seed {reached.value}: {_death(process.exitcode)}")
                reached.value += 1
    return Trial(count, faults)


def _watch(process: multiprocessing.process.BaseProcess, reached: "Synchronized[int]") -> None:
    """Wait for the process, and kill it when one input takes too long."""
    seen, since = reached.value, time.monotonic()
    while process.is_alive():
        process.join(0.05)
        if reached.value != seen:
            seen, since = reached.value, time.monotonic()
        elif time.monotonic() - since > HANG:
            process.kill()
    process.join()


def _death(code: int | None) -> str:
    if code == -signal.SIGKILL:
        return f"killed: no answer in {HANG:g} s, or out of memory"
    return f"the process ended with {signal.Signals(-code).name if code and code < 0 else code}"


def _child(hostile: Hostile, folder: Path, end: int, reached: "Synchronized[int]", sender) -> None:
    """Use variants from `reached` to `end`, reporting faults; the first one twice, to load what reading needs."""
    path = folder / hostile.file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(hostile.variant(np.random.default_rng(reached.value)))
    _answer(hostile, path)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    sys.dont_write_bytecode = True  # Python's own files beside modules that are imported late
    beyond: list[str] = []
    watching = [False]
    sys.addaudithook(lambda event, args: _note(event, args, folder, beyond) if watching[0] else None)
    while reached.value < end:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(hostile.variant(np.random.default_rng(reached.value)))
        beyond.clear()
        watching[0] = True
        fault = _answer(hostile, path)
        watching[0] = False
        for what in (fault, *beyond):
            if what:
                sender.send(f"{hostile.file}, seed {reached.value}: {what}")
        reached.value += 1
    os._exit(0)  # at once: what libraries do at exit is not what is tried here


def _answer(hostile: Hostile, path: Path) -> str:
    """What is wrong with how an input is taken, or ""."""
    began = time.process_time()
    fault = ""
    try:
        hostile.use(path)
    except CvqmptError as error:
        text = str(error)
        if len(text) > LONGEST_LINE or not text.isprintable():
            fault = f"an error of {len(text)} characters, not one printable line: {text[:80]!r}"
    except BaseException as error:
        fault = f"{type(error).__name__}: {str(error)[:200]!r}"
    took = time.process_time() - began
    return fault or (f"took {took:.1f} s" if took > hostile.seconds else "")


def _note(event: str, arguments: tuple, folder: Path, beyond: list[str]) -> None:
    """Remember what an input must not lead to."""
    if event.startswith(FORBIDDEN):
        beyond.append(f"{event} {str(arguments)[:100]}")
    elif (event in CHANGING or (event == "open" and _writes(arguments))) and not _inside(
        arguments[0], folder
    ):
        beyond.append(f"{event} {str(arguments)[:100]} outside its folder")


def _inside(path: object, folder: Path) -> bool:
    return isinstance(path, str | bytes | os.PathLike) and Path(os.fsdecode(path)).resolve().is_relative_to(
        folder
    )


def _writes(arguments: tuple) -> bool:
    flags = arguments[2]
    return isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
