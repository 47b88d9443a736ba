"""A small network asked thousands of times a query: a few numbers in, two hidden layers, one number out."""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.jit import kernel


class SmallNetwork(NamedTuple):
    """Weights, and room for one question."""

    first: Annotated[np.ndarray, "hidden inputs"]
    """Weights of the first layer."""
    first_bias: Annotated[np.ndarray, "hidden"]
    """Of the first layer."""
    second: Annotated[np.ndarray, "more hidden"]
    """Weights."""
    second_bias: Annotated[np.ndarray, "more"]
    """Of the second layer."""
    last: Annotated[np.ndarray, "more"]
    """Weights of the answer."""
    last_bias: float
    """Of the answer."""
    features: Annotated[np.ndarray, "inputs"]
    """The question."""
    hidden: Annotated[np.ndarray, "hidden"]
    """Work array."""


@kernel
def answer(network):
    """What the network says to network.features."""
    for h in range(network.first.shape[0]):
        value = network.first_bias[h]
        for i in range(network.first.shape[1]):
            value += network.first[h, i] * network.features[i]
        network.hidden[h] = max(value, 0.0)
    total = network.last_bias
    for h in range(network.second.shape[0]):
        value = network.second_bias[h]
        for i in range(network.second.shape[1]):
            value += network.second[h, i] * network.hidden[i]
        total += network.last[h] * max(value, 0.0)
    return total
