"""The published architecture of both stages, compared with independent implementations."""

import math
from itertools import product

import numpy as np
import pytest
import torch
from published_files import waves
from refusals import refused
from torch.nn import functional as F

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.errors import CvqmptError
from cvqmpt_lab.training.dictionary_stage import stage1_loss
from cvqmpt_lab.vqmpt import config, dictionary, published_network
from cvqmpt_lab.vqmpt.beam_search import beam_search
from cvqmpt_lab.vqmpt.config import ModelConfig, SetAbstractionConfig
from cvqmpt_lab.vqmpt.dictionary import Dictionary, Quantizer
from cvqmpt_lab.vqmpt.published_network import PublishedSequenceModel, farthest_point_sampling

SIZES = {"n_layers": 2, "n_heads": 3, "d_k": 10, "d_v": 6, "d_model": 16, "d_inner": 24}
SIZES = config.TransformerConfig(**SIZES, dropout=0.1)
SMALL = ModelConfig(
    dictionary=config.DictionaryConfig(transformer=SIZES, n_position=30, n_codes=12),
    point_cloud=config.PointCloudConfig(
        sa1=SetAbstractionConfig(ratio=0.75, radius=0.2, widths=(8, 12)),
        sa2=SetAbstractionConfig(ratio=0.75, radius=0.4, widths=(20, 16)),
    ),
    sequence=config.SequenceConfig(context=SIZES, transformer=SIZES),
)


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def test_parameter_counts_are_those_of_the_published_checkpoints():
    words, sequence = Dictionary(ModelConfig()), PublishedSequenceModel(ModelConfig())
    modules = (words.encoder, words.quantizer, words.decoder)
    modules += (sequence.context, sequence.autoregressive)
    assert [len(module.state_dict()) for module in modules] == [43, 8, 13, 72, 40]
    counts = [sum(p.numel() for p in module.parameters()) for module in modules]
    assert counts == [10_502_144, 25_096, 1_069_091, 10_945_472, 11_287_042]


def layer_norm(x, norm):
    mean, variance = x.mean(-1, keepdim=True), x.var(-1, keepdim=True, unbiased=False)
    return (x - mean) / torch.sqrt(variance + 1e-6) * norm.weight + norm.bias


def attention_by_hand(block, query, context):
    q, kv = layer_norm(query, block.layer_norm), layer_norm(context, block.layer_norm)
    heads = []
    for h in range(3):
        wq, wk = (w.weight[10 * h : 10 * h + 10] for w in (block.w_qs, block.w_ks))
        score = (q @ wq.T) @ (kv @ wk.T).mT / math.sqrt(10)
        share = torch.exp(score) / torch.exp(score).sum(-1, keepdim=True)
        heads.append(share @ (kv @ block.w_vs.weight[6 * h : 6 * h + 6].T))
    return query + torch.cat(heads, -1) @ block.fc.weight.T


def test_attention_is_softmax_of_scaled_products_plus_the_raw_query():
    block = dictionary.MultiHeadAttention(SIZES).eval()
    torch.nn.init.normal_(block.layer_norm.weight)
    torch.nn.init.normal_(block.layer_norm.bias)
    query, context = torch.randn(1, 3, 16), torch.randn(1, 5, 16)
    for given in ((query, context), (query, query)):
        torch.testing.assert_close(block(*given), attention_by_hand(block, *given))


@pytest.mark.parametrize("norm_first", [True, False])
def test_feed_forward_normalises_before_or_after(norm_first):
    block = dictionary.FeedForward(16, 24, 0.3, norm_first=norm_first).eval()
    x = torch.randn(2, 3, 16)
    y = layer_norm(x, block.layer_norm) if norm_first else x
    y = F.relu(y @ block.w_1.weight.T + block.w_1.bias) @ block.w_2.weight.T + block.w_2.bias + x
    torch.testing.assert_close(block(x), y if norm_first else layer_norm(y, block.layer_norm))


