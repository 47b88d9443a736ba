"""Prediction with small networks of random weights: features, cache, union, mixture, refusals."""

import dataclasses

import numpy as np
import pytest
import torch
from small_models import METADATA, published_config, random_checkpoint, small_config
from training_data import LOWER, UPPER, kinematics

from cvqmpt_lab.codec.plain import from_plain
from cvqmpt_lab.distributions import Uniform
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.models.checkpoint import stored
from cvqmpt_lab.models.robot_signature import RobotSignature
from cvqmpt_lab.models.serial_chain import SerialChain
from cvqmpt_lab.prediction.code_decoder import CodeDecoder
from cvqmpt_lab.prediction.configurations import ModelConfigurations
from cvqmpt_lab.prediction.predictor import GOAL_STD, Predictor
from cvqmpt_lab.prediction.settings import AS_PUBLISHED, PredictorSettings
from cvqmpt_lab.training.link_positions import LinkPositions

BEAM = PredictorSettings(uniform_share=0.15, std_floor=None)
SAMPLED = dataclasses.replace(BEAM, decoding="sampled")


@pytest.fixture(scope="module")
def checkpoint(panda):
    return random_checkpoint(panda)


@pytest.fixture(scope="module")
def queries(panda):
    """Cloud, start and six goals."""
    rng = np.random.default_rng(3)
    q = panda.random_configurations(rng, 7)
    return rng.uniform(-0.8, 0.8, (200, 3)), q[0], q[1:]


def predict(predictor, queries, seed=0):
    return predictor.predict(*queries, np.random.default_rng(seed))


def test_configurations_are_those_of_training(panda, checkpoint):
    q = panda.random_configurations(np.random.default_rng(0), 300)
    ours = ModelConfigurations(stored(checkpoint), panda)
    chain = from_plain(SerialChain, kinematics())
    links = LinkPositions(tuple(LOWER), tuple(UPPER), chain)
    u = ours.normalised(q)
    np.testing.assert_allclose(ours.of(q), links.configurations(torch.from_numpy(u).float()), atol=1e-6)
    np.testing.assert_allclose(ours.radians(u), q, atol=1e-12)


def test_every_goal_has_the_distinct_codes_of_its_finished_sequences(panda, checkpoint, queries):
    prediction = predict(Predictor(stored(checkpoint), panda, SAMPLED), queries)
    assert len(prediction.sequences) == 6 and {len(s) for s in prediction.sequences} == {8}
    assert any(len(one.codes) > 3 for one in prediction.sequences[0])
    for goal, found in enumerate(prediction.sequences):
        codes = prediction.codes[prediction.goal_of == goal]
        assert len(set(codes)) == len(codes)
        assert set(codes) == {code for one in found if one.finished for code in one.codes}
        best = max((one for one in found if one.finished), key=lambda one: one.log_probability)
        assert list(codes[: len(set(best.codes))]) == list(dict.fromkeys(best.codes))
    vectors = checkpoint.dictionary.quantizer.embedding.weight.detach().numpy()
    np.testing.assert_array_equal(prediction.z, vectors[prediction.codes])
    np.testing.assert_allclose(np.linalg.norm(prediction.z, axis=1), 1.0, rtol=1e-6)


@torch.inference_mode()
def test_gaussians_are_refined_where_their_code_stands(panda, checkpoint, queries):
    cloud, start, goals = queries
    predictor = Predictor(stored(checkpoint), panda, BEAM)
    prediction = predict(predictor, queries)
    model, dictionary = checkpoint.sequence_model, checkpoint.dictionary
    scene = model.encode_scene([torch.from_numpy(cloud).float()])
    q = torch.from_numpy(predictor.configurations.of(np.vstack((start[None], goals))))
    span = panda.upper - panda.lower
    checked = 0
    for goal, (one,) in enumerate(prediction.sequences):
        if not one.finished:
            continue
        ends = q[[0, goal + 1]]
        codes = torch.tensor([one.codes])
        states = model(scene, ends[:1], ends[1:], codes, dictionary.encode(ends[:, None]).view(1, 2)).states
        expected = model.refine(states, dictionary.code_gaussians(codes))
        mine = prediction.goal_of == goal
        first = [one.codes.index(code) for code in prediction.codes[mine]]
        np.testing.assert_allclose(prediction.mean_u[mine], expected.mean[0, first], atol=1e-5)
        covariance = expected.covariance[0, first].numpy()
        np.testing.assert_allclose(prediction.covariance_u[mine], covariance, rtol=1e-4, atol=1e-8)
        np.testing.assert_allclose(
            prediction.means[mine], panda.lower + span * expected.mean[0, first].numpy(), atol=1e-4
        )
        checked += len(first)
    assert checked > 5


