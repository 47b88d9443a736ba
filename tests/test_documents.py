"""Commands in README, docs, helps and notebooks parse; examples run."""

import ast
import json
import re
import runpy
from pathlib import Path

import nbformat
import numpy as np
import pytest
from pages import PAGES, ROOT, commands_of, python_of
from PIL import Image

import cvqmpt_lab
from cvqmpt_lab.base.arithmetic import is_pinned
from cvqmpt_lab.cli.main import COMMANDS, examples_of, main, parser_with
from cvqmpt_lab.features.motion.timing import time_path
from cvqmpt_lab.features.motion.trajectory import read_motion, save_trajectory
from cvqmpt_lab.features.pictures.bodies import BODY_COLOURS

EXAMPLES = sorted((ROOT / "notebooks" / "examples").glob("*.py"))
LIVE = runpy.run_path(str(ROOT / "docs" / "pages.py"))
OUTPUTS = runpy.run_path(str(ROOT / "docs" / "compare_outputs.py"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_on_pages_are_understood(page):
    for words in commands_of(page.read_text(encoding="utf-8")):
        parser_with([words[0]]).parse_args(words)


@pytest.mark.parametrize("command", COMMANDS)
def test_examples_in_helps_are_understood(command):
    found = commands_of("```\n{}\n```".format("\n".join(examples_of(command))))
    assert found and all(words[0] == command for words in found)
    for words in found:
        parser_with([command]).parse_args(words)


@pytest.mark.parametrize("command", COMMANDS)
def test_helps_name_only_options_of_their_own_command(command):
    (commands,) = parser_with([command])._subparsers._group_actions
    actions = commands.choices[command]._actions
    texts = " ".join(action.help for action in actions if action.help)
    named = re.findall(r"(?<!plan )(--[a-z]+(?:-[a-z]+)*)", texts)
    assert set(named) <= {name for action in actions for name in action.option_strings}


def test_targets_of_make_on_pages_are_there():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    pages = "".join(page.read_text() for page in PAGES)
    named = set(re.findall(r"[`\n]make ([a-z-]+)", pages))
    assert {"reproduce", "test"} <= named <= targets


def test_folders_and_files_of_the_project_on_pages_are_there():
    """Names in capitals or with `my_` stand for a reader's own files."""
    inside = r"`((?:cvqmpt_lab|experiments|notebooks|paper_tables|tests|docs)/[\w./-]+)`"
    named = {path for page in PAGES for path in re.findall(inside, page.read_text())}
    own = re.compile(r"my_|[A-Z]{4}")
    assert len(named) > 10
    assert [path for path in named if not own.search(path) and not (ROOT / path).exists()] == []


def test_cases_of_judge_a_motion_are_judged_as_the_page_says(monkeypatch, cvqmpt):
    """Each command on the page is followed by lines that it prints."""
    monkeypatch.chdir(ROOT)
    page = (ROOT / "docs" / "judge_a_motion.md").read_text(encoding="utf-8")
    cases = re.findall(r"```bash\n(.*?)```.*?```text\n(.*?)```", page, re.DOTALL)
    assert len(cases) == 4
    for command, told in cases:
        (words,) = commands_of(f"```\n{command}```")
        said = cvqmpt("", *words, code=1 if "fault " in told else 0)
        assert {*told.splitlines()} <= {*said.splitlines()}
    names = {name: getattr(cvqmpt_lab, name) for name in ("JointState", "Motion", "judge")}
    exec(python_of("docs/judge_a_motion.md")[0], names)
    chunk, problem = (ROOT / "docs" / "judge" / name for name in ("chunk.csv", "ball.json"))
    motion, problem = read_motion(chunk), cvqmpt_lab.PlanningProblem.load(problem)
    state = motion.positions[0], np.array([0.2, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0]), np.zeros(7)
    given = (problem, motion.joint_names, motion.positions, motion.times)
    assert names["step"](*given, state) == 1.0
    assert names["step"](*given, (state[0], np.zeros(7), np.zeros(7))) == 0.65


def test_every_public_name_is_there():
    found = {id(getattr(cvqmpt_lab, name)) for name in cvqmpt_lab.__all__}
    assert len(found) == len(cvqmpt_lab.__all__)
    with pytest.raises(AttributeError, match="public names: allow_code, Articulation"):
        _ = cvqmpt_lab.solv


def test_the_page_on_python_lists_every_public_name():
    page = (ROOT / "docs" / "api.md").read_text()
    for module, names in cvqmpt_lab._NAMES.items():
        listed = f".. automodule:: cvqmpt_lab.{module}\n   :members: {', '.join(names)}\n"
        assert listed in page, listed


def test_editors_and_type_checkers_find_the_names_that_are_imported_when_used():
    """Imports under TYPE_CHECKING, the table of lazy imports and `__all__` have equal names."""
    tree = ast.parse(Path(cvqmpt_lab.__file__).read_text())
    (block,) = (
        node for node in tree.body if isinstance(node, ast.If) and isinstance(node.test, ast.Name)
    )
    seen = {
        line.module.removeprefix("cvqmpt_lab."): tuple(alias.name for alias in line.names)
        for line in block.body
    }
    assert seen == cvqmpt_lab._NAMES
    assert sorted(name for names in seen.values() for name in names) == sorted(cvqmpt_lab.__all__)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_examples_import_public_names_alone(example):
    nodes = list(ast.walk(ast.parse(example.read_text())))
    modules = {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
    modules |= {
        alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names
    }
    assert {name for name in modules if name.startswith("cvqmpt_lab")} == {"cvqmpt_lab"}


def test_the_gallery_shows_the_examples_as_they_are():
    """`python docs/gallery.py` writes the gallery."""
    shown = python_of("docs/gallery.md")
    assert shown == [path.read_text().split('"""', 2)[2].strip() + "\n" for path in EXAMPLES]


def test_the_examples_of_the_readme_run(tmp_path, monkeypatch, capsys):
    first, second = python_of("README.md")
    monkeypatch.chdir(tmp_path)
    assert len(first.strip().splitlines()) <= 7  # an import and five lines
    exec(compile(first, "README.md", "exec"), names := {})
    assert names["cv"].plan(names["problem"]).solved
    assert "<html" in Path("plan.html").read_text()[:200]
    assert main(["problems", "new", "mine.json", "--robot", "ur5"]) == 0
    capsys.readouterr()
    exec(compile(second, "README.md", "exec"), {})
    assert "solved and certified" in capsys.readouterr().out


def test_the_first_plan_of_an_own_robot_runs(capsys):
    example = python_of("docs/your_own.md")[0]
    assert len(ast.parse(example).body) <= 7  # an import, five lines, and what is printed
    exec(compile(example, "your_own.md", "exec"), {})
    assert capsys.readouterr().out.endswith("certified\n")


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_the_short_examples_run_in_an_empty_folder(example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(example), run_name="__main__")
    printed = capsys.readouterr().out
    assert printed.strip() and "not solved" not in printed
    texts = re.findall(r"```text\n(.*?)```", (ROOT / "docs" / "gallery.md").read_text(), re.DOTALL)
    shown = dict(zip(EXAMPLES, texts, strict=True))[example]
    assert list(OUTPUTS["differences"](shown, printed)) == [], "python docs/gallery.py"


@pytest.mark.parametrize("name", ["frames", "region"])
def test_the_figures_of_frames_are_drawn_by_their_program(name):
    stored = Image.open(ROOT / "docs" / "gallery" / f"{name}.png").convert("RGB")
    made = runpy.run_path(str(ROOT / "docs" / "frames.py"))["FIGURES"][name]()
    apart = np.abs(np.subtract(made, stored, dtype=float))
    assert apart.mean() < 2.0 and (apart > 60.0).mean() < 0.01, "python docs/frames.py"


def test_legends_of_the_gallery_have_the_colours_of_the_picture():
    picture = Image.open(ROOT / "docs" / "gallery" / "plan_with_constraint.png").convert("RGB")
    legend = picture.crop((0, 480, 500, 500))
    for named in ("goal", "trace"):
        colour = 255 * np.array(BODY_COLOURS[named])
        assert np.abs(np.array(legend) - colour).max(axis=2).min() < 24, named


@pytest.mark.parametrize("pinned", [True, False])
def test_outputs_are_compared_without_times_and_marked_cells(tmp_path, monkeypatch, pinned):
    """Numbers are equal where the arithmetic is pinned, and close elsewhere."""
    monkeypatch.setitem(OUTPUTS["close"].__globals__, "is_pinned", lambda: pinned)

    def differ(shown, now):
        return len(list(OUTPUTS["differences"](shown, now)))

    table = "| planner | time [s] | work |\n|---|---|---|\n| a | {} | {} |"
    assert differ(table.format(1.0, "**100**"), table.format(9.0, "**100**")) == 0
    assert differ(table.format(1.0, "**100**"), table.format(9.0, "**101**")) == pinned
    assert differ(table.format(1.0, 100), table.format(1.0, 110)) == 1
    assert differ("goals 3.5 ms, 0.12 rad", "goals 90 ms, 0.13 rad") == pinned
    assert differ("solved", "timeout") == differ("one\ntwo", "one") == 1
    notebook, cell = nbformat.v4.new_notebook(), nbformat.v4.new_code_cell("1")
    cell.outputs = [nbformat.v4.new_output("stream", text="1 rad")]
    marked = nbformat.v4.new_code_cell("2", metadata={"tags": ["not-compared"]})
    notebook.cells = [cell, marked]
    nbformat.write(notebook, tmp_path / "a.ipynb")
    assert OUTPUTS["texts"](tmp_path / "a.ipynb") == ["1 rad"]


def test_a_sampler_of_ones_own_is_a_function(tmp_path, monkeypatch):
    example = python_of("docs/your_own.md")[-1]
    monkeypatch.chdir(tmp_path)
    assert main(["problems", "new", "mine.json", "--robot", "ur5"]) == 0
    names = {}
    exec(compile(example, "your_own.md", "exec"), names)
    assert names["solution"].solved and names["solution"].plan.sampler == "halfway"


NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LONGEST = 15  # cells of a notebook
MOST_BYTES = 300_000  # of a notebook with its pictures
MACHINE = re.compile(r"(?<![\w.])/(home|root|work|tmp|usr|opt|mnt|Users|private|var)/")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_short_define_nothing_and_store_their_outputs(path):
    """All cells ran in order without error; outputs have a picture and no path of a machine."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert len(notebook.cells) <= LONGEST and path.stat().st_size <= MOST_BYTES
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for node in ast.walk(ast.parse("\n".join(cell.source for cell in cells))):
        assert not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef), (
            node.name
        )
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    for output in outputs:
        assert output.output_type != "error" and output.get("name") != "stderr"
        parts = output.get("data", {}).items()
        text = output.get("text", "") + "\n".join(p for kind, p in parts if kind != "image/png")
        assert not MACHINE.search(text) and "UNCOMMITTED" not in text


def test_a_motion_becomes_the_fields_of_a_ros_2_message(tmp_path, solution):
    names = {}
    exec(compile(python_of("docs/ros2.md")[0], "ros2.md", "exec"), names)
    motion = time_path(solution.path.states, solution.problem.robot.joint_limits)
    messages = []
    for ending in ("json", "csv"):
        limits = solution.problem.robot.joint_limits
        save_trajectory(motion, tmp_path / f"motion.{ending}", limits)
        messages.append(names["joint_trajectory"](tmp_path / f"motion.{ending}"))
    assert messages[0] == messages[1]
    message = messages[0]
    assert message.keys() == {"header", "joint_names", "points"}
    assert message["joint_names"] == list(solution.problem.robot.joint_names)
    last = message["points"][-1]
    assert last["positions"] == motion.positions[-1].tolist()
    assert last["velocities"] == last["accelerations"] == [0.0] * 7 and last["effort"] == []
    when = last["time_from_start"]
    assert when["sec"] + 1e-9 * when["nanosec"] == pytest.approx(motion.duration, abs=1e-9)


@pytest.mark.parametrize("name", LIVE["NAMES"])
def test_pages_of_plans_are_what_their_program_writes(name):
    stored, made = (ROOT / "docs" / f"{name}.html").read_text(), LIVE["page"](name)
    assert len(stored) < 1e6 and f'href="docs/{name}.html"' in (ROOT / "README.md").read_text()
    if is_pinned():
        assert stored == made, "python docs/pages.py writes it again"
        return
    parts = [
        re.split(r'(?<="data">)(.*?)(?=</script>)', text, maxsplit=1) for text in (stored, made)
    ]
    (before, old, after), (begin, new, end) = parts
    old, new = json.loads(old), json.loads(new)
    assert (before, after) == (begin, end) and old.keys() == new.keys()
    for key in ("title", "ground", "meshes"):
        assert len(str(old[key])) == pytest.approx(len(str(new[key])), rel=0.02)
    assert new["times"][-1] == pytest.approx(old["times"][-1], rel=0.05)
