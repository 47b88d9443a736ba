"""Read hostile files in a process of bounded memory and time; record access outside its folder."""

import multiprocessing
import os
import resource
import sys
import tempfile
import time
from concurrent.futures import TimeoutError
from contextlib import contextmanager
from pathlib import Path

from pebble import ProcessExpired, ProcessPool

from cvqmpt_lab.base.errors import MAX_MESSAGE_CHARACTERS, CvqmptError

MEMORY = 2**30  # [bytes] more than the process had at first
HANG = 20.0  # [s] of wall time after which a file is given up
FORBIDDEN = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn")
FORBIDDEN += ("socket.connect", "socket.bind")
CHANGING = ("remove", "rename", "rmdir", "mkdir", "link", "symlink", "chmod")

# limits of the process that reads:
reader, folder = None, Path()
beyond = []  # what the file that is being read led to
watching = False


@contextmanager
def judge(reader):
    """Yield a function that maps the content of a file to the reader's fault, or ""."""

    def fault(content):
        try:
            return pool.schedule(answer, args=(content,), timeout=HANG).result()
        except TimeoutError:
            return f"no answer in {HANG:g} s"
        except ProcessExpired as end:
            return f"the process ended with {end.exitcode}"

    with (
        tempfile.TemporaryDirectory() as folder,
        ProcessPool(1, context=multiprocessing.get_context("fork"), initializer=confine,
                    initargs=(reader, Path(folder))) as pool,
    ):  # fmt: skip
        yield fault


def confine(of_reader, in_folder):
    """Read a valid file, which imports all modules; then limit and watch this process."""
    global reader, folder
    reader, folder = of_reader, in_folder
    answer(reader.good())
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    sys.dont_write_bytecode = True  # Python's own files beside modules that are imported late
    sys.addaudithook(lambda event, arguments: note(event, arguments) if watching else None)


def answer(content):
    """Use the file once; return the fault, or "". A CvqmptError in one line is no fault."""
    global watching
    path = folder / reader.file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    beyond.clear()
    fault, began, watching = "", time.process_time(), True
    try:
        reader.use(path)
    except CvqmptError as error:
        text = str(error)
        if len(text) > MAX_MESSAGE_CHARACTERS or not text.isprintable():
            fault = f"an error of {len(text)} characters, not one printable line: {text[:80]!r}"
    except BaseException as error:
        fault = f"{type(error).__name__}: {str(error)[:200]!r}"
    watching, took = False, time.process_time() - began
    if took > reader.seconds:
        fault = fault or f"took {took:.1f} s"
    return "; ".join((*([fault] if fault else ()), *beyond))


def note(event, arguments):
    """Record an event that no file may cause."""
    changes = event.removeprefix("os.") in CHANGING or (event == "open" and writes(arguments[2]))
    if event.startswith(FORBIDDEN) or (changes and not inside(arguments[0])):
        beyond.append(f"{event} {str(arguments)[:100]}")


def inside(path):
    named = isinstance(path, str | bytes | os.PathLike)
    return named and Path(os.fsdecode(path)).resolve().is_relative_to(folder)


def writes(flags):
    return isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