def test_goals_in_one_batch_are_predicted_as_alone(panda, checkpoint, queries):
    cloud, start, goals = queries
    predictor = Predictor(stored(checkpoint), panda, BEAM)
    together = predict(predictor, queries)
    for goal in range(len(goals)):
        alone = predict(predictor, (cloud, start, goals[goal : goal + 1]))
        assert alone.sequences[0][0].codes == together.sequences[goal][0].codes
        np.testing.assert_allclose(alone.means, together.means[together.goal_of == goal], atol=1e-4)


@pytest.mark.parametrize("decoding", ["beam", "sampled"])
def test_a_known_scene_changes_nothing_but_the_time(panda, checkpoint, queries, decoding):
    predictor = Predictor(stored(checkpoint), panda, dataclasses.replace(BEAM, decoding=decoding))
    first, again = predict(predictor, queries), predict(predictor, queries)
    fresh = predict(
        Predictor(stored(checkpoint), panda, dataclasses.replace(BEAM, decoding=decoding)), queries
    )
    assert (first.cached, again.cached, fresh.cached) == (False, True, False)
    for name in ("codes", "goal_of", "z", "mean_u", "covariance_u", "means", "covariances"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name), strict=True)
        np.testing.assert_array_equal(getattr(fresh, name), getattr(first, name), strict=True)
    assert again.sequences == first.sequences and again.predict_seconds > 0.0


def test_the_least_recently_used_scene_is_forgotten(panda, checkpoint, queries):
    predictor = Predictor(stored(checkpoint), panda, dataclasses.replace(SAMPLED, scenes=2))
    clouds = [queries[0] + 0.1 * i for i in range(3)]
    assert [predictor.encode_scene(clouds[i]).cached for i in (0, 1, 0, 2, 0, 1)] == [
        False, False, True, False, True, False,
    ]  # fmt: skip
    np.testing.assert_array_equal(queries[0], clouds[0])


def test_samples_depend_on_the_seed_alone(panda, checkpoint, queries):
    predictor = Predictor(stored(checkpoint), panda, SAMPLED)
    one, same, other = (predict(predictor, queries, seed) for seed in (1, 1, 2))
    assert one.sequences == same.sequences != other.sequences


@pytest.mark.parametrize("settings", [BEAM, dataclasses.replace(BEAM, scoring="published"), SAMPLED])
def test_the_published_architecture_predicts_the_dictionary_s_gaussians(panda, queries, settings):
    checkpoint = random_checkpoint(panda, published_config(), goal_bias=6.0, metadata={})
    prediction = predict(Predictor(stored(checkpoint), panda, settings), queries)
    assert prediction.refinement is None and len(prediction.codes) >= 6
    with torch.no_grad():
        expected = checkpoint.dictionary.code_gaussians(torch.from_numpy(prediction.codes))
    np.testing.assert_allclose(prediction.mean_u, expected.mean, atol=1e-5)
    np.testing.assert_allclose(prediction.covariance_u, expected.covariance, rtol=1e-3, atol=1e-6)


