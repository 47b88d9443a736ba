"""What prediction computes of a dictionary in numpy is what the torch modules compute that were trained."""

import dataclasses

import numpy as np
import pytest
import torch
from small_models import compact_config, random_checkpoint

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.checkpoint import stored
from cvqmpt_lab.vqmpt.codebook import Codebook, ModelConfigurations, dictionary_gaussians, waypoint_codes

TOLERANCE = 1e-5


@pytest.fixture(scope="module")
def checkpoint(panda):
    return random_checkpoint(panda, compact_config())


@torch.inference_mode()
def test_the_dictionary(checkpoint, panda):
    model, words = stored(checkpoint), checkpoint.dictionary
    of = ModelConfigurations(model, panda).of(panda.random_configurations(np.random.default_rng(2), 200))
    codes = waypoint_codes(model, of)
    np.testing.assert_array_equal(codes, words.encode(torch.from_numpy(of[None]))[0])
    assert len(np.unique(codes)) > 3
    expected, span = words.decode(words.quantizer.embedding.weight), panda.upper - panda.lower
    book = Codebook(model, panda)
    for means, covariances in (dictionary_gaussians(model, panda), book.gaussians(book.vectors)):
        np.testing.assert_allclose((means - panda.lower) / span, expected.mean, atol=TOLERANCE)
        np.testing.assert_allclose(covariances / np.outer(span, span), expected.covariance, atol=TOLERANCE)


def changed(checkpoint, **arrays):
    """Its weights with some replaced, or taken out where None."""
    model = stored(checkpoint)
    given = {name.replace("__", "."): array for name, array in arrays.items()}
    parts = {"dictionary": {**model.parts["dictionary"], **given}}
    parts["dictionary"] = {name: array for name, array in parts["dictionary"].items() if array is not None}
    return dataclasses.replace(model, parts=parts)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (None, r"decoder\.mu\.0\.bias is missing"),
        (np.ones(3, np.float32), r"decoder\.mu\.0\.bias is \(3,\), expected \(7,\)"),
        (np.ones(7, np.int64), r"decoder\.mu\.0\.bias is int64, expected float32"),
        (np.full(7, np.nan, np.float32), r"decoder\.mu\.0\.bias has NaN"),
    ],
)
def test_weights_that_do_not_fit_are_named(checkpoint, panda, array, message):
    with pytest.raises(InvalidInputError, match=f"dictionary does not fit its configuration: {message}"):
        Codebook(changed(checkpoint, decoder__mu__0__bias=array), panda)


def test_codes_that_are_not_of_unit_length_are_refused(checkpoint, panda):
    vectors = 2.0 * checkpoint.dictionary.quantizer.embedding.weight.detach().numpy()
    with pytest.raises(InvalidInputError, match="not of unit length"):
        Codebook(changed(checkpoint, quantizer__embedding__weight=vectors), panda)
