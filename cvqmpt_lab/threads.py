"""How many threads the numeric libraries use."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

from threadpoolctl import ThreadpoolController


@contextmanager
def one_thread() -> Iterator[None]:
    """Let BLAS and OpenMP use one thread meanwhile.

    How a product is split among threads decides how its sums are rounded, so paths of learned methods would depend
    on the number of cores; and the products of one plan are too small to gain from more.
    """
    with _libraries(torch="torch" in sys.modules).limit(limits=1):
        yield


@lru_cache(maxsize=2)
def _libraries(*, torch: bool) -> ThreadpoolController:
    """The libraries that are loaded; torch brings some of its own, and they are looked for anew once it is there."""
    return ThreadpoolController()
