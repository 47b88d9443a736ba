"""Call kernels from Python in tests; they are compiled for the given arguments and not cached."""

from numba import njit


def from_python(kernel):
    """Return a wrapper through which Python can call a kernel."""
    kernel = getattr(kernel, "dispatcher", kernel)  # of those whose source is copied: itself
    options = {
        name: value
        for name, value in kernel.targetoptions.items()
        if name not in ("no_cpython_wrapper", "nopython")
    }
    return njit(**options)(kernel.py_func)
