"""`cvqmpt table`, `report`, `compare`, `claims` and `check-tables`: evaluate the rows of runs."""

import argparse
import textwrap
import time
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from cvqmpt_lab.base.errors import InvalidInputError, in_checkout
from cvqmpt_lab.base.files import write_bytes, write_text
from cvqmpt_lab.base.modules import require_code_allowed
from cvqmpt_lab.benchmarks.results.provenance import PROVENANCE_FILE
from cvqmpt_lab.benchmarks.results.store import directory_rows
from cvqmpt_lab.cli.options import (
    FLAG,
    REPEATED,
    Options,
    ProgressBar,
    compiling,
    not_negative,
    option,
    positive_int,
    refuse_given,
    writable_file,
)
from cvqmpt_lab.cli.problem_arguments import planner_list
from cvqmpt_lab.cli.problem_options import CODE
from cvqmpt_lab.experiments import regression
from cvqmpt_lab.experiments.regression import EXPECTED
from cvqmpt_lab.paper_tables import pages, statements
from cvqmpt_lab.paper_tables.beside import Judged, beside_lines, explained, repeated
from cvqmpt_lab.paper_tables.claims import JudgedClaim, judged_claims
from cvqmpt_lab.paper_tables.committed import (
    RESULTS,
    committed_directories,
    committed_pages,
    committed_pictures,
    differing_cells,
    require_checkout,
    stale_pages,
    untraceable,
)
from cvqmpt_lab.paper_tables.compare_runs import (
    Rule,
    Side,
    against,
    clear,
    compared_sides,
    comparison_lines,
    planners_of_one,
)
from cvqmpt_lab.paper_tables.evidence import Evidence, banner, evidence_below, read_evidence
from cvqmpt_lab.paper_tables.rendering import render_directory
from cvqmpt_lab.paper_tables.writers import PAGE_WIDTH, text_lines


def show_tables(directory: Path, baseline: str | None = None) -> None:
    """Render the tables of a directory; print a line for each planner, and a path.

    baseline: planner with which the others are compared, in lines that are printed only.
    """
    found = against(directory_rows(directory), baseline) if baseline else []
    written = render_directory(directory)
    title, *lines = written.brief
    print("\n".join([f"{title}; all numbers: {directory / 'table.md'}", *lines]))
    if found:
        print(
            f"from A, {baseline}, to B, another planner; changes over problems that both solved, "
            "95 % intervals"
        )
        print("\n".join(text_lines(comparison_lines(found))))


def write_report(directory: Path, out: Path | None = None) -> None:
    """Write an html file about results, into their folder unless `out` is given; print its path."""
    from cvqmpt_lab.experiments.replay import first_path

    out = writable_file(out or directory / "report.html")
    found = pages.evidence_of(directory)
    alone = (directory / PROVENANCE_FILE).is_file()
    titled = {} if directory.resolve() == RESULTS else {"title": directory.resolve().name}
    judging = not alone and any({*found} & {*claim.suites} for claim in statements.CLAIMS)
    own = judging and directory.resolve() != RESULTS
    committed = judged_committed() if own else None
    text = pages.report_html(
        found,
        ProgressBar("report"),
        first_path(found),
        verdicts=not alone,
        committed=committed,
        **titled,
    )
    write_text(out, text)
    print(f"report, for a browser: {out}")


def report(args: argparse.Namespace) -> None:
    """Write the report of a folder, or the log of a run for OMPL's tools."""
    if args.ompl_log is None:
        write_report(args.directory, args.out)
        return
    from cvqmpt_lab.paper_tables.ompl_log import ompl_log

    refuse_given(args, ("out",), "does not go with --ompl-log, which writes a log and no report")
    write_text(writable_file(args.ompl_log), ompl_log(args.directory))
    print(
        f"written {args.ompl_log}; read it with: ompl_benchmark_statistics -d FILE.db "
        f"{args.ompl_log}"
    )


