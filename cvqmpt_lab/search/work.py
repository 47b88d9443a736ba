"""The work of a search, in units that do not depend on the machine."""

# cost of reading one clearance, in state checks; see docs/performance.md
CLEARANCE_COST = 1 / 3


# `cell_trees` compiles this function with cvqmpt_lab.base.jit: a change compiles all kernels anew
def search_work(projections: float, state_checks: float, clearances: float) -> float:
    """Return `projections + state checks + CLEARANCE_COST * clearances`."""
    return projections + state_checks + CLEARANCE_COST * clearances
