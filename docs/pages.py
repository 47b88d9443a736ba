"""Write the pages that can be seen before an install: plans of the place task and of a UR5.

python docs/pages.py
"""

import sys
import tempfile
from pathlib import Path

from cvqmpt_lab import PlanningProblem, Request, TimingSettings, plan
from cvqmpt_lab.base.files import write_text
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.benchmarks.templates import problem_template, with_limits
from cvqmpt_lab.features.pictures.web_page import save_page

DOCS = Path(__file__).parent
NAMES = ("place_task", "ur5")  # of the pages, without .html


def problem_of(name: str) -> PlanningProblem:
    """Return the problem of a page."""
    if name == "place_task":
        return suite_named("place-task-with-can").solvable(7)
    return PlanningProblem.from_dict(problem_template(with_limits({"name": name})[0]))


def page(name: str) -> str:
    """Return the text of a page; it is the same in every run."""
    # birrt and roadmap end long before the budget; an optimization would end at a time limit
    planned = plan(problem_of(name), Request(seed=0, timing=TimingSettings(speed=0.3)))
    title = "Place task with a can" if name == "place_task" else "UR5 over a wall, hand upright"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.html"
        save_page(planned.solution, path, motion=planned.motion, name=title)
        return path.read_text(encoding="utf-8")


def main() -> None:
    """Write all pages."""
    for name in NAMES:
        write_text(DOCS / f"{name}.html", page(name))
        print(f"{name}.html written")


if __name__ == "__main__":
    sys.exit(main())