def compare(args: argparse.Namespace) -> int:
    """Pair two runs, or two planners, on the same problems and print what differs."""
    a, b = args.before, args.after
    found, unlike = compared_sides(a, b), a.unlike(b)
    alone: tuple[list[str], list[str]] = ([], [])
    if a.planner is None:
        alone = planners_of_one(directory_rows(a.folder), directory_rows(b.folder))
    budgets = [line for line in unlike if line.startswith(("cutoff_s", "iterations", "cost_s"))]
    if args.fail_if and budgets:
        raise InvalidInputError(
            f"--fail-if needs equal budgets, but from A to B {'; '.join(budgets)}; run both with "
            "the same --cutoff, --iterations or --cost"
        )
    for line in unlike:
        print(f"unlike settings, from A to B: {line}")
    print(
        f"from A, {a.folder}, to B, {b.folder}; runs in both; changes over problems that both "
        "solved, 95 % intervals"
    )
    print("\n".join(text_lines(comparison_lines(found))))
    print("\n".join(clear(found) or ["no clear change"]))
    for run, planners in zip("AB", alone, strict=True):
        if planners:
            print(f"in {run} alone, not compared: {', '.join(planners)}")
    broken = [line for rule in args.fail_if for line in rule.broken(found)]
    if args.fail_if:  # a planner without runs in B counts as a failure
        broken += [f"{name}: B has no runs of it" for name in alone[0]]
    for line in broken:
        print(f"fails: {line}")
    return 1 if broken else 0


def claims(args: argparse.Namespace) -> None:
    """Judge every claim of the paper, print the verdicts, and write the page if asked to."""
    if args.results is not None and args.results.resolve() != RESULTS:
        if args.write:
            write_claims(args.results)
            return
        found, judged = judged_below(args.results)
        print("\n".join(own_lines(found, judged)))
        print(f"nothing written; --write writes {args.results / pages.OWN_PAGE}")
        return
    if not args.write:
        # verdicts need a quarter of the rows that pages need
        print("\n".join(text_lines(pages.summary_lines(judged_committed().claims))))
        if in_checkout():
            print(f"nothing written; --write writes {pages.PAGE}")
        return
    require_checkout("cvqmpt claims --write", "name a folder of results directories")
    found, judged = judged_below(RESULTS)
    print("\n".join(text_lines(pages.summary_lines(judged))))
    texts, pictures = committed_pages(found, judged), committed_pictures(found, judged)
    for path, text in texts.items():
        write_text(path, text)
    for path, picture in pictures.items():
        write_bytes(path, picture)
    print("\n".join(f"written {path}" for path in (*texts, *pictures)))


def write_claims(results: Path) -> None:
    """Print own rows beside the paper and the committed rows; write the page and its picture."""
    found, judged = judged_below(results)
    committed = judged_committed()
    print("\n".join(own_lines(found, judged)))
    page, picture = results / pages.OWN_PAGE, results / pages.OWN_PICTURE
    drawn = pages.forest_of(judged, committed)
    if drawn:
        write_bytes(picture, drawn)
    write_text(page, pages.page_text(found, judged, results, committed))
    print(f"every claim, its numbers and commands: {page}")


def judged_below(results: Path) -> tuple[dict[str, Evidence], list[JudgedClaim]]:
    """Return the results directories below a folder by name, and the claims judged by them."""
    if not committed_directories(results):
        raise InvalidInputError(
            f"{results} holds no results directories; name a folder with some, such as runs/all"
        )
    found = evidence_below(results)
    return found, judged_claims(found)


def own_lines(found: Mapping[str, Evidence], judged: Sequence[JudgedClaim]) -> list[str]:
    """Return a line for each claim: the paper's number, that of own rows and the committed one.

    Args:
        found: own results directories by name.
        judged: claims judged by them.
    """
    committed = judged_committed()
    lines = text_lines(beside_lines(judged, committed.claims))
    told = (banner(found), explained(judged), repeated(found, committed.found))
    return [*lines, *(part for text in told for part in textwrap.wrap(text, PAGE_WIDTH))]


@cache
def judged_committed() -> Judged:
    """Return the committed directories by which claims are judged, and these claims."""
    names = dict.fromkeys(name for claim in statements.CLAIMS for name in claim.suites)
    found = {name: read_evidence(RESULTS / name) for name in names}
    return Judged(found, judged_claims(found))


