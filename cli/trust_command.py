"""`cvqmpt trust`: put what docs/guarantees.md promises to the test, and count."""

import argparse
import datetime
import sys
from pathlib import Path

from cli.options import positive_int, writable_file
from cvqmpt_lab.warm_up import compile_kernels
from experiments.trust.check import made
from experiments.trust.figures import record
from experiments.trust.table import PARTS, checks_of

EXAMPLES = (
    "cvqmpt trust",
    "cvqmpt trust files faults --long",
    "cvqmpt trust --long --record docs/guarantees.md",
)
SHOWN = 5  # faults of one check that are printed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which parts, how long, where to write the figures."""
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} (all)")
    parser.add_argument("--long", action="store_true", help="as many trials as the page quotes (a few)")
    parser.add_argument("--trials", type=positive_int, metavar="N", help="so many trials of each check")
    parser.add_argument("--only", default="", metavar="WORDS", help="checks whose promise has these words")
    parser.add_argument("--record", type=Path, metavar="F.md", help="write the figures into this page")


def run(args: argparse.Namespace) -> int:
    """Make the checks; exit code 1 when one found a fault."""
    chosen = [
        (part, check, args.trials or (check.long if args.long else check.short))
        for part in args.parts or PARTS
        for check in checks_of(part)
        if args.only in check.promise
    ]
    if args.record:
        writable_file(args.record)
    compile_kernels(lambda text: print(text, file=sys.stderr, flush=True))
    faulty = 0
    for part, check, trials in chosen:
        if not trials:
            continue
        finding = made(part, check, trials)
        print(finding, flush=True)
        for fault in finding.trial.faults[:SHOWN]:
            print(f"  {fault}")
        faulty += bool(finding.trial.faults)
        if args.record:
            form = "part" if args.trials else "long" if args.long else "short"
            record(args.record, [finding], form, datetime.date.today())
    return 1 if faulty else 0
