"""`cvqmpt doctor` finds what is there, and says how to get what is not."""

import re
from importlib import metadata

from cli import setup_command
from cli.main import main
from cvqmpt_lab.vqmpt import weights
from cvqmpt_lab.vqmpt.weights import weights_digest


def findings(capsys):
    """State and text of everything that was printed, by name."""
    line = r"^(ok|BROKEN|without) +(\S+) +(.*(?:\n {20}.*)*)"
    found = re.findall(line, capsys.readouterr().out, re.MULTILINE)
    return {what: (state, " ".join(text.split())) for state, what, text in found}


def test_here_everything_needed_is_fine(capsys):
    assert main(["doctor"]) == 0
    found = findings(capsys)
    assert "BROKEN" not in {state for state, _ in found.values()}
    assert f"numba {metadata.version('numba')}" in found["packages"][1]
    assert found["[train]"] == ("ok", f"torch {metadata.version('torch')}")
    assert weights_digest(weights.WEIGHTS / "vq_mpt")[:16] in found["vq_mpt"][1]


def test_a_missing_package_and_a_missing_extra_name_their_cure(capsys, monkeypatch):
    real = metadata.version
    gone = {"coal", "torch"}

    def version(name):
        if name in gone:
            raise metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(setup_command.metadata, "version", version)
    assert main(["doctor"]) == 1
    found = findings(capsys)
    state, text = found["packages"]
    assert state == "BROKEN" and "coal MISSING" in text and "pip install 'coal" in text
    assert found["[train]"] == (
        "without",
        "torch MISSING; .venv/bin/pip install -c constraints.txt -e '.[train]'",
    )


def test_damaged_weights_are_broken(capsys, monkeypatch, tmp_path):
    folder = tmp_path / "vq_mpt"
    folder.mkdir()
    for path in (weights.WEIGHTS / "vq_mpt").iterdir():
        (folder / path.name).write_bytes(
            path.read_bytes()[: 2000 if path.suffix == ".safetensors" else None]
        )
    monkeypatch.setattr(weights, "WEIGHTS", tmp_path)
    assert main(["doctor"]) == 1
    found = findings(capsys)
    assert found["vq_mpt"][0] == found["mpnet"][0] == "BROKEN"
    assert "is damaged" in found["vq_mpt"][1] and "no weights in" in found["mpnet"][1]
