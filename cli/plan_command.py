"""Options of `cvqmpt plan` and `cvqmpt studio`, whose functions are in `plan_runs`."""

from functools import partial
from pathlib import Path

from cvqmpt_lab.base.files import Imported
from cvqmpt_lab.cli.options import (
    FLAG,
    REACH,
    REPEATED,
    SEED,
    WEIGHTS,
    Options,
    file_of_kind,
    not_negative_int,
    option,
    picture_file,
    positive,
    positive_int,
    rate,
)
from cvqmpt_lab.cli.problem_options import (
    BUDGET,
    MARGIN,
    MOTION,
    PROBLEM,
    REGIONS,
    ROBOT,
    optimize_option,
    velocity_options,
)
from cvqmpt_lab.planning.by_name import declared

# default of --optimize: on the templates of six arms, paths after 1 s are at most 1 % shorter
OPTIMIZE_S = 0.25
# files that --save writes
RECORDING_SUFFIX = ".rrd"
FILM_SUFFIX = ".gif"
PAGE_SUFFIX = ".html"
STATES_SUFFIX = ".csv"
SAVED_SUFFIXES = (PAGE_SUFFIX, RECORDING_SUFFIX, FILM_SUFFIX, STATES_SUFFIX)


OPTIONS: Options = {
    **PROBLEM,
    **REGIONS,
    **ROBOT,
    **MARGIN,
    "--planner": option(
        f"one of {', '.join(declared())}, or "
        "package.module:planner (roadmap; birrt for a task or a held mechanism)"
    ),
    **WEIGHTS,
    **REACH,
    "--cloud": option(
        "cloud whose points are obstacles for --start and --goal, as cvqmpt scan writes it, or in "
        "the robot's base frame; with a suite or file, the input cloud of a network; repeatable",
        type=Path,
        metavar="SCAN.pcd|ply|npy|xyz",
        **REPEATED,
    ),
    "--scene": option(
        "obstacles for --start and --goal, as cvqmpt scan writes them, instead of --cloud",
        type=Path,
        metavar="S.json",
    ),
    "--project-start": option("move the start onto the constraint first (Algorithm 1)", **FLAG),
    **SEED,
    "--cores": option(
        "search with N seeds at once, in threads: the first certified path wins, and its seed "
        "alone repeats it (1)",
        type=positive_int,
        metavar="N",
    ),
    "--exact-clearance": option(
        "measure the smallest distances and the tolerated deviation, instead of proving lower "
        "bounds; always done for a task",
        **FLAG,
    ),
    "--json": option("print one json object instead of the report", **FLAG),
    "-v --verbose": option("log the stages of planning on standard error", **FLAG),
    **MOTION,
    **BUDGET,
    **optimize_option(f"; {OPTIMIZE_S:g}, 0: none"),
    "pictures": {
        "--picture": option(
            "a still picture of start, path and goal; for a task, of the end of each phase",
            type=picture_file,
            metavar="P.png|jpg|pdf",
        ),
        "--save": option(
            "a page for a browser, a rerun recording, a film, or the states of the path; "
            "repeatable",
            type=partial(file_of_kind, "--save", SAVED_SUFFIXES),
            metavar="RUN.html|rrd|gif|csv",
            **REPEATED,
        ),
    },
    "--trajectory": option(
        "write the fastest motion along the path within --speed, json for ROS; for a task, a "
        "folder with one file for each phase",
        type=Path,
        metavar="OUT.csv|OUT.json|DIR",
    ),
    "--rate": option(
        "write at least HZ states per second to --trajectory, equally spaced in time, and certify "
        "that motion (default: only the states that the motion needs)",
        type=rate,
        metavar="HZ",
    ),
    "--speed": option(
        "fraction of the joint limits that --trajectory uses (0.1)", type=float, metavar="FACTOR"
    ),
    "--duration": option(
        "duration of the motion of --trajectory, at least that of the fastest motion within "
        "--speed (default: that of the fastest motion)",
        type=positive,
        metavar="S",
    ),
    **velocity_options(
        "the motion of --trajectory",
        effect=". With a velocity at the start or the end, the path is straight at that end, for "
        "the distance that the arm needs to stop",
    ),
}


STUDIO: Options = {
    **PROBLEM,
    "--port": option("port of the page, 0: any (8090)", type=not_negative_int, default=8090),
    **ROBOT,
}
COMMANDS = {
    "plan": (Imported("cvqmpt_lab.cli.plan_runs:run"), OPTIONS),
    "studio": (Imported("cvqmpt_lab.cli.plan_runs:serve"), STUDIO),
}
