"""`cvqmpt doctor`, `bench`: installation report, timings."""

import json
import re
from importlib import metadata

import pytest

from cvqmpt_lab.cli import setup_command
from cvqmpt_lab.vqmpt import weights
from cvqmpt_lab.vqmpt.weights import weights_digest


@pytest.fixture
def findings(cvqmpt):
    """Return state and text of each line of `doctor` by name, and its exit code."""

    def told(code):
        line = r"^(ok|BROKEN|without) +(\S+) +(.*(?:\n {20}.*)*)"
        found = re.findall(line, cvqmpt("doctor", code=code), re.MULTILINE)
        return {what: (state, " ".join(text.split())) for state, what, text in found}

    return told


def test_here_everything_needed_is_fine(findings):
    found = findings(0)
    assert "BROKEN" not in {state for state, _ in found.values()}
    assert f"numba {metadata.version('numba')}" in found["packages"][1]
    assert found["[train]"] == ("ok", f"torch {metadata.version('torch')}")
    assert weights_digest(weights.WEIGHTS_FOLDER / "vq_mpt")[:16] in found["vq_mpt"][1]


def test_a_missing_package_and_a_missing_extra_name_their_cure(findings, monkeypatch):
    real = metadata.version

    def version(name):
        if name in ("coal", "torch"):
            raise metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(setup_command.metadata, "version", version)
    found = findings(1)
    state, text = found["packages"]
    assert state == "BROKEN" and "coal MISSING" in text and "pip install 'coal" in text
    cure = "torch MISSING; .venv/bin/pip install -c constraints.txt -e '.[train]'"
    assert found["[train]"] == ("without", cure)


def test_damaged_weights_are_broken(findings, monkeypatch, tmp_path):
    folder = tmp_path / "vq_mpt"
    folder.mkdir()
    for path in (weights.WEIGHTS_FOLDER / "vq_mpt").iterdir():
        end = 2000 if path.suffix == ".safetensors" else None
        (folder / path.name).write_bytes(path.read_bytes()[:end])
    monkeypatch.setattr(weights, "WEIGHTS_FOLDER", tmp_path)
    found = findings(1)
    assert found["vq_mpt"][0] == found["mpnet"][0] == "BROKEN"
    assert "is damaged" in found["vq_mpt"][1] and "no weights in" in found["mpnet"][1]


@pytest.mark.parametrize(
    ("bench", "figure"),
    [("stages", "certificate"), ("paper-check", "PyBullet: 66 distances between 11 links")],
)
def test_benches_print_their_figures(cvqmpt, bench, figure):
    """Benchmarks run; their times are not checked."""
    if bench == "paper-check":
        pytest.importorskip("pybullet")
    figures = json.loads(cvqmpt(f"bench {bench} --problems 1 --json"))["figures"]
    assert figure in [item["name"] for item in figures]
    assert all(0.0 < item["low"] <= item["median"] <= item["high"] for item in figures)
