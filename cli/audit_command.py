"""`cvqmpt audit`: judge every episode of a data set for one robot."""

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from cvqmpt_lab.base.errors import InvalidInputError, few
from cvqmpt_lab.base.files import make_folder
from cvqmpt_lab.cli.options import (
    Options,
    ProgressBar,
    log,
    option,
    positive_int,
    rate,
)
from cvqmpt_lab.cli.problem_arguments import robot_source
from cvqmpt_lab.cli.problem_options import ROBOT
from cvqmpt_lab.features.audit.judging import Settings
from cvqmpt_lab.features.audit.lerobot import COLUMNS
from cvqmpt_lab.features.audit.rows import CERTIFIED, NOT_READ, SHARES, Row, worst_first
from cvqmpt_lab.features.audit.run import ROWS_FILE, audit
from cvqmpt_lab.features.audit.units import UNITS, read_calibration

PAGE_FILE = "audit.html"


def run(args: argparse.Namespace) -> int:
    """Audit and print the table; return 0 if all are certified, 1 if not, 2 if none was read."""
    settings = _settings(args)
    out = None if args.out is None else make_folder(args.out)
    if out is not None and out.resolve().is_relative_to(args.folder.resolve()):
        raise InvalidInputError(
            f"--out {out} is inside of {args.folder}, which is audited; give a folder beside it"
        )
    bar = ProgressBar("audit")
    rows = audit(args.folder, settings, out, args.jobs, lambda *told: bar(*told))
    print(report(rows))
    if out is not None:
        from cvqmpt_lab.features.audit.page import write_page  # needed for pages alone

        write_page(out / PAGE_FILE, args.folder, rows, settings)
        print(f"written     {out / ROWS_FILE}, {out / PAGE_FILE}")
    if all(row.verdict == NOT_READ for row in rows):
        log(f"cvqmpt: no episode of {args.folder} could be read: {rows[0].name}: {rows[0].fault}")
        return 2
    return 0 if all(row.verdict == CERTIFIED for row in rows) else 1


def _settings(args: argparse.Namespace) -> Settings:
    """Return what the options say; refuse a robot and units that are not given."""
    source = robot_source(args)
    if source is None:
        raise InvalidInputError("an audit needs --robot NAME|URDF|robot.json")
    if args.units is None:
        raise InvalidInputError(
            "an audit needs --units radians, degrees or normalised (LeRobot's -100 to 100): units "
            "are not guessed"
        )
    calibration = None if args.calibration is None else read_calibration(args.calibration)
    if args.units == "normalised" and calibration is None:
        raise InvalidInputError(
            "--units normalised needs --calibration F.json, LeRobot's file with range_min and "
            "range_max of each motor"
        )
    if args.units == "radians" and calibration is not None:
        raise InvalidInputError("--calibration goes with --units normalised or degrees")
    return Settings(source, args.units, calibration, args.scene, args.rate, args.column)


def report(rows: Sequence[Row], most: int = 40) -> str:
    """Return the table of an audit, worst episodes first, and its last line."""
    columns = ("episode", "verdict", *SHARES, "self mm", "jumps", "gaps", "fault")
    table = [columns, *(_cells(row) for row in worst_first(rows)[:most])]
    wide = [max(len(line[k]) for line in table) for k in range(len(columns))]
    lines = [
        "  ".join(f"{cell:{width}}" for cell, width in zip(line, wide, strict=True)).rstrip()
        for line in table
    ]
    if len(rows) > most:
        lines.append(f"... {len(rows) - most} more")
    verdicts = Counter(row.verdict for row in rows)
    kinds = Counter(kind for row in rows for kind in row.kinds.split())
    counted = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.most_common())
    faults = ", ".join(f"{kind} in {count}" for kind, count in kinds.most_common())
    lines.append(f"{len(rows)} episodes: {counted}{'; ' if faults else ''}{faults}")
    if notes := few(dict.fromkeys(row.note for row in rows if row.note), 3):
        lines.append(f"note        {notes}")
    return "\n".join(lines)


def _cells(row: Row) -> tuple[str, ...]:
    """Return the texts of a row of the table."""
    shares = [getattr(row, kind) for kind in SHARES]
    used = ["-" if share is None else f"{share:.2f}" for share in shares]
    near = "-" if row.self_mm is None else f"{row.self_mm:.1f}"
    counts = ["-" if count is None else str(count) for count in (row.jumps, row.gaps)]
    where = "" if row.time_s is None else f" at {row.time_s:.3f} s"
    fault = row.fault if len(row.fault) <= 110 else f"{row.fault[:107]}..."
    return row.name, row.verdict, *used, near, *counts, f"{fault}{where}"


def _column(text: str) -> str:
    """Return the name of a column of positions."""
    from cvqmpt_lab.base.errors import require_choice

    found: str = require_choice("column", text, COLUMNS)
    return found


OPTIONS: Options = {
    "folder": option(
        "data set of LeRobot (v2.1 or v3), several of them, or a folder of csv, npz, json, yaml "
        "and MCAP files, one episode each",
        type=Path,
        metavar="FOLDER",
    ),
    **ROBOT,
    "--units": option(
        "unit of the joints in the files; normalised: LeRobot's -100 to 100",
        choices=UNITS,
    ),
    "--calibration": option(
        "LeRobot's calibration of the motors, for normalised values (id, drive_mode, "
        "homing_offset, range_min, range_max)",
        type=Path,
        metavar="F.json",
    ),
    "--scene": option("obstacles: a scene", type=Path, metavar="S.json"),
    "--rate": option("samples a second, of files without times", type=rate, metavar="HZ"),
    "--column": option(
        f"column of data sets of LeRobot: {' or '.join(COLUMNS)} (action: commanded positions)",
        type=_column,
        default=COLUMNS[0],
        metavar="NAME",
    ),
    "--out": option(
        f"folder for {ROWS_FILE}, a row an episode, and {PAGE_FILE}, a page for a browser; rows "
        "of unchanged files are kept",
        type=Path,
        metavar="DIR",
    ),
    "--jobs": option("processes (2)", type=positive_int, default=2, metavar="N"),
}
COMMANDS = {"audit": (run, OPTIONS)}
