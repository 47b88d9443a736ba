"""Run notebooks and store their outputs in them, with small pictures.

`make notebooks`, or `python docs/run_notebooks.py NOTEBOOK.ipynb ...` for some of them.
"""

import io
import sys
from base64 import b64decode, b64encode
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
TIMEOUT_S = 600  # of a cell [s]
WIDTH, COLOURS = 1000, 256  # of a stored picture [pixels], and how many different ones it has


def small(picture: str) -> str:
    """A PNG (base64) with a palette, at most WIDTH wide."""
    image = Image.open(io.BytesIO(b64decode(picture))).convert("RGB")
    image.thumbnail((WIDTH, 2 * WIDTH), Image.Resampling.LANCZOS)
    made = io.BytesIO()
    image.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=3).save(made, "PNG", optimize=True)
    return b64encode(made.getvalue()).decode("ascii")


def run(path: Path) -> None:
    """Run one notebook in a fresh kernel;
    an error in a cell is raised, and the file stays as it was.
    """
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=TIMEOUT_S, record_timing=False).execute()
    for cell in notebook.cells:  # progress and warnings name files of this machine
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
            for data in (output["data"] for output in cell.outputs if "data" in output):
                if "image/png" in data:
                    data["image/png"] = small(data["image/png"])
    notebook.metadata["language_info"] = {"name": "python"}  # no version of this machine
    nbformat.write(notebook, path)
    print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    for path in map(Path, sys.argv[1:]) if sys.argv[1:] else sorted(NOTEBOOKS.glob("*.ipynb")):
        run(path)
