"""Processes that work for another one and do not outlive it."""

import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor

from cvqmpt_lab.orphans import end_with_parent


def worker_pool(workers: int) -> ProcessPoolExecutor:
    """So many worker processes."""
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    return ProcessPoolExecutor(workers, context, initializer=end_with_parent, initargs=(os.getpid(),))
