"""Which nodes and edges of a whole roadmap are free, exactly: labels, where a planner would ask lazily."""

from typing import Annotated

import numpy as np

from cvqmpt_lab.jit import entry
from cvqmpt_lab.kernels.search.motion import motion_free
from cvqmpt_lab.kernels.search.space_arrays import STATE_CHECKS, Space, state_valid


@entry
def edge_verdicts(
    space: Space,
    nodes: Annotated[np.ndarray, "nodes n"],
    edges: Annotated[np.ndarray, "int32 edges 2"],
    node_free: Annotated[np.ndarray, "bool nodes"],
    edge_free: Annotated[np.ndarray, "bool edges"],
    most_checks: int,
):
    """Write whether each node, and each straight motion between the two nodes of an edge, is free of collision.

    Parameters
    ----------
    edge_free: edges that come in as False are taken to be blocked already.
    most_checks: give up after so many state checks.

    Returns
    -------
    Whether all was checked.
    """
    checks = space.counters[STATE_CHECKS] + most_checks
    for i in range(nodes.shape[0]):
        node_free[i] = state_valid(space, nodes[i])
    for e in range(edges.shape[0]):
        if space.counters[STATE_CHECKS] > checks:
            return False
        a, b = edges[e, 0], edges[e, 1]
        edge_free[e] = (
            edge_free[e] and node_free[a] and node_free[b] and motion_free(space, nodes[a], nodes[b])
        )
    return True
