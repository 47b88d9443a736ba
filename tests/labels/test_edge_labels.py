"""From labels of one arm's roadmap to curves that tell free from blocked for another arm, which has
no dictionary.
"""

import json

import numpy as np
import pytest

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.labels.edge_labels import area, train_edge_model
from cvqmpt_lab.labels.generation import generate
from cvqmpt_lab.labels.roadmap_labels import RoadmapRecipe
from cvqmpt_lab.training.shards import RoadmapGraph, read_roadmap_shards
from cvqmpt_lab.vqmpt.edge_curve import CURVES_FILE, SOURCES, shipped_curve
from cvqmpt_lab.vqmpt.weights import WEIGHTS


def test_the_area_counts_pairs_in_order():
    rng = np.random.default_rng(0)
    score, free = rng.integers(0, 8, 300).astype(float), rng.random(300) < 0.4
    above = score[free][:, None] - score[~free]
    assert area(score, free) == pytest.approx(((above > 0) + 0.5 * (above == 0)).mean())


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Labels of the Panda's dictionary, and of an arm of six joints in other scenes."""
    out = tmp_path_factory.mktemp("labels")
    generate(RoadmapRecipe(8, 2, ("table", "shelves")), out / "panda", ["test"])
    generate(
        RoadmapRecipe(8, 2, ("shelves", "cage"), 1, {"name": "kinova"}), out / "kinova", ["test"]
    )
    return out / "panda", out / "kinova"


def test_a_curve_of_one_arm_separates_the_edges_of_another(folders, tmp_path):
    panda, kinova = folders
    rows = train_edge_model([panda], [kinova], tmp_path, scenes=8, metadata={"provenance": {}})
    by_curve = [row for row in rows if row["model"] == "clearance"]
    assert {row["source"] for row in by_curve} == set(SOURCES) and len(rows) == 6
    assert (
        min(row["area"] for row in by_curve) > 0.98 and max(row["error"] for row in by_curve) < 0.15
    )
    curves = json.loads((tmp_path / CURVES_FILE).read_text())["curves"]
    for source in SOURCES:
        assert curves[source]["slope"] == pytest.approx(shipped_curve(source).slope, rel=0.6)


def test_the_shipped_curves_hold_on_three_arms_not_trained_on():
    record = json.loads((WEIGHTS / "edges" / CURVES_FILE).read_text())
    for source in SOURCES:
        rows = [r for r in record["judged"] if r["source"] == source and r["model"] == "clearance"]
        assert len(rows) >= 3 and not {row["robot"] for row in rows} & set(record["robots"])
        assert (
            min(row["area_of_all"] for row in rows) >= 0.99
            and max(row["error"] for row in rows) <= 0.05
        )


def test_an_arm_without_dictionary_gets_free_nodes_and_another_s_dictionary_is_refused(
    folders, tmp_path
):
    graph = RoadmapGraph.read(folders[1])
    assert graph.nodes.shape == (1024, 6) and graph.node_possible.mean() > 0.9
    assert np.abs(graph.nodes).max() < 2.0 * np.pi  # its joints turn further
    assert any(np.isfinite(shard.arrays["cost"]).any() for shard in read_roadmap_shards(folders[1]))
    with pytest.raises(
        InvalidInputError, match=r"vq_mpt is no dictionary of ur5.*; leave --dictionary out"
    ):
        RoadmapRecipe(1, 2, ("table",), 0, {"name": "ur5"}, model="vq_mpt").check()
