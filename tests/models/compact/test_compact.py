"""The compact model: what sees what, its options, and cached against uncached prediction."""

import dataclasses

import numpy as np
import pytest
import torch

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, stored
from cvqmpt_lab.models.compact.sequence_model import CompactSequenceModel
from cvqmpt_lab.models.config import (
    ModelConfig,
    PointCloudConfig,
    SequenceConfig,
    SetAbstractionConfig,
    TransformerConfig,
)
from cvqmpt_lab.models.decoding.beam_search import beam_search, sample_sequences
from cvqmpt_lab.models.dictionary.dictionary import Dictionary
from cvqmpt_lab.models.published.prefix_decoder import PrefixDecoder
from cvqmpt_lab.models.robot_signature import RobotSignature
from cvqmpt_lab.prediction.compact_network import CompactNetwork
from cvqmpt_lab.training.losses import binary_loss, refinement_loss, sequence_loss

SIZES = TransformerConfig(n_layers=2, n_heads=2, d_k=8, d_v=8, d_model=16, d_inner=24, dropout=0.1)
POINTS = PointCloudConfig(
    max_points=60,
    sa1=SetAbstractionConfig(count=20, radius=0.4, max_neighbours=8, widths=(8, 12)),
    sa2=SetAbstractionConfig(count=6, radius=0.8, max_neighbours=8, widths=(10, 14)),
)
CONFIG = dataclasses.replace(
    ModelConfig.compact(feature_dim=6, n_codes=12),
    dictionary=dataclasses.replace(ModelConfig.compact().dictionary, transformer=SIZES, n_codes=12),
    point_cloud=POINTS,
    sequence=SequenceConfig(
        context=None,
        transformer=SIZES,
        max_length=30,
        start_goal_codes=True,
        refinement=True,
        collision_head=True,
        connectivity_head=True,
    ),
)
PLAIN = dataclasses.replace(
    CONFIG,
    feature_dim=0,
    dictionary=dataclasses.replace(CONFIG.dictionary, encoder="transformer", data_initialised=False),
    sequence=SequenceConfig(context=None, transformer=SIZES, head_level="coarse"),
)


def build(config):
    torch.manual_seed(0)
    dictionary, model = Dictionary(config), CompactSequenceModel(config)
    model.set_code_configurations(torch.rand(12, config.configuration_dim))
    with torch.no_grad():  # so that predictions depend on what they should
        for parameter in model.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return dictionary.eval(), model.eval()


@pytest.fixture(scope="module")
def full():
    return build(CONFIG)


def clouds(count=2, points=60):
    return torch.rand(count, points, 3, generator=torch.Generator().manual_seed(3))


def ends(rows, config=CONFIG):
    generator = torch.Generator().manual_seed(4)
    return torch.rand(rows, config.configuration_dim, generator=generator), torch.rand(
        rows, config.configuration_dim, generator=generator
    )


def in_numpy(dictionary, model):
    """The same model as prediction runs it."""
    robot = RobotSignature("arm", (0.0,) * 7, (1.0,) * 7)
    return CompactNetwork(stored(Checkpoint(model.config, robot, dictionary, model)))


def cached_decoder(network, cloud, start, goal):
    """Decoder of the numpy network for a cloud (1, n, 3) and ends, as tensors."""
    return network.decoder(network.encode_scene(cloud[0].numpy()), start.numpy(), goal.numpy())


def whole_prefixes(model, dictionary, scene, start, goal):
    """A decoder that runs the model on every prefix, which inference on a cache must equal."""
    prefix = model.query_tokens(dictionary, start, goal)

    def logits_of(queries, sequences):
        tokens = torch.cat((prefix[queries], model.code_tokens(sequences)), 1)
        return model.classify(model.run(tokens, scene)[:, -1])

    return PrefixDecoder(torch.arange(len(start)), logits_of)


def test_sizes_of_the_shipped_configuration():
    config = ModelConfig.compact(feature_dim=24)
    count = sum(p.numel() for m in (Dictionary(config), CompactSequenceModel(config)) for p in m.parameters())
    assert 1e6 < count < 3e6


def test_predictions_do_not_see_later_codes_but_all_earlier_ones_and_their_order(full):
    _, model = full
    scene, (start, goal) = model.encode_scene(clouds(1)), ends(1)
    codes, own = torch.tensor([[1, 2, 3, 4]]), torch.tensor([[5, 6]])
    whole = model(scene, start, goal, codes, own)
    assert whole.logits.shape == (1, 5, 14) and whole.states.shape == (1, 4, 16)
    torch.testing.assert_close(model(scene, start, goal, codes[:, :2], own).logits, whole.logits[:, :3])
    changed = model(scene, start, goal, torch.tensor([[1, 2, 9, 4]]), own).logits
    torch.testing.assert_close(changed[:, :3], whole.logits[:, :3])
    assert (changed[:, 3:] - whole.logits[:, 3:]).abs().amax(-1).min() > 1e-4
    swapped = model(scene, start, goal, torch.tensor([[2, 1, 3, 4]]), own).logits
    assert (swapped[:, 3:] - whole.logits[:, 3:]).abs().amax(-1).min() > 1e-4


