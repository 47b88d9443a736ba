"""The completion that bash is given knows commands, options, names and files."""

import shutil
import subprocess

import pytest
from command_line import refused

from cli.main import COMMANDS, main
from cvqmpt_lab.planners import CONTROLS, PLANNERS

ASK = """source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
$(complete -p cvqmpt | sed 's/.*-F \\([^ ]*\\).*/\\1/') cvqmpt "${@: -1}" "${@: -2:1}"; printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    """The script for bash, in a file."""
    path = tmp_path_factory.mktemp("completion") / "cvqmpt"
    with pytest.MonkeyPatch.context() as patch, path.open("w") as handle:
        patch.setattr("sys.stdout", handle)
        assert main(["completion", "bash"]) == 0
    return path


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("pl",), {"plan"}),
        (("",), set(COMMANDS)),
        (("plan", "place-task", "--planner", ""), {*PLANNERS, *CONTROLS}),
        (("plan", "place-task", "--planner", "cvq-w"), {"cvq-wide"}),
        (("reproduce", "place-task-w"), {"place-task-with-can"}),
        (("robot", "xa"), {"xarm7"}),
        (("table", "--ompl"), {"--ompl-log"}),
    ],
)
def test_bash_offers(script, words, offered):
    asked = ["bash", "-c", ASK, "bash", script, "cvqmpt", *words]
    done = subprocess.run(asked, capture_output=True, text=True)
    assert set(done.stdout.split()) == offered, done.stderr


def test_an_unknown_shell_is_refused(capsys):
    assert "'nope'" in (line := refused(capsys, "completion", "nope")) and "bash" in line