def test_the_mixture_is_the_union_the_goals_and_a_uniform_share(panda, checkpoint, queries):
    predictor = Predictor(stored(checkpoint), panda, SAMPLED)
    prediction = predict(predictor, queries)
    mixture = predictor.mixture(prediction)
    c, span = len(prediction.codes), panda.upper - panda.lower
    assert mixture.name == "cvq-mpt" and len(mixture.weights) == c + 6
    np.testing.assert_allclose(mixture.weights, 1.0 / (c + 6))
    np.testing.assert_array_equal(mixture.means[:c], prediction.means)
    np.testing.assert_array_equal(mixture.means[c:], queries[2])
    np.testing.assert_allclose(mixture.covariances[c:], [np.diag((GOAL_STD * span) ** 2)] * 6)
    np.testing.assert_allclose(mixture.covariances[:c], prediction.covariances)
    assert mixture.uniform_share == 0.15
    np.testing.assert_array_equal(mixture.uniform.lower, panda.lower)
    plain = dataclasses.replace(predictor.settings, goal_gaussian=False, uniform_share=0.0, name="plain")
    mixture = Predictor(stored(checkpoint), panda, plain).mixture(prediction)
    assert (len(mixture.weights), mixture.uniform_share, mixture.name) == (c, 0.0, "plain")
    draws = mixture.sample(np.random.default_rng(0), 20_000)
    np.testing.assert_allclose(draws.mean(0), prediction.means.mean(0), atol=0.1)


def test_moved_codes_keep_their_refinement(panda, checkpoint, queries):
    predictor = Predictor(stored(checkpoint), panda, SAMPLED)
    prediction = predict(predictor, queries)
    z = np.roll(prediction.z, 1, axis=0)
    mixture = predictor.mixture(prediction, z)
    c, span = len(z), panda.upper - panda.lower
    means = CodeDecoder(stored(checkpoint)).decode(z).mean + prediction.refinement.shift
    np.testing.assert_allclose(mixture.means[:c], panda.lower + span * means, atol=1e-5)
    np.testing.assert_allclose(mixture.covariances[:c], prediction.covariances)
    unmoved = predictor.mixture(prediction, prediction.z)
    np.testing.assert_array_equal(unmoved.means, predictor.mixture(prediction).means)
    with pytest.raises(InvalidInputError, match=r"codes of shape \(1, 8\); expected"):
        predictor.mixture(prediction, z[:1])


def test_gaussians_can_be_widened(panda, checkpoint, queries):
    predictor = Predictor(stored(checkpoint), panda, dataclasses.replace(SAMPLED, std_floor=0.5))
    prediction = predict(predictor, queries)
    before = np.sqrt(np.linalg.eigvalsh(prediction.covariances))
    after = np.sqrt(np.linalg.eigvalsh(predictor.mixture(prediction).covariances))[: len(before)]
    assert before.min() < 0.49 and before.max() > 0.51
    np.testing.assert_allclose(after, np.maximum(before, 0.5), rtol=1e-6)


def test_goals_that_are_never_reached_are_named(panda, queries):
    never = random_checkpoint(panda, goal_bias=-1e6)
    predictor = Predictor(stored(never), panda, SAMPLED)
    prediction = predict(predictor, queries)
    assert prediction.unfinished == tuple(range(6)) and len(prediction.codes) == 0
    np.testing.assert_array_equal(predictor.mixture(prediction).means, queries[2])
    for settings in (dataclasses.replace(SAMPLED, goal_gaussian=False), AS_PUBLISHED):
        assert isinstance(Predictor(stored(never), panda, settings).mixture(prediction), Uniform)


def test_as_published_repeated_codes_count_as_often_as_they_occur(panda, checkpoint, queries):
    """Random weights repeat codes; the goal's Gaussian comes on top."""
    predictor = Predictor(stored(checkpoint), panda, AS_PUBLISHED)
    prediction = predict(predictor, queries)
    finished = [one for found in prediction.sequences for one in found if one.finished]
    assert len(prediction.codes) == sum(len(one.codes) for one in finished)
    once = predict(
        Predictor(stored(checkpoint), panda, dataclasses.replace(AS_PUBLISHED, repeated_codes=False)), queries
    )
    assert len(once.codes) == sum(len(set(one.codes)) for one in finished) < len(prediction.codes)
    mixture = predictor.mixture(prediction)
    assert len(mixture.weights) == len(prediction.codes) + 6 and mixture.uniform_share == 0.0


