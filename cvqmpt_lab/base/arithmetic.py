"""One arithmetic on every x86-64 processor with AVX2: the same bits on Intel and AMD.

numba compiles for the processor that it finds, and numpy and OpenBLAS choose among kernels by it.
These round differently in the last bit, after which a random search takes another way. `pin` makes
all of them use x86-64-v3 (AVX2 and fused multiply-add, in processors since 2013). It must run
before they are imported: ``import cvqmpt_lab`` runs it. CVQMPT_NATIVE=1 leaves them as they are.
"""

import os
import sys
from functools import cache
from pathlib import Path

TARGET = "x86-64-v3"
BLAS = "Haswell"  # OpenBLAS's name of a processor with AVX2 and without AVX-512
PINNED = {
    "NUMBA_CPU_NAME": TARGET,
    "NUMBA_CPU_FEATURES": "",  # none beside those of TARGET
    "OPENBLAS_CORETYPE": BLAS,
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",  # all that numpy has above V3
}
GIVEN = {name: os.environ[name] for name in PINNED if name in os.environ}
"""Values of the variables before they were pinned here; a parent process may have pinned them."""
NATIVE = "CVQMPT_NATIVE"
LIBRARY_TUNING = "GLIBC_TUNABLES"
# flags in /proc/cpuinfo of what x86-64-v3 has and x86-64-v2 has not
NEEDED = {"abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"}
EFFECT = "counts and paths may differ from those of other machines"


def pin() -> None:
    """Set the variables; one line of the log says what cannot be pinned here."""
    if os.environ.get(NATIVE):
        return
    fault, cure = _unable(), ""
    if not fault:
        os.environ.update(PINNED)
        if GIVEN == PINNED:  # a parent process set them before anything was imported here
            return
        uses = {"numpy": numpy_uses, "numba": numba_uses}
        early = {name: use() for name, use in uses.items() if name in sys.modules}
        unlike = [f"{name} (which uses {used})" for name, used in early.items() if used != TARGET]
        if unlike:
            fault = f"{' and '.join(unlike)} was imported before cvqmpt_lab"
            cure = "import cvqmpt_lab first, or "
    if fault:
        import logging  # takes 6 ms

        logging.getLogger("cvqmpt").warning(f"{fault}: {EFFECT}; {cure}{NATIVE}=1 hides this line")


def _unable() -> str:
    """Return why this machine cannot compute as TARGET does, or ""."""
    machine = os.uname().machine if hasattr(os, "uname") else sys.platform
    if machine != "x86_64":
        return f"this processor is {machine}, not x86_64"
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8", errors="replace") as lines:
            flags = next((line.split() for line in lines if line.startswith("flags")), [])
    except OSError:
        return "no /proc/cpuinfo names the instructions of this processor"
    missing = sorted(NEEDED - {*flags})
    return f"this processor has no {', '.join(missing)}" if missing else ""


def numba_uses() -> str:
    """Return the processor that numba compiles for in this process, with its features."""
    from numba.core.registry import cpu_target

    _, processor, features = cpu_target.target_context.codegen().magic_tuple()
    added = [f for f in ("+avx2", "+fma", "+avx512f") if f in features.split(",")]
    return " ".join([processor, *added])


def numpy_uses() -> str:
    """Return TARGET, or the kernels that numpy and the OpenBLAS of numpy and scipy use."""
    from threadpoolctl import threadpool_info

    from cvqmpt_lab.base.caches import numpy_instructions  # imports numpy

    sets = numpy_instructions()
    blas = sorted({one["architecture"] for one in threadpool_info() if "architecture" in one})
    if (sets, blas) == (["X86_V3"], [BLAS]):
        return TARGET
    return " ".join([*sets, "OpenBLAS", *blas])


@cache
def is_pinned() -> bool:
    """Return whether this process computes as every x86-64 processor with AVX2 does."""
    return numba_uses() == numpy_uses() == TARGET


def facts() -> dict[str, str]:
    """Return what computes in this process; processes with equal facts compute equal bits."""
    library = os.confstr("CS_GNU_LIBC_VERSION") if hasattr(os, "confstr") else sys.platform
    tuning = os.environ.get(LIBRARY_TUNING, "")
    return {
        "numba for": numba_uses(),
        "numpy for": numpy_uses(),
        "C library": f"{library} {tuning}" if "hwcaps" in tuning else f"{library}",
    }


def without_library_tuning() -> None:
    """Start this program again if GLIBC_TUNABLES choose other functions, such as sin and cos.

    The C library reads that variable only when a program starts.
    """
    if "hwcaps" in os.environ.get(LIBRARY_TUNING, "") and not os.environ.get(NATIVE):
        kept = {name: value for name, value in os.environ.items() if name != LIBRARY_TUNING}
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], kept)
