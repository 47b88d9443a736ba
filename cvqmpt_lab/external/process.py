"""The process of an external planner, seen from outside: started, asked, stopped between calls.

Nothing that it sends is trusted: answers are plain data of limited size, and times are taken here.
"""

import contextlib
import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
import weakref
from multiprocessing.connection import wait
from typing import Any

from cvqmpt_lab.base.errors import InvalidInputError, one_line
from cvqmpt_lab.external.worker import LENGTH, MOST_BYTES, Answer
from cvqmpt_lab.problem import PlanningProblem

START_S = 300.0  # [s] for importing and making a planner, and for preparing a problem
RUN = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from cvqmpt_lab.external.worker import main; main(int(sys.argv[2]), int(sys.argv[3]))"
)


class NoAnswer(Exception):
    """Why there is no answer: the process ended, or was late, and was ended."""

    def __init__(self, reason: str, late: bool = False) -> None:
        super().__init__(reason)
        self.late = late


class PlannerProcess:
    """A process with one planner; one that has ended is started again for the next problem.

    On Linux it is stopped while it is not asked: its threads cannot slow down other planners.
    """

    def __init__(self, name: str, module: str, attribute: str) -> None:
        self.name, self.module, self.attribute = name, module, attribute
        self.has_planned = False  # since it was started
        self._process: subprocess.Popen[bytes] | None = None
        self._owner = 0  # process that started it; a copy by fork is not its owner
        self._written, self._first = 0, b""  # bytes of its standard output, and the first ones

    def start(self) -> dict[str, Any]:
        """Import and make the planner in a new process; returns "made_by" and "origin".

        Raises InvalidInputError if that is refused.
        """
        self.stop()
        self._connection, theirs = socket.socketpair()
        with theirs:
            numbers = (str(theirs.fileno()), str(os.getpid()))
            self._process = subprocess.Popen(
                (sys.executable, "-c", RUN, json.dumps(sys.path), *numbers),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                pass_fds=(theirs.fileno(),),
                # Ctrl-C is for the process that plans; a group ends with all that it started
                start_new_session=True,
            )
        self._owner, self.has_planned = os.getpid(), False
        self._end = weakref.finalize(self, _end, self._process, self._connection, self._owner)
        try:
            words, _ = self.ask("make", self.name, self.module, self.attribute)
        except NoAnswer as error:
            why = f"no answer in {START_S:g} s" if error.late else str(error)
            raise InvalidInputError(f"planner {self.name}: importing it: {why}") from error
        self._signal("SIGSTOP")
        if "error" in words:
            self.stop()
            raise InvalidInputError(str(words.get("refused", words["error"])))
        return words

    def hand_over(self, problem: PlanningProblem) -> None:
        """Give it the next problem, which is not timed; NoAnswer where that fails."""
        while True:
            fresh = self._process is None or self._owner != os.getpid()
            try:
                if fresh:
                    self.start()
                # a copy without what the problem keeps of earlier work
                words, _ = self.ask("hand_over", problem.changed())
                if "error" in words:
                    raise NoAnswer(str(words["error"]))
                return
            except InvalidInputError as error:
                raise NoAnswer(str(error)) from error
            except NoAnswer:
                if fresh:
                    raise
                # it may have ended since the last run, with the thread that started it
                self.stop()

    def plan(self, *arguments: Any, seconds: float | None) -> Answer:
        """The planner's answer to budget and seed; NoAnswer: it ended, or after `seconds`."""
        self.has_planned = True
        answer = self.ask("plan", *arguments, seconds=seconds)
        self._signal("SIGSTOP")
        return answer

    def ask(self, *message: Any, seconds: float | None = START_S) -> Answer:
        """Answer to a message; without one, NoAnswer, and the process is ended."""
        import safetensors.numpy  # planning without external planners does not need it

        if self._process is None:
            raise NoAnswer("its process has ended")
        try:
            self._signal("SIGCONT")
            data = pickle.dumps(message)
            self._connection.settimeout(START_S)
            self._connection.sendall(len(data).to_bytes(LENGTH) + data)
            arrays = safetensors.numpy.load(self._received(seconds))
            self._read_output()
            return dict(json.loads(arrays.pop("words").tobytes())), arrays
        except NoAnswer:
            self.stop()
            raise
        except OSError as error:
            raise NoAnswer(self._how_it_ended()) from error
        except BaseException as error:
            self.stop()
            if not isinstance(error, Exception):
                raise
            raise NoAnswer(f"its answer cannot be read: {one_line(str(error))}") from error

    def stop(self) -> None:
        """End the process, and what it has started."""
        if self._process is not None:
            self._end()
            self._process = None

    def note(self, first_characters: int = 60) -> str:
        """One sentence about what it wrote to standard output since the last call, or ""."""
        size, first = self._written, self._first.decode(errors="replace")
        self._written, self._first = 0, b""
        if not size:
            return ""
        first = " ".join(first[:first_characters].split())
        return f"wrote {size} bytes to standard output, shown on standard error: {first!r}"

    def _received(self, seconds: float | None) -> bytes:
        """The bytes of an answer, once all have come."""
        assert self._process is not None
        began, data, size = time.perf_counter(), bytearray(), LENGTH
        while len(data) < size:
            left = 0.1
            if seconds is not None:
                left = min(left, began + seconds - time.perf_counter())
            if left <= 0.0:
                raise NoAnswer("interrupted", late=True)
            # asked first: what it wrote before it ended is still read
            ended = self._process.poll() is not None
            if self._connection in wait((self._connection, *self._output()), left):
                part = self._connection.recv(2**20)
                data += part
                ended = not part
            self._read_output()
            if ended:
                raise NoAnswer(self._how_it_ended())
            if size == LENGTH <= len(data):
                size += int.from_bytes(data[:LENGTH])
            if size > MOST_BYTES:
                raise NoAnswer(f"its answer has {size} bytes; at most {MOST_BYTES}")
        return bytes(data[LENGTH:size])

    def _output(self) -> tuple[Any, ...]:
        """Its standard output, while it is open."""
        stream = self._process.stdout if self._process is not None else None
        return () if stream is None or stream.closed else (stream,)

    def _read_output(self, most_parts: int = 16) -> None:
        """Show what it has written to standard output on standard error."""
        for _ in range(most_parts):
            ready: Any = wait(self._output(), 0.0) if self._output() else ()
            for stream in ready:
                part = os.read(stream.fileno(), 2**16)
                if not part:
                    stream.close()
                self._written += len(part)
                self._first = (self._first + part)[:1000]
                # standard error may be closed
                with contextlib.suppress(AttributeError, OSError, ValueError):
                    sys.stderr.write(part.decode(errors="replace"))
            if not ready:
                return

    def _how_it_ended(self) -> str:
        """End the process, and say how it had ended."""
        assert self._process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        code = self._process.poll()
        self.stop()
        if code is None:
            return "its process closed its connection"
        if code >= 0:
            return f"its process ended with {code}"
        cause = "; perhaps memory ran out" if code == -signal.SIGKILL else ""
        return f"its process was ended by {signal.Signals(-code).name}{cause}"

    def _signal(self, name: str) -> None:
        """Send a signal to the process and all that it has started; not where none would wake."""
        if sys.platform == "linux" and self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.Signals[name])


def _end(process: subprocess.Popen[bytes], connection: socket.socket, owner: int) -> None:
    if os.getpid() != owner:
        return
    connection.close()
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    if process.stdout is not None:
        process.stdout.close()
