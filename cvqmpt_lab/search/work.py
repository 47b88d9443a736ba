"""The work of a search, in units that do not depend on the machine."""

# state checks that reading one clearance costs, see docs/performance.md
CLEARANCE_COST = 1 / 3


# `cell_trees` compiles it by cvqmpt_lab.base.jit: a change makes all machine code anew
def search_work(projections: float, state_checks: float, clearances: float) -> float:
    """Return `projections + state checks + CLEARANCE_COST * clearances`."""
    return projections + state_checks + CLEARANCE_COST * clearances
