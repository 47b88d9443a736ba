"""VQ-MPT, the learned sampler:
stage 1 is `dictionary`, stage 2 `transformer`, Algorithm 2 `latent_update`.
"""
