"""VQ-MPT, the learned sampler: its two stages, their training weights, prediction and the update of codes."""
