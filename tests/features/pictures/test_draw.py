"""Text and pictures of problems, robots, scenes and solutions; help texts of the package."""

import inspect
import io
import pydoc
import re

import pytest
from PIL import Image
from refusals import refused

import cvqmpt_lab
from cvqmpt_lab import Scene, draw, region
from cvqmpt_lab.features.pictures import load_ipython_extension


def test_all_values_have_a_text_of_at_most_five_lines(problem, solution, unsolved, task):
    for value in (problem, problem.robot, problem.scene, solution, unsolved, task):
        lines = repr(value).splitlines()
        assert 1 < len(lines) <= 5 and max(map(len, lines)) < 200, lines
    assert "20 goals" in repr(problem) and "rotation about y -0.1 to 0.1 rad" in repr(problem)
    assert "certified" in repr(solution) and "iteration limit" in repr(unsolved)


def test_notebooks_show_text_above_a_picture(problem):
    shell = pytest.importorskip("IPython.core.interactiveshell").InteractiveShell()
    load_ipython_extension(shell)
    data, _ = shell.display_formatter.format(problem.robot)
    html = data["text/html"]
    assert html.startswith("<pre>Robot &#x27;panda&#x27;") and "data:image/png;base64," in html
    data, _ = shell.display_formatter.format(problem.scene)
    shown = Image.open(io.BytesIO(data["image/png"]))
    assert shown.size == (600, 400) and len(shown.getcolors(1 << 20)) > 100
    assert "image/png" not in shell.display_formatter.format(Scene("empty", ()))[0]


def test_draw_takes_values_of_all_types_and_writes(solution, task_solution, tmp_path):
    drawn = draw(solution, tmp_path / "a.png", (90, 60))
    assert drawn.size == Image.open(tmp_path / "a.png").size == (90, 60)
    assert draw(solution.problem, size=(90, 60)).size == (90, 60)
    assert draw(task_solution, size=(90, 60)).width > 90
    refused("'int'; valid choices: Robot, Scene, Pl", draw, 3)


def test_help_of_the_package_is_readable():
    for kind in (cvqmpt_lab.PlanningProblem, cvqmpt_lab.Scene, cvqmpt_lab.Box):
        assert not re.search("Annotated| at 0x|<class", str(inspect.signature(kind)))
    text = pydoc.plain(pydoc.render_doc(cvqmpt_lab.PlanningProblem))
    assert "start: 'State' = <factory>, goals: 'States' = <factory>, constraint: 'Members'" in text
    refused("plain", region, "plain")