def test_trajectory_encoder_uses_one_layer_norm_three_times():
    encoder = dictionary.TrajectoryEncoder(7, 30, SIZES).eval()
    torch.nn.init.normal_(encoder.layer_norm.weight)
    u = torch.rand(1, 4, 7)
    x = layer_norm(encoder.to_embedding(u), encoder.layer_norm)
    x = layer_norm(x + waves(30, 16)[:4], encoder.layer_norm)
    for layer in encoder.layer_stack:
        x = layer.pos_ffn(attention_by_hand(layer.slf_attn, x, x))
    torch.testing.assert_close(encoder(u), layer_norm(x, encoder.layer_norm))
    refused("31 waypoints", encoder, torch.rand(1, 31, 7))


def test_codes_restart_on_data():
    quantizer, latents, dead = Quantizer(12, 8, 16), torch.randn(40, 16), torch.arange(12) < 5
    before = quantizer.embedding.weight.detach().clone()
    quantizer.restart_codes(dead, latents)
    after = quantizer.embedding.weight.detach()
    torch.testing.assert_close(after[5:], before[5:])
    cosines, places = (after[:5] @ quantizer.project(latents).T).max(dim=1)
    torch.testing.assert_close(cosines, torch.ones(5))
    assert len(set(places.tolist())) == 5
    quantizer.restart_codes(dead & False, latents)
    torch.testing.assert_close(quantizer.embedding.weight.detach(), after)
    refused("0 latents", quantizer.restart_codes, dead, latents[:0])


def test_stage1_loss_masks_padding():
    words = Dictionary(SMALL).eval()
    u, visible = torch.rand(2, 6, 7), torch.ones(2, 6, dtype=torch.bool)
    visible[1, 4:] = False
    with torch.no_grad():
        gaussians, quantized = words(u)
    loss = stage1_loss(gaussians, quantized, u, visible, commitment=0.25)
    log_prob, entropies = gaussians.log_prob(u), gaussians.entropy()
    seen = [(b, t) for b in range(2) for t in range(6) if visible[b, t]]
    nll = -sum(float(log_prob[at]) for at in seen)
    reconstruction = (nll - 0.1 * sum(float(entropies[at]) for at in seen)) / 2
    distance = (quantized.latent - quantized.quantized).square().sum(-1)
    quantization = 1.25 * float(distance[visible].mean())
    assert float(loss["reconstruction"]) == pytest.approx(reconstruction, rel=1e-5)
    assert float(loss["quantization"]) == pytest.approx(quantization, rel=1e-5)
    assert float(loss["loss"]) == pytest.approx(reconstruction + quantization, rel=1e-5)


@pytest.fixture
def sequence_model():
    return PublishedSequenceModel(SMALL).eval()


def test_prefix_logits_see_the_prefix_in_any_order(sequence_model):
    quantizer = Dictionary(SMALL).quantizer
    scene = sequence_model.encode_scene([torch.rand(20, 3)])
    context = sequence_model.encode_context(scene, torch.rand(2, 7), torch.rand(2, 7))
    codes = torch.tensor([[1, 2, 3], [4, 5, 6]])
    full = sequence_model.prefix_logits(context, codes, quantizer)
    assert context.shape == (2, 2, 16) and full.shape == (2, 14)
    alone = sequence_model.prefix_logits(context[1:], codes[1:], quantizer)
    torch.testing.assert_close(full[1:], alone)
    # without position code
    swapped = sequence_model.prefix_logits(context[1:], torch.tensor([[5, 4, 6]]), quantizer)
    torch.testing.assert_close(alone, swapped)
    start = sequence_model.prefix_logits(context, codes[:, :0], quantizer)
    tokens = torch.cat((context, torch.full((2, 1, 16), -1.0)), 1)
    torch.testing.assert_close(start, sequence_model.autoregressive(tokens))


