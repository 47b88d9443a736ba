"""Notebooks run from start to end, are stored without outputs, and define nothing."""

import ast
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from cvqmpt_lab.prediction.weights import WEIGHTS

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
SECONDS = 300.0  # for one cell, kernels being compiled included
NEED_WEIGHTS = ("load_vq_mpt(", "in PLANNERS")  # notebooks with these words load the shipped weights

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code_cells(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_there_are_notebooks():
    assert NOTEBOOKS


@each_notebook
def test_outputs_are_not_stored(path):
    for cell in code_cells(path):
        assert cell.outputs == []
        assert cell.execution_count is None


@each_notebook
def test_defines_nothing(path):
    for cell in code_cells(path):
        for node in ast.walk(ast.parse(cell.source)):
            assert not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef), cell.source


@pytest.mark.slow
@each_notebook
def test_runs(path):
    notebook = nbformat.read(path, as_version=4)
    text = path.read_text(encoding="utf-8")
    if any(word in text for word in NEED_WEIGHTS) and not (WEIGHTS / "vq_mpt").is_dir():
        pytest.skip(f"{path.name} needs the shipped weights, and this checkout has no {WEIGHTS / 'vq_mpt'}")
    NotebookClient(notebook, timeout=SECONDS, resources={"metadata": {"path": str(FOLDER)}}).execute()
    shown = [
        kind
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        for kind in output.get("data", {})
    ]
    assert "image/png" in shown
    assert shown.count("text/markdown") >= 2