def check_tables(args: argparse.Namespace) -> int:
    """Repeat runs and compare them with expectations, or write these; return 1 on a difference.

    Runs are those of `regression`, or of planners on a folder of problem files.
    """
    if args.folder is None:
        return _check_committed(args)
    from cvqmpt_lab.experiments.run import default_jobs
    from cvqmpt_lab.planning.warm_up import compile_kernels

    if args.all or args.results != RESULTS:
        raise InvalidInputError("--all and --results go without a folder of problem files")
    path, planners = args.expected or args.folder / "expected.json", args.planners or ()
    if args.update:
        writable_file(path)
        if not planners:
            raise InvalidInputError("--update needs --planners A,B, the planners to guard")
        guarded = regression.Guarded(planners, range(args.seeds or 1), args.iterations or 20_000)
    elif args.seeds or args.iterations:
        raise InvalidInputError(
            f"--seeds and --iterations go with --update; otherwise they are those of {path}"
        )
    else:
        command = f"cvqmpt check-tables {args.folder} --planners A,B --update"
        guarded, expected = regression.guarded_by(
            regression.Expectations.load(path, command), planners
        )
        for name in guarded.planners if not planners else ():
            if ":" in name:  # a name without it is ours, or an entry point of an installed package
                require_code_allowed(
                    f"{path} names the planner {name}, whose module would run",
                    f"name it: --planners {','.join(guarded.planners)}",
                )
    compile_kernels(compiling())
    jobs = args.jobs or default_jobs()
    outcomes = guarded.measure(args.folder, jobs, ProgressBar("check-tables"))
    made_with = regression.made_with()
    if args.update:
        regression.Expectations(made_with, outcomes).save(path)
        solved = sum(values["fail_reason"] is None for values in outcomes.values())
        print(f"{len(outcomes)} runs, {solved} solved; expectations written to {path}")
        return 0
    mode, lines = regression.compare(expected, outcomes, made_with, 1 + args.within / 100)
    return _print_differences({f"{len(outcomes)} runs compared {mode}": lines})


def _print_differences(found: Mapping[str, Sequence[str]]) -> int:
    """Print the differences found in each comparison; return 1 if there is one."""
    for what, lines in found.items():
        count = f"{len(lines)} differences" if lines else "no difference"
        print(f"{what}: {count}")
    for lines in found.values():
        for line in lines:
            print(f"  differs: {line}")
    return 1 if any(found.values()) else 0


def _check_committed(args: argparse.Namespace) -> int:
    """Repeat a few runs; compare them and all tables with the committed ones."""
    from cvqmpt_lab.experiments.experiment import models_of

    of_folder = ("planners", "seeds", "iterations", "jobs")
    refuse_given(args, of_folder, "goes with a folder of problem files; name it")
    args.expected = args.expected or EXPECTED
    expected = None
    if args.update:
        if args.expected == EXPECTED:
            require_checkout("cvqmpt check-tables --update", "name a file: --expected F.json")
        writable_file(args.expected)
    else:
        expected = regression.Expectations.load(args.expected)
    cases = regression.CASES if args.update or args.all else regression.sample()
    began = time.perf_counter()
    outcomes = regression.measure(cases, ProgressBar("check-tables"))
    seconds = time.perf_counter() - began
    print(f"{len(outcomes)} runs of {len(regression.CASES)} in {seconds:.0f} s")
    made_with = regression.made_with()
    if expected is None:
        regression.Expectations(made_with, outcomes).save(args.expected)
        print(f"expectations written to {args.expected}")
        return 0
    known = expected.outcomes.items()
    left_out = {*regression.CASES} - {*cases}
    expected = expected._replace(outcomes={case: x for case, x in known if case not in left_out})
    mode, runs = regression.compare(expected, outcomes, made_with, 1 + args.within / 100)
    directories = committed_directories(args.results)
    stale = []
    if args.results == RESULTS:
        stale = stale_pages(committed_pages(*judged_below(RESULTS)))
    found = {
        f"runs compared {mode}": runs,
        f"tables of {len(directories)} results directories rendered again": [
            line for folder in directories for line in differing_cells(folder)
        ],
        "commits and weights of their rows": [
            line for folder in directories for line in untraceable(folder, models_of)
        ],
        "the page of claims and the README's verdicts": stale,
    }
    return _print_differences(found)


