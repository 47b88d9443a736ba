"""LaTeX tables: split if too wide; compiled if a compiler is installed."""

import re
import shutil
import subprocess

import pytest

from paper_tables.committed import RESULTS
from paper_tables.writers import MOST_COLUMNS, latex_table

TABLES = sorted(RESULTS.glob("*/table.tex"))
COMPILER = shutil.which("pdflatex")
DOCUMENT = (
    r"\documentclass[twocolumn]{article}\usepackage[a4paper,margin=15mm]{geometry}\usepackage{booktabs}"
    "\n\\begin{document}\n%s\n\\end{document}\n"
)


def tables_of(text):
    """Lines of cells of every table in a file, and how many columns each declares."""
    for part in text.split(r"\begin{table*}")[1:]:
        columns = re.search(r"\\begin\{tabular\}\{([lc]+)\}", part)[1]
        body = part.split(r"\toprule")[1].split(r"\bottomrule")[0]
        lines = [line.strip() for line in body.strip().splitlines() if r"\midrule" not in line]
        assert all(line.endswith(r"\\") for line in lines)
        yield [re.split(r"(?<!\\)&", line.removesuffix(r"\\")) for line in lines], len(columns)


def test_planners_that_do_not_fit_side_by_side_make_tables_of_their_own():
    names = [f"p{k}" for k in range(MOST_COLUMNS + 2)]
    text = latex_table("", "x", [[["", "", *names]], [["time", "ours", *names]]])
    found = [[[cell.strip() for cell in line] for line in lines] for lines, _ in tables_of(text)]
    parts = names[:MOST_COLUMNS], names[MOST_COLUMNS:]
    assert found == [[["", "", *part], ["time", "ours", *part]] for part in parts]
    assert text.count(r"\label{tab:x}") == 1
    escaped = latex_table("", "x", [[["", "", "my_50%_#1"], ["time", "ours", "–∞"]]])
    assert r"my\_50\%\_\#1" in escaped and escaped.isascii()


@pytest.mark.skipif(COMPILER is None, reason="no pdflatex (apt: texlive-latex-recommended)")
def test_committed_tables_compile_and_fit_on_pages(tmp_path):
    tables = "\n\\clearpage\n".join(path.read_text(encoding="utf-8") for path in TABLES)
    (tmp_path / "tables.tex").write_text(DOCUMENT % tables, encoding="utf-8")
    words = [COMPILER, "-halt-on-error", "-interaction=nonstopmode", "tables.tex"]
    how = {"capture_output": True, "text": True, "timeout": 120, "errors": "replace"}
    done = subprocess.run(words, cwd=tmp_path, **how)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "Overfull" not in done.stdout and "too large" not in done.stdout
