"""Grids of cells over the free rows of a constraint, and the nodes of two trees in the cells.

Free rows are those rows of the constraint's regions that are unbounded or wide. A grid divides the
free rows, or a random projection of the joints, into cells, as KPIECE (Sucan and Kavraki 2009) and
EST (Hsu et al. 1999) do. The right size of cells is not known in advance, so there are several
grids, and each is used equally often. A cell that was chosen c times has the weight 1 / (1 + c)^2
in its grid.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel
from cvqmpt_lab.constraints.regions import residual
from cvqmpt_lab.robot.kinematics import forward_kinematics
from cvqmpt_lab.search.space import ConstrainedSpace

NODES_PER_CELL = 8  # largest number of nodes of each tree that a cell stores


class Grids(NamedTuple):
    """Cells of several grids, and the nodes of two trees in them."""

    # maps free rows and joints to coordinates in each grid, in units of cells
    projection: Annotated[np.ndarray, "grids axes coordinates"]
    rows: Annotated[np.ndarray, "int64 free 2"]  # region and axis of each free row
    # hash table of each grid: a cell's number + 1 at its slot; 0: the slot is empty
    table: Annotated[np.ndarray, "int32 grids slots"]
    place: Annotated[np.ndarray, "int32 grids cells axes"]  # integer coordinates of each cell
    known: Annotated[np.ndarray, "int64 grids"]  # number of cells in each grid
    members: Annotated[np.ndarray, "int32 2 grids cells"]  # number of each tree's nodes in a cell
    chosen: Annotated[np.ndarray, "int32 2 grids cells"]  # how often each tree chose a cell
    held: Annotated[np.ndarray, "int32 2 grids cells held"]  # nodes that a cell stores
    # binary indexed tree of weights (Fenwick 1994): entry i is the sum over the i & -i cells that
    # end with cell i - 1
    sums: Annotated[np.ndarray, "2 grids cells_and_one"]
    coordinates: Annotated[np.ndarray, "coordinates"]  # work array: free rows and joints of a state
    cell: Annotated[np.ndarray, "int64 grids"]  # work array: the cell of a state in each grid
    motion: Annotated[np.ndarray, "longest n"]  # work array: states of a motion
    refined: Annotated[np.ndarray, "finest n"]  # work array
    segment: Annotated[np.ndarray, "int64 finest"]  # work array


@kernel
def _slot(place, table, cell):
    """Return the slot of the cell with these coordinates, or the empty slot for it.

    Args:
        place: integer coordinates (cells, axes) of all cells of a grid.
        table: its hash table.
        cell: row of the coordinates.
    """
    last, key = table.shape[0] - 1, 0
    for a in range(place.shape[1]):
        key = (key ^ place[cell, a]) * 0x5BD1E995
        key ^= key >> 15
    slot = key & last
    while table[slot] != 0:
        same = True
        for a in range(place.shape[1]):
            same = same and place[table[slot] - 1, a] == place[cell, a]
        if same:
            break
        slot = (slot + 1) & last
    return slot


@kernel
def _find_cells(space, grids, q):
    """Write the cells of a state q (n,) into grids.cell; add cells that are new."""
    rotation, translation = space.scratch.link_rotation, space.scratch.link_translation
    displacement, x = space.scratch.displacement, grids.coordinates
    forward_kinematics(space.kinematics, q, rotation, translation)
    residual(space.regions, q, rotation, translation, space.scratch.residual, displacement)
    free = grids.rows.shape[0]
    for i in range(free):
        x[i] = displacement[grids.rows[i, 0], 3 + grids.rows[i, 1]]
    for j in range(q.shape[0]):
        x[free + j] = q[j]
    axes = grids.place.shape[2]
    for g in range(grids.place.shape[0]):
        place, table, new = grids.place[g], grids.table[g], grids.known[g]
        for a in range(axes):
            along = 0.0
            for c in range(x.shape[0]):
                along += grids.projection[g, a, c] * x[c]
            place[new, a] = int(np.floor(along))
        slot = _slot(place, table, new)
        if table[slot] == 0:
            table[slot] = new + 1
            grids.known[g] = new + 1
        grids.cell[g] = table[slot] - 1


@kernel
def _count(grids, tree, g, cell, nodes, choices):
    """Add to the numbers of nodes and of choices of a cell, and update the sums of weights.

    Args:
        grids: changed in place.
        tree: 0 or 1.
        g: the grid.
        cell: the cell.
        nodes: number of new nodes.
        choices: number of new choices.
    """
    count, chosen = grids.members[tree, g], grids.chosen[tree, g]
    before = 0.0
    if count[cell] > 0:
        before = 1.0 / (1.0 + chosen[cell]) ** 2
    count[cell] += nodes
    chosen[cell] += choices
    change = 1.0 / (1.0 + chosen[cell]) ** 2 - before
    i = cell + 1
    while i < grids.sums.shape[2]:
        grids.sums[tree, g, i] += change
        i += i & -i


@kernel
def place_node(space, grids, tree, nodes, node):
    """Add a node of a tree to its cells; grids.cell then holds them.

    Args:
        space: the planning space.
        grids: changed in place.
        tree: 0 or 1.
        nodes: nodes of this tree (capacity, n) [rad or m].
        node: number of the node.
    """
    _find_cells(space, grids, nodes[node])
    for g in range(grids.cell.shape[0]):
        cell = grids.cell[g]
        known = grids.members[tree, g, cell]
        # a full cell replaces a pseudo-random one of its nodes
        held = known if known < NODES_PER_CELL else (node * 0x5BD1E995 >> 13) % NODES_PER_CELL
        grids.held[tree, g, cell, held] = node
        _count(grids, tree, g, cell, 1, 0)


@kernel
def choose(grids, tree, g, share, which):
    """Choose a cell of a grid by weight, and return a node in it.

    Args:
        grids: the choice is counted.
        tree: 0 or 1.
        g: the grid.
        share: uniform in [0, 1), chooses the cell.
        which: uniform in [0, 1), chooses the node.
    """
    sums = grids.sums[tree, g]
    stride = sums.shape[0] - 1  # a power of two
    left, cell = share * sums[stride], 0
    while stride > 1:
        stride //= 2
        if sums[cell + stride] <= left and cell + stride < grids.known[g]:
            cell += stride
            left -= sums[cell]
    # by rounding, the cell may be a neighbour without nodes of this tree
    while grids.members[tree, g, cell] == 0:
        cell = cell - 1 if cell > 0 else grids.known[g] - 1
    _count(grids, tree, g, cell, 0, 1)
    return grids.held[tree, g, cell, int(which * min(grids.members[tree, g, cell], NODES_PER_CELL))]


def empty_grids(space: ConstrainedSpace, rng: np.random.Generator, cells: int = 2048) -> Grids:
    """Return grids for a space, each with space for `cells` cells (a power of two).

    There are three grids of the free positions, a coarse one of all free rows, and one of a random
    projection of the joints to three axes. Without free rows there are three such projections.
    Cell sizes are shares of the arm's reach, of half a turn and of the joints' ranges.
    """
    n, lower, upper = space.robot.dof, space.robot.lower, space.robot.upper
    rows = free_rows(space)
    spans = np.where(rows[:, 1] < 3, space.robot.reach, np.pi)
    places, everything = np.flatnonzero(rows[:, 1] < 3), np.arange(len(rows))
    views = [(places, size) for size in (8, 16, 32) if len(places)]
    if len(places) < len(rows):
        views.append((everything, 4))
    projections = [
        np.eye(len(rows), len(rows) + n)[chosen]
        * (size / np.pad(spans, (0, n), constant_values=1.0))
        for chosen, size in views
    ]
    for size in (4,) if len(rows) else (4, 8, 16):
        turn = np.linalg.qr(rng.standard_normal((n, n)))[0][:3]
        projections.append(np.pad(2.0 * size * turn / (upper - lower), ((0, 0), (len(rows), 0))))
    g, axes = len(projections), max(map(len, projections))
    projection = np.zeros((g, axes, len(rows) + n))
    for k, view in enumerate(projections):
        projection[k, : len(view)] = view
    return Grids(
        projection=projection,
        rows=rows,
        table=np.zeros((g, 4 * cells), dtype=np.int32),
        place=np.zeros((g, cells, axes), dtype=np.int32),
        known=np.zeros(g, dtype=np.int64),
        members=np.zeros((2, g, cells), dtype=np.int32),
        chosen=np.zeros((2, g, cells), dtype=np.int32),
        held=np.zeros((2, g, cells, NODES_PER_CELL), dtype=np.int32),
        sums=np.zeros((2, g, cells + 1)),
        coordinates=np.zeros(len(rows) + n),
        cell=np.zeros(g, dtype=np.int64),
        motion=np.zeros((64, n)),
        refined=np.zeros((1024, n)),
        segment=np.zeros(1024, dtype=np.int64),
    )


def free_rows(space: ConstrainedSpace, wide: float = 1.0) -> np.ndarray:
    """Return region and axis (free, 2) of rows with bounds more than `wide` apart [m, rad].

    Unbounded rows are among them. Axes are as in `TaskSpaceRegion.Bw`: positions 0 to 2,
    rotation vector 3 to 5.
    """
    if space.constraint is None:
        return np.empty((0, 2), dtype=np.int64)
    regions = space.constraint.inner_regions()
    width = np.full((len(regions.link), 10), np.inf)
    rows = regions.axis >= 0  # without rows of functions
    width[regions.region[rows], regions.axis[rows]] = (regions.upper - regions.lower)[rows]
    # compiled code needs rows that lie one after the other in memory
    return np.ascontiguousarray(np.argwhere(width[:, :6] > wide))


def enlarged_grids(grids: Grids) -> Grids:
    """Return the same grids, each with space for twice as many cells."""

    def twice(array: np.ndarray, axis: int) -> np.ndarray:
        return np.concatenate([array, np.zeros_like(array)], axis=axis)

    larger = grids._replace(
        table=np.zeros_like(twice(grids.table, 1)),
        place=twice(grids.place, 1),
        members=twice(grids.members, 2),
        chosen=twice(grids.chosen, 2),
        held=twice(grids.held, 2),
        sums=twice(grids.sums, 2)[:, :, :-1],
    )
    larger = larger._replace(sums=np.ascontiguousarray(larger.sums))
    larger.sums[:, :, -1] = grids.sums[:, :, -1]  # the sum over all cells
    fill_table.unchecked(larger)
    return larger


@entry
def fill_table(grids: Grids):
    """Enter all known cells into the empty hash tables."""
    for g in range(grids.place.shape[0]):
        for cell in range(grids.known[g]):
            slot = _slot(grids.place[g], grids.table[g], cell)
            grids.table[g, slot] = cell + 1
