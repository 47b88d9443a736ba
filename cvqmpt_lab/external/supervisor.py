"""Program of the process between the caller and an external planner: it ends all that they start.

The planner is imported in a child of it. Processes that a planner started are ended with it, in
whatever way they were made: in other groups or sessions, as daemons, stopped. On Linux an orphan
becomes a child of the supervisor; elsewhere, only the planner's group is ended.
"""

import ctypes
import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

LINUX = sys.platform == "linux"
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36


def supervise(connection: int, owner: int) -> None:
    """Run a planner in a child process, whose id is sent first, and end all that it started.

    The exit code is that of the child.

    Args:
        connection: file descriptor of the socket to the owner.
        owner: id of the process that started this one; all ends when that one ends.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    if LINUX:
        system = ctypes.CDLL(None)
        system.prctl(PR_SET_CHILD_SUBREAPER, 1)
        system.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != owner:
            return
    supervisor, child = os.getpid(), os.fork()
    if child == 0:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.setsid()  # a stopped planner does not stop the supervisor
        from cvqmpt_lab.external.worker import main

        main(connection, supervisor)
        return
    status = 0
    try:
        os.write(connection, child.to_bytes(8))
        os.close(connection)
        status = _ended(child)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        end_started(child)
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)
        os.kill(supervisor, number)
    os._exit(os.waitstatus_to_exitcode(status))


def _ended(child: int) -> int:
    """Wait until a child has ended, and return its status; orphans are collected, too."""
    while True:
        ended, status = os.waitpid(-1, 0)
        if ended == child:
            return status


def end_started(child: int, seconds: float = 5.0) -> None:
    """Kill all processes below this one, and the group of a child; wait until none is left."""
    until = time.monotonic() + seconds
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)
    while (living := _below(os.getpid())) and time.monotonic() < until:
        # orphans come back as children of this process, which does not end before
        for process in living:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        time.sleep(0.002)


def _below(ancestor: int) -> list[int]:
    """Return the ids of all processes below one, from /proc; none where that is not there."""
    parents = dict[int, int]()
    for place in Path("/proc").glob("[0-9]*") if LINUX else ():
        with suppress(OSError, ValueError):
            stat = (place / "stat").read_text(encoding="utf-8", errors="replace")
            # after the name in brackets, which may contain anything: state and parent
            parents[int(place.name)] = int(stat.rpartition(")")[2].split()[1])
    found, level = list[int](), {ancestor}
    while level := {process for process, parent in parents.items() if parent in level}:
        found += level
    return found
