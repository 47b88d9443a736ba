"""`cvqmpt bench`: figures on the screen and in a file."""

import json

import pytest

from cli.main import main


@pytest.mark.parametrize(
    ("bench", "figure"),
    [("stages", "certificate"), ("paper-check", "PyBullet: 66 distances between 11 links")],
)
def test_benches_print_their_figures_and_write_them(capsys, tmp_path, bench, figure):
    """That they run; times are nobody's pass or fail."""
    if bench == "paper-check":
        pytest.importorskip("pybullet")
    out = tmp_path / "figures.json"
    assert main(["bench", bench, "--problems", "1", "--json", str(out)]) == 0
    lines, figures = capsys.readouterr().out.splitlines(), json.loads(out.read_text())
    assert [line.split("  ")[0] for line in lines] == [item["name"] for item in figures]
    assert figure in [item["name"] for item in figures]
    assert all(0.0 < item["low"] <= item["median"] <= item["high"] for item in figures)
    assert [path.name for path in tmp_path.iterdir()] == ["figures.json"]