def test_predictions_depend_on_scene_start_goal_and_their_codes(full):
    _, model = full
    scene, (start, goal) = model.encode_scene(clouds(1)), ends(1)
    codes, own = torch.tensor([[1]]), torch.tensor([[5, 6]])
    base = model(scene, start, goal, codes, own).logits
    other_scene = model.encode_scene(clouds(2)[1:])
    for changed in (
        model(other_scene, start, goal, codes, own),
        model(scene, goal, start, codes, own),
        model(scene, start, start, codes, own),
        model(scene, start, goal, codes, own.flip(1)),
    ):
        assert (changed.logits - base).abs().max() > 1e-4


def test_rows_are_grouped_by_scene(full):
    _, model = full
    both, (start, goal) = clouds(2), ends(4)
    codes, own = torch.tensor([[1, 2]]).expand(4, 2), torch.tensor([[5, 6]]).expand(4, 2)
    together = model(model.encode_scene(both), start, goal, codes, own).logits
    for i in range(2):
        rows = slice(2 * i, 2 * i + 2)
        alone = model(model.encode_scene(both[i : i + 1]), start[rows], goal[rows], codes[rows], own[rows])
        torch.testing.assert_close(together[rows], alone.logits, rtol=1e-4, atol=1e-5)
    with pytest.raises(InvalidInputError, match="3 starts and goals for 2 scenes"):
        model(model.encode_scene(both), start[:3], goal[:3], codes[:3], own[:3])


