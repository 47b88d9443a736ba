"""Kernels called from Python, for tests: compiled for the arguments given and kept nowhere."""

from numba import njit


def from_python(kernel):
    """A kernel with a wrapper through which Python can call it."""
    kernel = getattr(kernel, "dispatcher", kernel)  # of those whose source is copied: itself
    options = {
        name: value
        for name, value in kernel.targetoptions.items()
        if name not in ("no_cpython_wrapper", "nopython")
    }
    return njit(**options)(kernel.py_func)
