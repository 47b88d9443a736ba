"""Ctrl-C that waits until a training is saved."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """A list that a first Ctrl-C or SIGTERM makes true; a second one acts as usual."""
    received: list[int] = []
    earlier: dict[signal.Signals, Any] = {}

    def give_back() -> None:
        for number, handler in earlier.items():
            signal.signal(number, handler)

    def note(number: int, frame: object) -> None:
        received.append(number)
        give_back()

    try:
        for each in (signal.SIGINT, signal.SIGTERM):
            earlier[each] = signal.getsignal(each)
            signal.signal(each, note)
    except ValueError:  # not in the main thread: no signals here
        earlier.clear()
    try:
        yield received
    finally:
        give_back()
