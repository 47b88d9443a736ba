"""What prediction computes in numpy is what the torch modules compute that were trained, on random weights."""

import dataclasses

import numpy as np
import pytest
import torch
from small_models import random_checkpoint, small_config

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.checkpoint import stored
from cvqmpt_lab.prediction.code_encoder import CodeEncoder
from cvqmpt_lab.prediction.collision_head import CollisionHead
from cvqmpt_lab.prediction.compact_network import CompactNetwork
from cvqmpt_lab.prediction.configurations import ModelConfigurations
from cvqmpt_lab.prediction.dictionary_gaussians import dictionary_gaussians

TOLERANCE = 1e-5
CLOUD = np.random.default_rng(1).uniform(-0.8, 0.8, (200, 3)).astype(np.float32)


@pytest.fixture(scope="module", params=["fine", "coarse"])
def checkpoint(request, panda):
    """With heads, and batch norms as training leaves them, some of negative scale."""
    config = small_config()
    sequence = dataclasses.replace(
        config.sequence, collision_head=True, connectivity_head=True, head_level=request.param
    )
    checkpoint = random_checkpoint(panda, dataclasses.replace(config, sequence=sequence))
    with torch.no_grad():
        for module in checkpoint.sequence_model.modules():
            if isinstance(module, torch.nn.BatchNorm1d):
                module.weight.normal_()
                module.running_mean.normal_(std=0.3)
                module.running_var.uniform_(0.5, 2.0)
    return checkpoint


@pytest.fixture(scope="module")
def network(checkpoint):
    return CompactNetwork(stored(checkpoint))


def configurations(checkpoint, panda, count):
    q = panda.random_configurations(np.random.default_rng(2), count)
    return q, ModelConfigurations(stored(checkpoint), panda).of(q)


@torch.inference_mode()
def test_scenes(checkpoint, network):
    theirs = checkpoint.sequence_model.encode_scene([torch.from_numpy(CLOUD)])
    ours = network.encode_scene(CLOUD)
    for level in ("fine", "coarse"):
        expected, found = getattr(theirs.tokens, level), getattr(ours.tokens, level)
        assert found.features.std(axis=0).max() > 0.02
        np.testing.assert_array_equal(found.centres, expected.centres[0])
        np.testing.assert_allclose(found.features, expected.features[0], atol=TOLERANCE)
    np.testing.assert_allclose(ours.keys_values, theirs.keys_values, atol=TOLERANCE)


@torch.inference_mode()
def test_states_along_sequences(checkpoint, network, panda):
    model, codes = checkpoint.sequence_model, np.array([[3, 1, 9], [5, 5, 0]])
    _, ends = configurations(checkpoint, panda, 4)
    starts, goals = ends[:2], ends[2:]
    scene = model.encode_scene([torch.from_numpy(CLOUD)])
    own = checkpoint.dictionary.encode(torch.from_numpy(np.stack((starts, goals), 1)))
    expected = model(scene, torch.from_numpy(starts), torch.from_numpy(goals), torch.from_numpy(codes), own)
    found = network.states(network.encode_scene(CLOUD), starts, goals, codes)
    np.testing.assert_allclose(found, expected.states, atol=TOLERANCE, rtol=TOLERANCE)


@torch.inference_mode()
def test_the_collision_head(checkpoint, panda):
    model = checkpoint.sequence_model
    q, of = configurations(checkpoint, panda, 30)
    scene = model.encode_scene([torch.from_numpy(CLOUD)])
    expected = torch.sigmoid(model.free_logits(scene, torch.from_numpy(of[None])))[0]
    found = CollisionHead(stored(checkpoint), panda).free_probability(CLOUD, q)
    assert found.std() > 1e-3
    np.testing.assert_allclose(found, expected, atol=TOLERANCE)


@torch.inference_mode()
def test_the_dictionary(checkpoint, panda):
    model, words = stored(checkpoint), checkpoint.dictionary
    _, of = configurations(checkpoint, panda, 200)
    codes = CodeEncoder.of(model)(of)
    np.testing.assert_array_equal(codes, words.encode(torch.from_numpy(of[None]))[0])
    assert len(np.unique(codes)) > 3
    means, covariances = dictionary_gaussians(model, panda)
    expected, span = words.code_gaussians(), panda.upper - panda.lower
    np.testing.assert_allclose((means - panda.lower) / span, expected.mean, atol=TOLERANCE)
    np.testing.assert_allclose(covariances / np.outer(span, span), expected.covariance, atol=TOLERANCE)


def changed(checkpoint, part, **arrays):
    """Its weights with some replaced, or taken out where None."""
    model = stored(checkpoint)
    parts = {name: dict(of) for name, of in model.parts.items()}
    parts[part].update({name.replace("__", "."): array for name, array in arrays.items()})
    parts[part] = {name: array for name, array in parts[part].items() if array is not None}
    return dataclasses.replace(model, parts=parts)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"norm__weight": None}, r"norm\.weight is missing"),
        ({"norm__weight": np.ones(3, np.float32)}, r"norm\.weight is \(3,\), expected \(32,\)"),
        ({"norm__weight": np.ones(32, np.int64)}, r"norm\.weight is int64, expected float32"),
        ({"norm__weight": np.full(32, np.nan, np.float32)}, r"norm\.weight has NaN"),
        ({"more": np.ones(3, np.float32)}, "more is left over"),
    ],
)
def test_weights_that_do_not_fit_are_named(checkpoint, arrays, message):
    with pytest.raises(InvalidInputError, match=f"sequence_model does not fit its configuration: {message}"):
        CompactNetwork(changed(checkpoint, "sequence_model", **arrays))


def test_codes_that_are_not_of_unit_length_are_refused(checkpoint):
    vectors = 2.0 * checkpoint.dictionary.quantizer.embedding.weight.detach().numpy()
    with pytest.raises(InvalidInputError, match="not of unit length"):
        CompactNetwork(changed(checkpoint, "dictionary", quantizer__embedding__weight=vectors))
