"""Pictures, films and recordings on the command line: --picture, --save and --view."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cli.options import FLAG, Options, ProgressBar, option, writable_file
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.scene.scene import Attachment

if TYPE_CHECKING:
    from cvqmpt_lab.tasks.solve import TaskSolution

RECORDING = ".rrd"
FILM = ".gif"
PAGE = ".html"


SHOW: Options = {
    "pictures": {
        "--picture": option(
            "a still picture: start, goal and the path between; of a task, the end of each phase",
            type=Path,
            metavar="P.png",
        ),
        "--save": option(
            "a page for a browser, a rerun recording, or a film",
            type=Path,
            metavar="RUN.html|rrd|gif",
        ),
        "--view": option("open the rerun viewer; needs a display", **FLAG),
    }
}


def check_show(args: argparse.Namespace) -> None:
    """Refuse before planning what would fail afterwards."""
    for path in filter(None, (args.save, args.picture)):
        writable_file(path)
    known = (PAGE, RECORDING, FILM)
    if args.save is not None and args.save.suffix == ".mp4":
        raise InvalidInputError(
            f"--save {args.save}: mp4 was removed; save {args.save.stem}.gif and convert it: "
            f"ffmpeg -i {args.save.stem}.gif {args.save.name}"
        )
    if args.save is not None and args.save.suffix not in known:
        raise UnknownChoiceError(f"--save {args.save}: suffix", args.save.suffix, known)
    if args.view:
        from cvqmpt_lab.show.viewer import check_viewer

        check_viewer()


def show_solution(
    args: argparse.Namespace,
    solution: "Solution | TaskSolution",
    carried: tuple[Attachment, ...] = (),
) -> list[str]:
    """Write and open what was asked for of a problem or task; a line for each.

    carried: what the hand is shown with where the problem does not model it.
    """
    lines = []
    suffix = None if args.save is None else args.save.suffix
    if args.picture:
        from cvqmpt_lab.show.picture import draw_solution, draw_task

        what = "picture"
        if isinstance(solution, Solution):
            draw_solution(solution, args.picture, carried=carried)
        else:
            what = f"picture of {', '.join(draw_task(solution, args.picture))}"
        lines.append(f"{what} written to {args.picture}")
    if suffix == FILM:
        from cvqmpt_lab.show.picture import film_solution

        film_solution(solution, args.save, carried=carried, progress=ProgressBar("film"))
        lines.append(f"film written to {args.save}")
    if suffix == PAGE:
        from cvqmpt_lab.show.web_page import save_page

        notes = save_page(solution, args.save, carried)
        size = args.save.stat().st_size / 1e6
        lines.append(
            f"page written to {args.save} ({size:.1f} MB); open it in a browser, no network is "
            "needed"
        )
        lines += notes
    if suffix == RECORDING or args.view:
        from cvqmpt_lab.show.recording import log_solution

        recording = args.save if suffix == RECORDING else None
        log_solution(solution, recording, args.view, carried)
        if recording:
            lines.append(f"recording written to {recording}; open it with: rerun {recording}")
    return lines