def test_context_tokens_ignore_each_other(sequence_model):
    clouds = torch.rand(2, 20, 3)
    scene = sequence_model.encode_scene(clouds)
    assert scene.shape == (2, 12, 16)  # ceil(0.75 * ceil(0.75 * 20))
    start, goal = torch.rand(4, 7), torch.rand(4, 7)
    together = sequence_model.encode_context(scene, start, goal)
    for row, cloud in enumerate((clouds[0], clouds[0], clouds[1], clouds[1])):
        own, here = sequence_model.encode_scene([cloud]), slice(row, row + 1)
        alone = sequence_model.encode_context(own, start[here], goal[here])
        torch.testing.assert_close(together[here], alone)
    other_goal = sequence_model.encode_context(scene, start, torch.rand(4, 7))
    torch.testing.assert_close(other_goal[:, 0], together[:, 0])
    assert not torch.allclose(other_goal[:, 1], together[:, 1])


def beam_by_hand(odds, k, length):
    """Return codes (with the goal token if it was reached) and score, by the authors' rules.

    odds: returns the probabilities of all classes after a prefix of codes.
    """
    codes, goal = range(SMALL.dictionary.n_codes), SMALL.goal_class
    ranked = sorted(codes, key=lambda code: -odds(())[code])[:k]
    beams = [((code,), np.log(odds(())[code])) for code in ranked]
    for _ in range(length - 1):
        forbidden = {path[-1] for path, _ in beams}
        candidates = [
            ((*path, code), score + odds(path)[code])
            for path, score in beams
            for code in {*codes, goal} - forbidden
        ]
        beams = sorted(candidates, key=lambda one: -one[1])[:k]
        for path, score in beams:
            if path[-1] == goal:
                return path, score
    return beams[0]


@torch.no_grad()
def test_beams_in_a_batch_are_searched_by_the_rules_of_the_published_code(sequence_model):
    sequence_model.autoregressive.class_pred.weight *= 3.0
    sequence_model.autoregressive.class_pred.bias[-1] += 3.0
    words, ends = Dictionary(SMALL).eval(), torch.rand(2, 8, 7)
    scene = sequence_model.encode_scene([torch.rand(20, 3)])
    context, finished = sequence_model.encode_context(scene, *ends), []
    for beams, length in ((1, 9), (2, 1), (2, 4), (3, 6)):
        decoder = sequence_model.decoder(words, scene, *ends)
        searched = beam_search(decoder, beams=beams, max_length=length, published=True)
        for row, (found, *_) in enumerate(searched):

            def odds(path, tokens=context[row : row + 1]):
                prefix = torch.tensor([path], dtype=torch.int64).reshape(1, -1)
                logits = sequence_model.prefix_logits(tokens, prefix, words.quantizer)
                return logits.softmax(1)[0].numpy()

            codes, score = beam_by_hand(odds, beams, length)
            assert found.codes + (SMALL.goal_class,) * found.finished == codes
            assert found.score == pytest.approx(score, abs=1e-4)
            finished.append(found.finished)
    assert {*finished} == {True, False}
    for beams in (0, 13):
        refused(f"{beams} beams; give 1 to 12", beam_search, decoder, beams=beams)
    sequence_model.autoregressive.class_pred.weight *= torch.nan
    refused("not finite", beam_search, sequence_model.decoder(words, scene, *ends))


