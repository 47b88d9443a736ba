"""Commands in README, docs and helps are understood; those of the README that take seconds are run, in its order."""

import importlib
import re
import shlex
from pathlib import Path

import pytest

from cli.main import COMMANDS, main, parser_with

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
QUICK = (
    ("plan", "place-task"),
    ("robot", "ur5"),
    ("problems", "new"),
    ("plan", "--problem-file"),
    ("model", "info"),
)
"""First words of what is run here. Left out are films, tasks of several phases, scans of the reader's own, what takes
minutes (`reproduce`, `make`), what writes into the checkout (`claims`), and `report` and `compare`, which tests of
their own run on smaller folders."""


def commands_of(text):
    """Words of every `cvqmpt` command in the fenced blocks of a page; of choices such as a|b, the first."""
    for block in re.findall(r"```\w*\n(.*?)```", text, re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            if found := re.match(r"(?:.*&& )?(?:\.venv/bin/)?cvqmpt (.*)", line.partition("#")[0]):
                words = shlex.split(re.split(r" [&>]", found[1])[0])
                yield [word.partition("|")[0] for word in words if word != "..."]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_on_pages_are_understood(page):
    for words in commands_of(page.read_text(encoding="utf-8")):
        parser_with([words[0]]).parse_args(words)


@pytest.mark.parametrize("command", COMMANDS)
def test_examples_in_helps_are_understood(command):
    examples = importlib.import_module(f"cli.{command.replace('-', '_')}_command").EXAMPLES
    found = list(commands_of("```\n{}\n```".format("\n".join(examples))))
    assert found and all(words[0] == command for words in found)
    for words in found:
        parser_with([command]).parse_args(words)


def test_targets_of_make_on_pages_are_there():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = {name for page in PAGES for name in re.findall(r"[`\n]make ([a-z-]+)", page.read_text())}
    assert {"reproduce", "test"} <= named <= targets


def test_commands_are_found_as_they_are_written():
    text = "```\ncd x && .venv/bin/cvqmpt plan a --seed 0 && b\ncvqmpt bench x|y|...  # c\nmake venv\n```\ncvqmpt no"
    assert list(commands_of(text)) == [["plan", "a", "--seed", "0"], ["bench", "x"]]


def test_quick_commands_of_the_readme_run(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    commands = list(commands_of(PAGES[0].read_text(encoding="utf-8")))
    quick = [words for words in commands if tuple(words[:2]) in QUICK and "--save" not in words]
    assert {tuple(words[:2]) for words in quick} == set(QUICK)
    for words in quick:
        assert main(words) == 0, (words, capsys.readouterr())
    assert {"plan.png", "motion.json", "mine.json"} <= {p.name for p in tmp_path.iterdir()}