@pytest.mark.parametrize("config", [CONFIG, PLAIN], ids=["full", "plain"])
def test_cached_decoding_equals_whole_prefixes(config):
    dictionary, model = build(config)
    start, goal = ends(4, config)
    with torch.no_grad():
        whole = whole_prefixes(model, dictionary, model.encode_scene(clouds(1)), start, goal)
    cached = cached_decoder(in_numpy(dictionary, model), clouds(1), start, goal)
    np.testing.assert_allclose(cached.start(), whole.start(), atol=2e-6)
    rng = np.random.default_rng(0)
    steps: list[np.ndarray | None] = [np.arange(4).repeat(3)]
    steps += [rng.integers(0, 3, 12) + 3 * (np.arange(12) // 3) for _ in range(17)] + [None]
    for parents in steps:
        codes = rng.integers(0, 12, 12)
        np.testing.assert_allclose(
            cached.advance(parents, codes), whole.advance(parents, codes), rtol=1e-5, atol=3e-6
        )


def test_searches_agree_with_and_without_cache(full):
    dictionary, model = full
    with torch.no_grad():
        scene = model.encode_scene(clouds(1))
    start, goal = ends(3)
    network = in_numpy(dictionary, model)
    for scoring in ("log-probability", "published"):
        plain = beam_search(
            whole_prefixes(model, dictionary, scene, start, goal), max_length=20, scoring=scoring
        )
        fast = beam_search(cached_decoder(network, clouds(1), start, goal), max_length=20, scoring=scoring)
        single = [
            beam_search(
                cached_decoder(network, clouds(1), start[i : i + 1], goal[i : i + 1]),
                max_length=20,
                scoring=scoring,
            )[0]
            for i in range(3)
        ]
        for one, other, third in zip(plain, fast, single, strict=True):
            assert (one.codes, one.finished) == (other.codes, other.finished) == (third.codes, third.finished)
            assert one.log_probability == pytest.approx(other.log_probability, abs=1e-5)
    draws = [
        sample_sequences(decoder, 4, np.random.default_rng(1), max_length=20)
        for decoder in (
            whole_prefixes(model, dictionary, scene, start, goal),
            cached_decoder(network, clouds(1), start, goal),
        )
    ]
    assert [[s.codes for s in row] for row in draws[0]] == [[s.codes for s in row] for row in draws[1]]


def test_a_cached_decoder_serves_one_search(full):
    dictionary, model = full
    decoder = cached_decoder(in_numpy(dictionary, model), clouds(1), *ends(1))
    decoder.start()
    with pytest.raises(InvalidInputError, match="used before"):
        decoder.start()
    for step in range(30):
        decoder.advance(None, np.array([step % 12]))
    with pytest.raises(InvalidInputError, match="sequence of 31 codes; this model takes 30"):
        decoder.advance(None, np.array([0]))
    with pytest.raises(InvalidInputError, match="sequence of 31 codes; this model takes 30"):
        model.code_tokens(torch.zeros(1, 31, dtype=torch.int64))


def test_clouds_are_thinned_and_checked(full):
    _, model = full
    large = clouds(1, 150)
    kept = large[:, torch.arange(60) * 150 // 60]
    thinned = model.encode_scene(large)
    torch.testing.assert_close(thinned.keys_values, model.encode_scene(kept).keys_values)
    assert thinned.tokens.coarse.features.shape == (1, 6, 14)
    with pytest.raises(InvalidInputError, match=r"clouds of \[40, 60\] points"):
        model.encode_scene([clouds()[0], clouds()[1, :40]])
    with pytest.raises(InvalidInputError, match="NaN"):
        model.encode_scene(torch.full((1, 10, 3), torch.nan))


def test_heads(full):
    dictionary, model = full
    scene = model.encode_scene(clouds(2))
    a, b = torch.rand(2, 5, 13), torch.rand(2, 5, 13)
    assert model.free_logits(scene, a).shape == (2, 5)
    there, back = model.connected_logits(scene, a, b), model.connected_logits(scene, b, a)
    torch.testing.assert_close(there, back)
    assert (there - model.connected_logits(scene, a, a)).abs().max() > 1e-4
    swapped = model.free_logits(model.encode_scene(clouds(2).flip(0)), a)
    assert (swapped - model.free_logits(scene, a)).abs().max() > 1e-5
    gaussians = dictionary.code_gaussians(torch.tensor([[1, 2]]))
    fresh = CompactSequenceModel(CONFIG).refine(torch.rand(1, 2, 16), gaussians)
    torch.testing.assert_close(fresh.mean, gaussians.mean)
    torch.testing.assert_close(fresh.diagonal.sqrt(), torch.full((1, 2, 7), float(np.exp(-2.5))))


def test_options_that_are_off_are_named():
    dictionary, model = build(PLAIN)
    scene = model.encode_scene(clouds(1))
    gaussians = dictionary.code_gaussians(torch.tensor([[1]]))
    for call in (
        lambda: model.refine(torch.rand(1, 1, 16), gaussians),
        lambda: model.free_logits(scene, torch.rand(1, 1, 7)),
        lambda: model.connected_logits(scene, torch.rand(1, 1, 7), torch.rand(1, 1, 7)),
    ):
        with pytest.raises(InvalidInputError, match="head; set sequence"):
            call()
    _, full = build(CONFIG)
    with pytest.raises(InvalidInputError, match="needs start_goal_codes"):
        full(full.encode_scene(clouds(1)), *ends(1), torch.tensor([[1]]))
    with pytest.raises(InvalidInputError, match=r"\(3, 13\), expected \(12, 13\)"):
        full.set_code_configurations(torch.zeros(3, 13))


def test_every_parameter_learns():
    dictionary, model = build(CONFIG)
    model.train()
    scene, (start, goal) = model.encode_scene(clouds(2)), ends(4)
    codes, own = torch.randint(0, 12, (4, 5)), torch.randint(0, 12, (4, 2))
    output = model(scene, start, goal, codes, own)
    targets = torch.cat((codes, torch.full((4, 1), CONFIG.goal_class)), 1)
    loss = sequence_loss(output.logits.flatten(0, 1), targets.flatten(), 4)
    refined = model.refine(output.states, dictionary.code_gaussians(codes))
    loss = loss + refinement_loss(refined, torch.rand(4, 5, 7), torch.ones(4, 5, dtype=torch.bool))
    a, b = torch.rand(2, 5, 13), torch.rand(2, 5, 13)
    labels = torch.tensor([[True, False, True, False, True]]).expand(2, 5)
    loss = loss + binary_loss(model.free_logits(scene, a), labels)
    loss = loss + binary_loss(model.connected_logits(scene, a, b), labels)
    loss.backward()
    assert not [name for name, p in model.named_parameters() if p.grad is None]


def test_it_learns_a_sequence():
    dictionary, model = build(PLAIN)
    scene, (start, goal) = clouds(1), ends(1, PLAIN)
    codes = torch.tensor([[3, 7, 3, 1]])
    targets = torch.cat((codes, torch.tensor([[PLAIN.goal_class]])), 1)
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    for _ in range(40):
        optimizer.zero_grad()
        logits = model(model.encode_scene(scene), start, goal, codes).logits
        sequence_loss(logits.flatten(0, 1), targets.flatten(), 1).backward()
        optimizer.step()
    decoder = cached_decoder(in_numpy(dictionary, model), scene, start, goal)
    found = beam_search(decoder)[0]
    assert (found.codes, found.finished) == ((3, 7, 3, 1), True)


def test_round_trip_through_a_checkpoint(full, tmp_path):
    dictionary, model = full
    robot = RobotSignature("arm", (0.0,) * 7, (1.0,) * 7)
    save_checkpoint(tmp_path / "m", Checkpoint(CONFIG, robot, dictionary, model))
    loaded = load_checkpoint(tmp_path / "m", robot)
    assert isinstance(loaded.sequence_model, CompactSequenceModel)
    for name, tensor in model.state_dict().items():
        assert torch.equal(loaded.sequence_model.state_dict()[name], tensor)


def test_unequal_key_and_value_widths_are_refused():
    sizes = dataclasses.replace(SIZES, d_v=4)
    with pytest.raises(InvalidInputError, match="d_v equal to d_k"):
        dataclasses.replace(CONFIG, sequence=SequenceConfig(context=None, transformer=sizes))
