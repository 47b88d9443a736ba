"""`cvqmpt warmup`: compile every kernel ahead of time, so that the first plan does not wait."""

import argparse

from cvqmpt_lab.warm_up import compile_kernels

EXAMPLES = ("cvqmpt warmup",)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """None."""


def run(args: argparse.Namespace) -> int:
    """Compile, or load what is compiled."""
    seconds = compile_kernels(lambda text: print(text, flush=True))
    print(f"kernels ready after {seconds:.1f} s")
    return 0
