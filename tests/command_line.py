"""What tests of commands share."""

from cli.main import main


def refused(capsys, *words):
    """The one line on standard error of a command that is refused."""
    code = main([str(word) for word in words])
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert code == 2 and len(lines) == 1 and captured.out == "", (code, captured)
    assert lines[0].startswith("cvqmpt: ")
    return lines[0]
