"""Print the learned dictionary: each code is a Gaussian N(mu, Sigma) in joint space."""

from cvqmpt_lab import dictionary_gaussians, load_vq_mpt, robot_from_source

import numpy as np

panda = robot_from_source({"name": "panda"})
means, covariances = dictionary_gaussians(load_vq_mpt(panda), panda)
deviations = np.sqrt(np.linalg.eigvalsh(covariances))
print(f"{len(means)} codes; standard deviations along the axes [rad]:")
print(np.median(deviations, axis=0).round(2))