TABLE: Options = {
    "directory": option("a directory with runs.csv and provenance.json", type=Path, metavar="DIR"),
    "--baseline": option(
        "also compare every planner with this one, problem by problem, with intervals",
        metavar="PLANNER",
    ),
}
REPORT: Options = {
    "directory": option(
        "a results directory, or a folder that holds several", type=Path, metavar="DIR"
    ),
    "--out": option("file to write (DIR/report.html)", type=Path, metavar="FILE"),
    "--ompl-log": option(
        "write a results directory as OMPL's benchmark log instead, for Planner Arena and "
        "ompl_benchmark_statistics",
        type=Path,
        metavar="FILE",
    ),
}
COMPARE: Options = {
    "before": option(
        "a results directory, or one planner in it: FOLDER:PLANNER", type=Side.read, metavar="A"
    ),
    "after": option(
        "another of the same suite, or FOLDER:PLANNER, also of the same folder; the runs that both "
        "have are compared",
        type=Side.read,
        metavar="B",
    ),
    "--fail-if": option(
        "exit with 1 if COLUMN OP NUMBER is true for a planner, such as 'time > 1.1', or if B "
        "lacks a planner of A; COLUMN: time, work, checks, projections, length (ratio B/A) or "
        "solved (B - A, percentage points); OP: <, <=, > or >=; repeatable",
        type=Rule.read,
        metavar="RULE",
        **REPEATED,
    ),
}
CLAIMS: Options = {
    "results": option(
        "folder of results directories; claims.md is written to it (the committed results, "
        "whose page and README are written)",
        type=Path,
        nargs="?",
        metavar="DIR",
    ),
    "--write": option(
        "write page, README and pictures; without it, only print the verdicts", **FLAG
    ),
}
CHECK_TABLES: Options = {
    "folder": option(
        "folder of problem files, compared with its own expectations instead of the committed "
        "ones; all values except times must be equal where the arithmetic and the versions are; "
        "otherwise the runs are compared as a whole, see --within",
        type=Path,
        nargs="?",
        metavar="FOLDER",
    ),
    "--update": option("write the expectations instead of comparing", **FLAG),
    "--all": option(
        "repeat all committed runs, not only the first run of each planner in each suite and one "
        "failed run",
        **FLAG,
    ),
    "--within": option(
        "with other arithmetic (CVQMPT_NATIVE, ARM) or other versions: bound on the median, over "
        f"all runs, of the change of counts, in percent ({100 * (regression.TYPICAL - 1):g})",
        type=not_negative,
        default=100 * (regression.TYPICAL - 1),
        metavar="P",
    ),
    "--expected": option(
        "expectations (FOLDER/expected.json, or the committed ones)", type=Path, metavar="F.json"
    ),
    "--results": option("folder of results directories", type=Path, default=RESULTS, metavar="DIR"),
    "of a FOLDER": {
        "--planners": option(
            "planners to guard: a built-in planner, an entry point or package.module:planner "
            "(default: all planners in the expectations)",
            type=planner_list,
            metavar="A,B",
        ),
        "--seeds": option("with --update: seeds 0 to K-1 (1)", type=positive_int, metavar="K"),
        "--iterations": option(
            "with --update: budget of a run (20000)", type=positive_int, metavar="N"
        ),
        "--jobs": option("processes (one per core)", type=positive_int, metavar="J"),
        **CODE,
    },
}
COMMANDS = {
    "table": (lambda args: show_tables(args.directory, args.baseline), TABLE),
    "report": (report, REPORT),
    "compare": (compare, COMPARE),
    "claims": (claims, CLAIMS),
    "check-tables": (check_tables, CHECK_TABLES),
}
