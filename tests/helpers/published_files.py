"""Folders like the published checkpoints; names and shapes follow their description."""

import json
from pathlib import Path

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


SHAPES = json.loads((Path(__file__).parents[1] / "data" / "published_shapes.json").read_text())


def waves(positions, width):
    """Return the position code: sines in even and cosines in odd dimensions, base 10000."""
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
    """Return random tensors of every part by name; they depend on the seed."""
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
