"""Folders like the published checkpoints; names and shapes follow their description."""

import json

import numpy as np
import torch

STAGE1 = {
    "n_layers": 1, "n_heads": 2, "d_k": 6, "d_v": 5, "d_model": 512, "d_inner": 10,
    "n_position": 40, "dropout": 0.1, "c_space_dim": 7,
}  # fmt: skip
CONTEXT = {
    "d_context": 7, "n_layers": 2, "n_heads": 1, "d_k": 4, "d_v": 3,
    "d_model": 512, "d_inner": 9, "dropout": 0.1,
}  # fmt: skip
SEQUENCE = {
    "d_k": 3, "d_v": 2, "d_model": 512, "d_inner": 8,
    "dropout": 0.1, "n_heads": 2, "n_layers": 2, "num_keys": 2050,
}  # fmt: skip


def linear(name, out_dim, in_dim):
    return {f"{name}.weight": (out_dim, in_dim), f"{name}.bias": (out_dim,)}


def norm(name, dim):
    return {f"{name}.weight": (dim,), f"{name}.bias": (dim,)}


def feed_forward(name, sizes):
    d, inner = sizes["d_model"], sizes["d_inner"]
    return (
        linear(f"{name}.w_1", inner, d)
        | linear(f"{name}.w_2", d, inner)
        | norm(f"{name}.layer_norm", d)
    )


def layers(attention, sizes, prefix=""):
    d, heads, shapes = sizes["d_model"], sizes["n_heads"], {}
    for i in range(sizes["n_layers"]):
        block = f"{prefix}layer_stack.{i}.{attention}"
        shapes |= {f"{block}.{name}.weight": (heads * sizes["d_k"], d) for name in ("w_qs", "w_ks")}
        shapes[f"{block}.w_vs.weight"] = (heads * sizes["d_v"], d)
        shapes[f"{block}.fc.weight"] = (d, heads * sizes["d_v"])
        shapes |= norm(f"{block}.layer_norm", d)
        shapes |= feed_forward(f"{prefix}layer_stack.{i}.pos_ffn", sizes)
    return shapes


def statistics(name, dim):
    return {
        f"{name}.running_mean": (dim,),
        f"{name}.running_var": (dim,),
        f"{name}.num_batches_tracked": (),
    }


def set_abstraction(name, widths):
    shapes = {}
    for i in range(2):
        layer = f"env_encoder.{name}.conv.local_nn.{i}"
        shapes |= linear(f"{layer}.0", widths[i + 1], widths[i])
        shapes |= norm(f"{layer}.2", widths[i + 1]) | statistics(f"{layer}.2", widths[i + 1])
    return shapes


SHAPES = {
    "encoder_state": linear("to_embedding.0", 512, 7)
    | linear("to_embedding.2", 512, 512)
    | {"position_enc.pos_table": (1, 40, 512)}
    | layers("slf_attn", STAGE1)
    | norm("layer_norm", 512),
    "quantizer_state": linear("input_linear_map", 8, 512)
    | linear("output_linear_map", 512, 8)
    | {"embedding.weight": (2048, 8)}
    | statistics("batch_norm", 8),
    "decoder_state": {"l_index": (2, 21)}
    | feed_forward("pos_ffn", STAGE1)
    | linear("mu.0", 7, 512)
    | linear("diag.0", 7, 512)
    | linear("l.0", 21, 512),
    "context_state": set_abstraction("sa1_module", (6, 64, 128))
    | set_abstraction("sa2_module", (131, 256, 512))
    | linear("context_encoder.to_latent_embedding.0", 9, 7)
    | linear("context_encoder.to_latent_embedding.2", 512, 9)
    | norm("context_encoder.to_latent_embedding.4", 512)
    | layers("enc_attn", CONTEXT, "context_encoder.")
    | norm("context_encoder.layer_norm", 512),
    "ar_model_state": layers("slf_attn", SEQUENCE)
    | norm("layer_norm", 512)
    | linear("class_pred", 2050, 512),
}


def waves(positions, width):
    """Sines on even, cosines on odd dimensions, base 10000."""
    angles = np.arange(positions)[:, None] / 10000 ** (2 * (np.arange(width) // 2) / width)
    return torch.tensor(
        np.where(np.arange(width) % 2, np.cos(angles), np.sin(angles)), dtype=torch.float32
    )


def random_tensor(name, shape, generator):
    if name.endswith("num_batches_tracked"):
        return torch.tensor(3)
    if name.endswith("pos_table"):
        return waves(*shape[1:])[None]
    if name == "embedding.weight":
        return torch.nn.functional.normalize(torch.randn(shape, generator=generator), dim=1)
    if name == "l_index":
        return torch.tensor([[r, c] for r in range(7) for c in range(r)]).T.contiguous()
    return 0.1 * torch.rand(shape, generator=generator)


def random_states():
    """Every part's tensors, by name, seeded."""
    generator = torch.Generator().manual_seed(0)
    return {
        part: {name: random_tensor(name, shape, generator) for name, shape in shapes.items()}
        for part, shapes in SHAPES.items()
    }


def write_published(
    folder, states, model_params=STAGE1, cross_attn=CONTEXT, ar_params=SEQUENCE, **changed
):
    """Write and return the two folders, with changes to files given as name=value."""
    use = {name: changed.get(name, state) for name, state in states.items()}
    rest = {"optimizer": {"param_groups": [{"lr": np.float64(1e-4)}]}, "epoch": 7, "n_steps": 100}
    dictionary_dir, ar_dir = folder / "dictionary", folder / "ar"
    for part, names in ((dictionary_dir, list(use)[:3]), (ar_dir, list(use)[3:])):
        part.mkdir(exist_ok=True)
        content = {name: use[name] for name in names if use[name] is not None} | rest
        torch.save(content, part / "best_model.pkl")
    (dictionary_dir / "model_params.json").write_text(json.dumps(model_params))
    (ar_dir / "cross_attn.json").write_text(json.dumps(cross_attn))
    (ar_dir / "ar_params.json").write_text(json.dumps(ar_params))
    return dictionary_dir, ar_dir
