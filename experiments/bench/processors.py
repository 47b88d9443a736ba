"""What other processors would compute: the runs of `regression` under settings of every library.

``python -m cvqmpt_lab.experiments.bench.processors`` repeats all runs of `cvqmpt check-tables`
under each setting, once as the toolkit pins its arithmetic, whatever the setting says, and once
without the pin. It prints the table of docs/guard.md. Kernels are compiled for each processor, so
that the whole takes half an hour; --few takes only the settings that the tests repeat.
"""

import argparse
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

from cvqmpt_lab.base.arithmetic import NATIVE, PINNED
from cvqmpt_lab.experiments.regression import Case, Expectations, Values, factor_between

SSE = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"
NO_FMA = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA"}  # other functions sin and cos
SETTINGS: Mapping[str, Mapping[str, str]] = {
    "this processor": {},
    **{
        f"OpenBLAS for {core}": {"OPENBLAS_CORETYPE": core}
        for core in ("Prescott", "Nehalem", "Sandybridge", "Haswell", "Zen", "SkylakeX")
    },
    **{
        f"numba for {name}": {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": ""}
        for name in ("generic", "x86-64-v2", "znver3", "skylake-avx512")
    },
    "numpy with SSE": {"NPY_DISABLE_CPU_FEATURES": SSE},
    "numpy with AVX2": {"NPY_DISABLE_CPU_FEATURES": PINNED["NPY_DISABLE_CPU_FEATURES"]},
    "C library without FMA": NO_FMA,
    "an old processor": {
        "OPENBLAS_CORETYPE": "Prescott",
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "NPY_DISABLE_CPU_FEATURES": SSE,
        **NO_FMA,
    },
}
FEW = ("OpenBLAS for SkylakeX", "numba for x86-64-v2", "an old processor")
"""Settings that a test repeats with the pin."""


class Changes(NamedTuple):
    """How runs changed."""

    otherwise: int  # runs that end otherwise
    paths: int  # other paths
    factors: tuple[float, float, float]  # median, 90 % quantile and largest of the counts' factors

    @staticmethod
    def between(old: Mapping[Case, Values], new: Mapping[Case, Values]) -> "Changes":
        """Compare runs of equal cases."""
        factors = sorted(factor_between(old[case], new[case]) for case in old)
        return Changes(
            sum(old[case]["fail_reason"] != new[case]["fail_reason"] for case in old),
            sum(old[case]["path_sha256"] != new[case]["path_sha256"] for case in old),
            (median(factors), factors[math.ceil(0.9 * len(factors)) - 1], factors[-1]),
        )


def outcomes_under(setting: Mapping[str, str], out: Path) -> Mapping[Case, Values]:
    """Run `cvqmpt check-tables --update` in an environment, and return the values."""
    words = ["-m", "cvqmpt_lab.cli.main"]
    here = {name: value for name, value in os.environ.items() if name not in PINNED} | {**setting}
    for command in (["warmup"], ["check-tables", "--update", "--expected", str(out)]):
        subprocess.run([sys.executable, *words, *command], env=here, check=True, stdout=sys.stderr)
    return Expectations.load(out).outcomes


def table(settings: Sequence[str]) -> list[str]:
    """Return the lines of the table."""
    head = ["setting", "pinned: paths changed", "not pinned: paths changed", "end otherwise"]
    head += ["counts: median, 90 % quantile and largest factor"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "values.json")
        usual = outcomes_under({}, out)
        for name in settings:
            pinned = Changes.between(usual, outcomes_under(SETTINGS[name], out))
            native = Changes.between(usual, outcomes_under({**SETTINGS[name], NATIVE: "1"}, out))
            equal = pinned.paths == 0 and pinned.factors[2] == 1.0
            cells = [name, "none" if equal else f"{pinned.paths}, factor {pinned.factors[2]:.3g}"]
            cells += [f"{native.paths} of {len(usual)}", f"{native.otherwise}"]
            lines.append(
                f"| {' | '.join([*cells, ', '.join(f'{x:.3f}' for x in native.factors)])} |"
            )
            print(lines[-1], flush=True)
    return lines


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--few", action="store_true", help="three settings")
    print("\n".join(table(FEW if parser.parse_args().few else [*SETTINGS])))
