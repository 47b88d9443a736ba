"""Memory of a process, by the system and by the C library's allocator."""

import ctypes
import gc
import resource
from pathlib import Path


class Mallinfo(ctypes.Structure):
    """Struct that `mallinfo2` of the GNU C library returns; two of its ten sizes are used."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in ["a", "b", "c", "d", "hblkhd", "f", "g", "uordblks", "i", "j"]
    ]


def resident():
    """Resident memory of the process [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def in_use():
    """Exact bytes that C and C++ code has allocated and not freed, after Python's collector ran."""
    gc.collect()
    library = ctypes.CDLL(None)
    library.mallinfo2.restype = Mallinfo
    info = library.mallinfo2()
    return int(info.uordblks + info.hblkhd)
