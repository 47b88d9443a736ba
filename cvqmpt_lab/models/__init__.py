"""Learned samplers as torch modules: VQ-MPT (the published architecture, and a smaller dictionary) and MPNet.

Nothing here knows a robot, a scene or a problem: joints are normalised, ``u`` in [0, 1]; clouds are
tensors [m, robot base frame]; link positions are features that the caller computes.
"""