def test_config_names_the_wrong_field():
    for path, value, message in (
        ("kind", "tiny", "unknown model.kind 'tiny'"),
        ("joint_dim", 0, "joint_dim is 0; it must be 1 to 65536"),
        ("dictionary.n_position", 10**400, r"n_position is 1000\S+; it must be 1 to 65536"),
        ("sequence.transformer.n_layers", 10**6, "n_layers is 1000000; it must be 1 to 64"),
        ("sequence.transformer.dropout", 1.5, "dropout is 1.5; it must be 0 or more"),
        ("point_cloud.sa1.radius", -0.2, "radius is -0.2; it must be a positive length"),
        ("point_cloud.sa1.ratio", 1.5, "ratio is 1.5; it must be more than 0, at most 1"),
        ("sequence", None, "give both point_cloud and sequence, or set both to null"),
        ("feature_dim", 24, "kind 'published' has no feature_dim"),
        ("sequence.transformer.d_model", 8, "one latent width"),
    ):
        data = inner = to_plain(ModelConfig(), complete=True)
        *outer, last = path.split(".")
        for name in outer:
            inner = inner[name]
        inner[last] = value
        refused(message, from_plain, ModelConfig, data, "model", complete=True, error=CvqmptError)


@pytest.fixture
def points():
    return torch.rand(2, 60, 3, generator=torch.Generator().manual_seed(0))


def near(cloud, centre, radius):
    return [n for n, point in enumerate(cloud) if ((point - centre) ** 2).sum().sqrt() < radius]


def farthest_by_hand(cloud, count):
    chosen = [0]
    while len(chosen) < count:
        to_chosen = [min(float(((p - cloud[c]) ** 2).sum()) for c in chosen) for p in cloud]
        chosen.append(int(np.argmax(to_chosen)))
    return chosen


@pytest.mark.parametrize("pairs_at_once", [1, 500, 1 << 17])
@pytest.mark.parametrize("most", [3, 64])
def test_ball_query_takes_the_first_points_within_the_radius(points, most, pairs_at_once):
    centres, expected = points[:, 5:17], []
    found = published_network.ball_query(points, centres, 0.4, most, pairs_at_once)
    for b, m in product(range(2), range(12)):
        inside = near(points[b], centres[b, m], 0.4)[:most]
        expected += [(60 * b + n, 12 * b + m) for n in inside]
    assert list(zip(*(part.tolist() for part in found), strict=True)) == expected


def test_set_abstraction_is_the_maximum_over_a_perceptron_of_balls_around_farthest_points(points):
    sizes = SetAbstractionConfig(ratio=0.75, radius=0.3, widths=(8, 12), max_neighbours=5)
    module = published_network.SetAbstraction(4, sizes)
    features = torch.rand(2, 60, 4)
    order = farthest_point_sampling(points, 45)
    module(features, points, order)  # moves the running statistics of the batch norms
    module.eval()
    found, centres = module(features, points, order)
    assert found.shape == (2, 45, 12)
    chosen = [farthest_by_hand(cloud, 45) for cloud in points]
    for b, m in product(range(2), range(45)):
        centre, messages = points[b, chosen[b][m]], []
        for n in near(points[b], centre, 0.3)[:5]:
            x = torch.cat((features[b, n], points[b, n] - centre))
            for linear, _, norm in module.conv.local_nn:
                x = (linear.weight @ x + linear.bias).clamp(min=0.0) - norm.running_mean
                x = x / torch.sqrt(norm.running_var + 1e-5) * norm.weight + norm.bias
            messages.append(x)
        expected = torch.stack(messages).max(0).values
        torch.testing.assert_close(found[b, m], expected, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(centres[b, m], centre)
    assert sorted(farthest_point_sampling(points, 60)[0].tolist()) == list(range(60))
    # the farthest points of the centres are the first centres
    again = farthest_point_sampling(centres, 34)
    assert again.tolist() == [list(range(34))] * 2
    assert farthest_point_sampling(torch.zeros(1, 4, 3), 2).tolist() == [[0, 0]]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU here")
def test_scene_tokens_of_a_gpu_are_those_of_the_processor(points):
    sizes = SMALL.point_cloud
    encoder = published_network.PointCloudEncoder(sizes).eval()
    expected = encoder(points)
    order = farthest_point_sampling(points, 45).cuda()
    found = encoder.cuda()(points.cuda(), order)
    torch.testing.assert_close(found.cpu(), expected, rtol=1e-4, atol=1e-4)
