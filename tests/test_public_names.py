"""What `import cvqmpt_lab` gives, and the example of the README."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import cvqmpt_lab
from cli.main import main

ROOT = Path(__file__).resolve().parents[1]


def test_every_public_name_is_there():
    assert len(cvqmpt_lab.__all__) == len({id(getattr(cvqmpt_lab, name)) for name in cvqmpt_lab.__all__})
    with pytest.raises(AttributeError, match="public names: Budget"):
        _ = cvqmpt_lab.solv


def test_importing_the_package_imports_nothing_else():
    code = "import sys, cvqmpt_lab; print(*sorted({name.split('.')[0] for name in sys.modules}))"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert not {"numpy", "numba", "torch", "pinocchio", "ompl"} & set(loaded.stdout.split())


def test_the_example_of_the_readme_runs(tmp_path, monkeypatch, capsys):
    example = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
    assert len(re.findall(r"^(?:from|import) ", example, re.MULTILINE)) == 1
    monkeypatch.chdir(tmp_path)
    assert main(["problems", "export", "place-task", "--problems", "8", "--out", "problems"]) == 0
    capsys.readouterr()
    exec(compile(example, "README.md", "exec"), {})
    assert re.fullmatch(r"solved \d+\.\d+ True\n", capsys.readouterr().out)


def test_a_sampler_of_ones_own_is_a_function(tmp_path, monkeypatch):
    example = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "your_own.md").read_text(), re.DOTALL)[-1]
    monkeypatch.chdir(tmp_path)
    assert main(["problems", "new", "mine.json", "--robot", "ur5"]) == 0
    names = {}
    exec(compile(example, "your_own.md", "exec"), names)
    assert names["solution"].solved and names["solution"].plan.sampler == "halfway"
