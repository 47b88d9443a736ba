"""Names of the learned samplers that the factorial suites compare."""

from itertools import product

from cvqmpt_lab.vqmpt.sampler_choice import CHOICES, PREFIX


def product_planners() -> tuple[str, ...]:
    """Return the planners ``cvq:PREDICTOR+GAUSSIANS+...`` of all products that are compared."""
    gaussians = ("decoded", "wide")
    updates = ("none", "algorithm-2", "projected")
    other_clouds = CHOICES["cloud"][1:]
    uniform_share = "uniform=0.15"  # the share that wide Gaussians have, for decoded ones
    merged = (
        *product(("transformer", "random", "oracle"), gaussians, updates),
        *product(("transformer",), gaussians, updates, other_clouds),
        *product(("transformer", "random"), ("decoded",), updates, (uniform_share,)),
        ("transformer", "wide", "projected", "all-beams"),
    )
    predictors = ("transformer", "transformer-lines", "nearest-lines", "solved")
    sequences = (
        ("uniform",),
        *product(("transformer", "random"), gaussians, updates[:2]),
        *product(predictors, gaussians, updates[:2], ("every-waypoint",)),
    )
    searches = ((), ("raw-draws",), ("reach=1",), ("raw-draws", "reach=1"))
    searched = ((*words, *search) for words in sequences for search in searches)
    return tuple(dict.fromkeys(PREFIX + "+".join(words) for words in (*merged, *searched)))
