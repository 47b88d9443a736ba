"""VQ-MPT, the learned sampler: `dictionary`, `scene_transformer`, `latent_update` (Algorithm 2)."""
