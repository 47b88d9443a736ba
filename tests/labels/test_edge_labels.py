"""From labels to an edge validity model that tells free from blocked, on a few scenes."""

from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.labels.edge_labels import examples_of, train_edge_model
from cvqmpt_lab.labels.generation import generate
from cvqmpt_lab.labels.path_labels import unconstrained_space
from cvqmpt_lab.labels.roadmap_labels import RoadmapRecipe, verdicts
from cvqmpt_lab.planners import planner_named
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.scene.families import family_scene
from cvqmpt_lab.sensing.virtual import CameraSettings, camera_cloud
from cvqmpt_lab.training.shards import RoadmapGraph
from cvqmpt_lab.vqmpt.edge_model import EdgeModel, SmallNetwork
from cvqmpt_lab.vqmpt.weights import VQ_MPT, load_vq_mpt, read_model, write_model
from experiments.bench.perception import area
from experiments.suites.place_task import place_problem


def test_the_area_counts_pairs_in_order():
    rng = np.random.default_rng(0)
    score, free = rng.integers(0, 8, 300).astype(float), rng.random(300) < 0.4
    above = score[free][:, None] - score[~free]
    assert area(score, free) == pytest.approx(((above > 0) + 0.5 * (above == 0)).mean())


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    out = tmp_path_factory.mktemp("labels")
    generate(RoadmapRecipe(16, 2, ("table", "shelves")), out, ["test"])
    return out


def test_a_model_trained_on_a_few_scenes_knows_free_from_blocked_in_another(data, tmp_path):
    robot = panda()
    assert train_edge_model(data, tmp_path, scenes=400, metadata={}) == 14 * (256 + 512)
    model = read_model(tmp_path / "model", architecture=VQ_MPT)
    shipped = load_vq_mpt(robot)
    vectors = [one.parts["dictionary"]["quantizer.embedding.weight"] for one in (model, shipped)]
    np.testing.assert_array_equal(*vectors)
    edge_model, graph = EdgeModel(SmallNetwork.of(model.parts["sight"]), robot), RoadmapGraph.read(data)
    scene = family_scene("shelves", 7)
    checked = verdicts(unconstrained_space(robot, scene), graph.nodes, graph.edges, graph.edge_possible)
    cloud = camera_cloud(scene, CameraSettings.like_training(4096), np.random.default_rng(0))
    seen = examples_of(edge_model, cloud, graph, *checked)
    assert area(seen.odds[seen.edge], seen.free[seen.edge]) > 0.97
    nowhere = examples_of(edge_model, cloud + 5.0, graph, *checked)
    assert area(nowhere.odds[seen.edge], seen.free[seen.edge]) < 0.8


def test_weights_without_an_edge_model_are_refused_by_the_graph_alone(tmp_path):
    model = load_vq_mpt(panda())
    write_model(tmp_path / "m", replace(model, parts={"dictionary": model.parts["dictionary"]}))
    assert planner_named("roadmap-cvq", str(tmp_path / "m")).stages(place_problem(1003)).observe is None
    with pytest.raises(InvalidInputError, match="no edge validity model, only dictionary"):
        planner_named("graph-cvq", str(tmp_path / "m")).stages(place_problem(1003))


def test_data_without_a_scene_to_train_on_is_refused(tmp_path):
    out = tmp_path / "one"  # its only scene validates
    generate(RoadmapRecipe(1, 2, ("table",)), out, ["test"])
    with pytest.raises(InvalidInputError, match="no scene to train on"):
        train_edge_model(out, tmp_path, scenes=400, metadata={})
