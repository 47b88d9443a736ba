"""The factorial experiment: products of predictor, Gaussians and update, and what isolates one
choice each.

They plan the place task and the eight kinds of constraints, beside the same search with uniform
samples.
"""

from itertools import product

from cvqmpt_lab.vqmpt.sampler_choice import CLOUDS, GAUSSIANS, PREFIX, UPDATES

PREDICTORS = ("transformer", "random", "oracle")
UNIFORM = "uniform=0.15"  # the share that wide Gaussians have, for decoded ones

PRODUCTS = (
    *product(PREDICTORS, GAUSSIANS, UPDATES),
    *product(("transformer",), GAUSSIANS, UPDATES, CLOUDS[1:]),
    *product(("transformer", "random"), ("decoded",), UPDATES, (UNIFORM,)),
    ("transformer", "wide", "projected", "all-beams"),
)
PLANNERS = ("birrt", *(PREFIX + "+".join(words) for words in PRODUCTS))