def test_some_goals_unfinished(panda, checkpoint, queries):
    """Few tokens, so that some sequences end in time and others do not."""
    predictor = Predictor(stored(checkpoint), panda, dataclasses.replace(SAMPLED, max_length=6, sequences=2))
    prediction = predict(predictor, queries)
    lost = len(prediction.unfinished)
    assert 0 < lost < 6
    assert not set(prediction.goal_of) & set(prediction.unfinished)


HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
CLOUD = np.random.default_rng(0).uniform(-0.8, 0.8, (50, 3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cloud": np.empty((0, 3))}, "point cloud of 0 points; give at least 2"),
        ({"cloud": CLOUD[:1]}, "point cloud of 1 points"),
        ({"cloud": np.where(np.arange(50)[:, None] == 7, np.nan, CLOUD)}, "1 points with NaN"),
        ({"cloud": 1000.0 * CLOUD}, "give metres, not millimetres"),
        ({"cloud": CLOUD[:, :2]}, r"shape \(50, 2\); it must be \(n, 3\)"),
        ({"cloud": CLOUD[None]}, r"shape \(1, 50, 3\)"),
        ({"cloud": "cloud.ply"}, "point cloud must be numbers"),
        ({"start": HOME + [0, 0, 0, 3.0, 0, 0, 0]}, "start: joint 'panda_joint4' is 0.7138 outside"),
        ({"start": HOME[:6]}, r"start of shape \(6,\); robot 'panda' takes \(7,\)"),
        ({"goals": [HOME, HOME - 2.0]}, "goal 1: joint 'panda_joint4' is"),
        ({"goals": HOME}, r"goals of shape \(7,\)"),
        ({"goals": np.empty((0, 7))}, "at least one"),
        ({"goals": [HOME * np.nan]}, "goal 0: joint 'panda_joint1' is not finite"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(panda, checkpoint, change, message):
    given = {"cloud": CLOUD, "start": HOME, "goals": [HOME]} | change
    with pytest.raises(InvalidInputError, match=message) as caught:
        Predictor(stored(checkpoint), panda, SAMPLED).predict(**given, rng=np.random.default_rng(0))
    assert "\n" not in str(caught.value)


def changed_kinematics(**changes):
    return {"kinematics": METADATA["kinematics"] | changes}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sequence_model": None}, "train stage2"),
        ({"robot": RobotSignature("ur5", tuple(LOWER), tuple(UPPER))}, "for robot 'ur5', not 'panda'"),
        ({"metadata": {}}, "its metadata has no kinematics"),
        ({"metadata": changed_kinematics(points=[1, 2])}, "points and offsets describe 7, 7, 2 and 4"),
        (
            {"metadata": changed_kinematics(translation=np.full((7, 3), 0.01).tolist())},
            "another translation of joint 'panda_joint5' .difference 0.374",
        ),
    ],
)  # fmt: skip
def test_models_that_do_not_fit_the_robot_are_refused(panda, checkpoint, change, message):
    with pytest.raises(InvalidInputError, match=message):
        Predictor(stored(dataclasses.replace(checkpoint, **change)), panda)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"decoding": "greedy"}, "unknown decoding 'greedy'; valid choices: beam, sampled"),
        ({"scoring": "best"}, "unknown scoring 'best'"),
        ({"sequences": 0}, "sequences of the predictor is 0"),
        ({"uniform_share": 1.5}, "uniform_share of the predictor is 1.5"),
        ({"std_floor": 0.0}, "std_floor of the predictor is 0.0"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises((InvalidInputError, UnknownChoiceError), match=message):
        PredictorSettings(**settings)


def test_a_model_without_features_or_refinement(panda, queries):
    config = small_config(refinement=False, feature_dim=0)
    prediction = predict(Predictor(stored(random_checkpoint(panda, config, metadata={})), panda), queries)
    assert prediction.refinement is None and np.isfinite(prediction.covariances).all()
