"""The process of an external planner: started, called, and stopped between calls.

Nothing that it sends is trusted: replies are plain data of limited size, and the times are measured
in the calling process.
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
from cvqmpt_lab.external.worker import LENGTH_BYTES, MAX_REPLY_BYTES, Reply
from cvqmpt_lab.problem import PlanningProblem

START_TIMEOUT_S = 300.0  # for importing and making a planner, and for preparing a problem


class NoReply(Exception):
    """A planner's process has not replied, because it ended or was ended after its time.

    late: whether it was ended after its time.
    """

    def __init__(self, reason: str, late: bool = False) -> None:
        super().__init__(reason)
        self.late = late


class PlannerProcess:
    """A process with one planner; if it has ended, it is started again for the next problem.

    On Linux it is stopped between calls, so that its threads do not slow down other planners.
    """

    def __init__(self, name: str, module: str, attribute: str) -> None:
        self.name = name
        self.module, self.attribute = module, attribute
        self.has_planned = False  # since it was started
        self._process: subprocess.Popen[bytes] | None = None
        self._planner = 0  # id of the planner's process, leader of its group
        self._owner = 0  # id of the process that started it; a fork of that one is not the owner
        self._written, self._first = 0, b""  # number of bytes of its standard output; the first

    def start(self) -> dict[str, Any]:
        """Import and make the planner in a new process; return "made_by" and "origin".

        Raises InvalidInputError if importing or making it fails.
        """
        program = (
            "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
            "from cvqmpt_lab.external.supervisor import supervise; "
            "supervise(int(sys.argv[2]), int(sys.argv[3]))"
        )
        self.stop()
        self._connection, theirs = socket.socketpair()
        with theirs:
            numbers = (str(theirs.fileno()), str(os.getpid()))
            self._process = subprocess.Popen(
                (sys.executable, "-c", program, json.dumps(sys.path), *numbers),
                stdin=subprocess.DEVNULL,
                # pipes of its own: what it starts does not keep ours open
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                pass_fds=(theirs.fileno(),),
                # own process group: Ctrl-C does not reach it
                start_new_session=True,
            )
        self._owner, self.has_planned = os.getpid(), False
        self._end = weakref.finalize(self, _end, self._process, self._connection, self._owner)
        try:
            self._planner = self._id_of_planner()
            words, _ = self.call("make", self.name, self.module, self.attribute)
        except NoReply as error:
            why = f"no reply in {START_TIMEOUT_S:g} s" if error.late else str(error)
            raise InvalidInputError(f"planner {self.name}: importing it: {why}") from error
        self._signal("SIGSTOP")
        if "error" in words:
            self.stop()
            raise InvalidInputError(str(words.get("refused", words["error"])))
        return words

    def _id_of_planner(self) -> int:
        """Return the id of the planner's process, a child of the one that was started."""
        self._connection.settimeout(START_TIMEOUT_S)
        try:
            data = self._connection.recv(LENGTH_BYTES, socket.MSG_WAITALL)
        except OSError as error:
            raise NoReply(self._how_it_ended()) from error
        if len(data) < LENGTH_BYTES:
            raise NoReply(self._how_it_ended())
        return int.from_bytes(data)

    def hand_over(self, problem: PlanningProblem) -> None:
        """Send the next problem, which is not timed; NoReply if that fails."""
        while True:
            fresh = self._process is None or self._owner != os.getpid()
            try:
                if fresh:
                    self.start()
                # a copy without cached results
                words, _ = self.call("hand_over", problem.changed())
                if "error" in words:
                    raise NoReply(str(words["error"]))
                return
            except InvalidInputError as error:
                raise NoReply(str(error)) from error
            except NoReply:
                if fresh:
                    raise
                # it may have ended after the last run, together with the thread that started it
                self.stop()

    def plan(self, *arguments: Any, seconds: float | None) -> Reply:
        """Call the planner with budget and seed; NoReply if it ends or takes over `seconds`."""
        self.has_planned = True
        reply = self.call("plan", *arguments, seconds=seconds)
        self._signal("SIGSTOP")
        return reply

    def call(self, *message: Any, seconds: float | None = START_TIMEOUT_S) -> Reply:
        """Send a message and return the reply; if there is none, end the process: NoReply."""
        import safetensors.numpy  # planning without external planners does not need it

        if self._process is None:
            raise NoReply("its process has ended")
        try:
            self._signal("SIGCONT")
            data = pickle.dumps(message)
            self._connection.settimeout(START_TIMEOUT_S)
            self._connection.sendall(len(data).to_bytes(LENGTH_BYTES) + data)
            arrays = safetensors.numpy.load(self._received(seconds))
            self._read_output()
            return dict(json.loads(arrays.pop("words").tobytes())), arrays
        except NoReply:
            self.stop()
            raise
        except OSError as error:
            raise NoReply(self._how_it_ended()) from error
        except BaseException as error:
            self.stop()
            if not isinstance(error, Exception):
                raise
            raise NoReply(f"its reply cannot be read: {one_line(str(error))}") from error

    def stop(self) -> None:
        """End the process and its child processes."""
        if self._process is not None:
            self._end()
            self._process = None

    def note(self, first_characters: int = 60) -> str:
        """Sentence about the standard output since the last call, or "" if there was none."""
        size, first = self._written, self._first.decode(errors="replace")
        self._written, self._first = 0, b""
        if not size:
            return ""
        first = " ".join(first[:first_characters].split())
        return f"wrote {size} bytes to standard output, shown on standard error: {first!r}"

    def _received(self, seconds: float | None) -> bytes:
        """Bytes of a complete reply."""
        assert self._process is not None
        began = time.perf_counter()
        data, size = bytearray(), LENGTH_BYTES  # received bytes; number of bytes to receive
        while len(data) < size:
            left = 0.1
            if seconds is not None:
                left = min(left, began + seconds - time.perf_counter())
            if left <= 0.0:
                raise NoReply("interrupted", late=True)
            # test for exit first, then drain the pipe: its last message is not lost
            ended = self._process.poll() is not None
            if self._connection in wait((self._connection, *self._output()), left):
                part = self._connection.recv(2**20)
                data += part
                ended = not part
            self._read_output()
            if ended:
                raise NoReply(self._how_it_ended())
            if size == LENGTH_BYTES <= len(data):
                size += int.from_bytes(data[:LENGTH_BYTES])
            if size > MAX_REPLY_BYTES:
                raise NoReply(
                    f"its reply has {size} bytes; at most {MAX_REPLY_BYTES} are read: return less"
                )
        return bytes(data[LENGTH_BYTES:size])

    def _output(self) -> tuple[Any, ...]:
        """Its standard output and standard error, without what is closed."""
        process = self._process
        streams = () if process is None else (process.stdout, process.stderr)
        return tuple(stream for stream in streams if stream is not None and not stream.closed)

    def _read_output(self, most_parts: int = 16) -> None:
        """Copy its standard output and standard error to standard error."""
        for _ in range(most_parts):
            ready: Any = wait(self._output(), 0.0) if self._output() else ()
            for stream in ready:
                part = os.read(stream.fileno(), 2**16)
                if not part:
                    stream.close()
                if self._process is not None and stream is self._process.stdout:
                    self._written += len(part)
                    self._first = (self._first + part)[:1000]
                # standard error may be closed
                with contextlib.suppress(AttributeError, OSError, ValueError):
                    sys.stderr.write(part.decode(errors="replace"))
            if not ready:
                return

    def _how_it_ended(self) -> str:
        """End the process if it still runs, and describe how it ended."""
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
        """Send a signal to the planner and its child processes; only on Linux."""
        if sys.platform == "linux" and self._process is not None and self._planner:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._planner, signal.Signals[name])


def _end(process: subprocess.Popen[bytes], connection: socket.socket, owner: int) -> None:
    """End a process and all that it started; does nothing in a fork of the process `owner`."""
    if os.getpid() != owner:
        return
    connection.close()
    process.terminate()  # the supervisor ends what is below it, and then itself
    try:
        process.wait(10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    for stream in (process.stdout, process.stderr):
        if stream is not None:
            stream.close()
