"""Figures of rows and of trainings: break-even prices; curves from folders and from their table."""

import csv
import json
from itertools import product

import pytest
from made_rows import a_row
from refusals import refused

from cvqmpt_lab.results.row import RUNS_FILE, write_rows
from experiments.figures.row_figures import OURS, draw_cost, draw_training


def test_a_method_breaks_even_where_saved_checks_pay_for_its_networks(tmp_path):
    """100 checks + 1 ms of networks against 1100 checks: equal at 1 us more per check."""
    shared = {"n_projections": 0, "t_goals_s": 0.0}
    runs = ("birrt", 1100, 0.002), ("learned", 100, 0.003), ("dear", 2000, 0.003)
    rows = [
        a_row(f"p{k}", planner, n_state_checks=checks, t_total_s=time, **shared)
        for k in range(4)
        for planner, checks, time in runs
    ]
    write_rows(tmp_path / RUNS_FILE, rows)
    written = draw_cost(tmp_path, tmp_path)
    assert [path.name for path in written] == ["cost.png", "cost.svg", "cost.csv"]
    with written[-1].open() as file:
        found = {line["planner"]: line for line in csv.DictReader(file)}
    assert float(found["learned"]["break_even_us"]) == pytest.approx(1e6 * (OURS + 1e-6), rel=0.02)
    assert float(found["learned"]["time_at_ours"]) == pytest.approx(1.5)
    assert float(found["learned"]["work"]) == pytest.approx(1 / 11, rel=1e-5)
    assert found["dear"]["break_even_us"] == "" and float(found["dear"]["time_at_papers"]) > 1.0


def test_trainings_are_drawn_from_their_folders_and_from_the_table(tmp_path):
    run, other = tmp_path / "runs" / "published-0", tmp_path / "again"
    run.mkdir(parents=True)
    other.mkdir()
    refused("no curves of cvqmpt train", draw_training, other, other)
    profile = {"published": {"scenes": 4, "paths": 96}}
    (run / "training.json").write_text(json.dumps({"stage": "published", "profile": profile}))
    parts = product(("", "wrong_cloud_", "no_cloud_"), ("all", "ways"))
    names = [f"validation_{cloud}cross_entropy_{which}" for cloud, which in parts]
    (run / "curves.csv").write_text(f"step,seconds,{','.join(names)}\n400,9.5,4,1,5,2,6,3\n")
    *_, table = draw_training(run.parent, run.parent)
    assert table.read_text().splitlines()[1] == "published-0,published,153600,9.5,1,4,2,5,3,6"
    (other / "training.csv").write_text(table.read_text())
    assert draw_training(other, other)[-1].read_text() == table.read_text()
