"""Commands and programs on pages of the documentation and in helps."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
OURS = r"(?:.*&& |- run: )?(?:\.venv/bin/)?cvqmpt (.*)"
OTHERS = r"(?:- run: )?(?:make|git|dask|(?:\.venv/bin/)?(?:pip|pytest|python)) .*"


def command_lines(text):
    """Return the lines of the fenced blocks of a page that are commands, without remarks."""
    for language, block in re.findall(r"```(\w*)\n(.*?)```", text, re.DOTALL):
        if language not in ("", "bash", "yaml"):
            continue
        for line in block.replace("\\\n", " ").splitlines():
            line = line.partition(" #")[0].strip(" ")
            if re.match(rf"{OURS}|{OTHERS}", line):
                yield line


def words_of(line):
    """Return the words after `cvqmpt` of a line, None for another command; a of a|b."""
    if found := re.match(OURS, line):
        words = shlex.split(re.split(r" [&>]", found[1])[0])
        return [word.partition("|")[0] for word in words if word != "..."]
    return None


def commands_of(text):
    """Return the words of each `cvqmpt` command in the fenced blocks of a page."""
    return [words for line in command_lines(text) if (words := words_of(line)) is not None]


def python_of(page):
    """Return the fenced blocks of Python of a page."""
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
