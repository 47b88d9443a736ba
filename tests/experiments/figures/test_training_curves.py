"""The figure of trainings: drawn from their folders, and again from the table it leaves."""

import json

import pytest

from cvqmpt_lab.errors import InvalidInputError
from experiments.figures.rows import draw_training


def test_trainings_are_drawn_from_their_folders_and_from_the_table(tmp_path):
    run, other = tmp_path / "runs" / "published-0", tmp_path / "again"
    run.mkdir(parents=True)
    other.mkdir()
    with pytest.raises(InvalidInputError, match="no curves of cvqmpt train"):
        draw_training(other, other)
    profile = {"published": {"scenes": 4, "paths": 96}}
    (run / "training.json").write_text(json.dumps({"stage": "published", "profile": profile}))
    names = [
        f"validation_{p}cross_entropy_{w}"
        for p in ("", "wrong_cloud_", "no_cloud_")
        for w in ("all", "ways")
    ]
    (run / "curves.csv").write_text(f"step,seconds,{','.join(names)}\n400,9.5,4,1,5,2,6,3\n")
    *_, table = draw_training(run.parent, run.parent)
    assert table.read_text().splitlines()[1] == "published-0,published,153600,9.5,1,4,2,5,3,6"
    (other / "training.csv").write_text(table.read_text())
    assert draw_training(other, other)[-1].read_text() == table.read_text()
