"""Cells of what a constraint leaves free, in several grids, and the nodes of two trees in them.

A grid divides the free rows of a constraint (unbounded or wide rows of its regions), or a random
projection of the joints, into cells, as KPIECE (Sucan and Kavraki 2009) and EST (Hsu et al. 1999)
do. Nobody knows the right size of cells beforehand: there are several grids, each used equally
often. A cell that was chosen c times has the weight 1 / (1 + c)^2 in its grid.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel
from cvqmpt_lab.constraints.regions import residual
from cvqmpt_lab.robot.kinematics import forward_kinematics
from cvqmpt_lab.search.space import ConstrainedSpace

HELD = 8  # nodes of each tree that a cell remembers


class Grids(NamedTuple):
    """Cells of several grids, and which nodes of two trees lie in them."""

    # from free rows and joints to a place in each grid, in cells
    projection: Annotated[np.ndarray, "grids axes coordinates"]
    rows: Annotated[np.ndarray, "int64 free 2"]  # region and axis of free rows
    table: Annotated[np.ndarray, "int32 grids slots"]  # a cell's number + 1 at its hash, or 0
    place: Annotated[np.ndarray, "int32 grids cells axes"]
    known: Annotated[np.ndarray, "int64 grids"]  # cells found in each grid
    members: Annotated[np.ndarray, "int32 2 grids cells"]  # nodes of each tree in a cell
    chosen: Annotated[np.ndarray, "int32 2 grids cells"]  # how often
    held: Annotated[np.ndarray, "int32 2 grids cells held"]  # some of its nodes
    # sums of weights: row i holds that of i & -i cells up to cell i - 1 (Fenwick 1994)
    sums: Annotated[np.ndarray, "2 grids cells_and_one"]
    coordinates: Annotated[np.ndarray, "coordinates"]  # work array: free rows and joints of a state
    cell: Annotated[np.ndarray, "int64 grids"]  # work array: the cells of a state
    motion: Annotated[np.ndarray, "longest n"]  # work array: states of a motion
    refined: Annotated[np.ndarray, "finest n"]  # work array


@kernel
def _slot(place, table, cell):
    """Where the place of a cell stands in a table of hashes, or the free slot where it belongs."""
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
    """Write the cells of a state q (n,) into grids.cell; new ones are made."""
    rotation, translation = space.scratch.link_rotation, space.scratch.link_translation
    displacement, x = space.scratch.displacement, grids.coordinates
    forward_kinematics(space.kinematics, q, rotation, translation)
    residual(space.regions, rotation, translation, space.scratch.residual, displacement)
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
    """Change how many nodes of a tree are in a cell, and how often it was chosen."""
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
    """Put a node of a tree into its cells, which grids.cell then holds."""
    _find_cells(space, grids, nodes[node])
    for g in range(grids.cell.shape[0]):
        cell = grids.cell[g]
        known = grids.members[tree, g, cell]
        held = known if known < HELD else (node * 0x5BD1E995 >> 13) % HELD
        grids.held[tree, g, cell, held] = node
        _count(grids, tree, g, cell, 1, 0)


@kernel
def choose(grids, tree, g, share, which):
    """A node of a tree in a cell of grid g, drawn by weight; share, which: uniform in [0, 1)."""
    sums = grids.sums[tree, g]
    stride = sums.shape[0] - 1  # a power of two
    left, cell = share * sums[stride], 0
    while stride > 1:
        stride //= 2
        if sums[cell + stride] <= left and cell + stride < grids.known[g]:
            cell += stride
            left -= sums[cell]
    # rounding may lead to a neighbour that the tree does not touch
    while grids.members[tree, g, cell] == 0:
        cell = cell - 1 if cell > 0 else grids.known[g] - 1
    _count(grids, tree, g, cell, 0, 1)
    return grids.held[tree, g, cell, int(which * min(grids.members[tree, g, cell], HELD))]


def empty_grids(space: ConstrainedSpace, rng: np.random.Generator, cells: int = 2048) -> Grids:
    """Grids for a space, with room for so many cells (a power of two) each.

    Of free positions there are three grids, of all free rows one coarse one, and one of a random
    projection of the joints, to three axes; where nothing is free, three of such projections. Sizes
    are shares of the arm's reach, of half a turn and of the joints' ranges.
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
        held=np.zeros((2, g, cells, HELD), dtype=np.int32),
        sums=np.zeros((2, g, cells + 1)),
        coordinates=np.zeros(len(rows) + n),
        cell=np.zeros(g, dtype=np.int64),
        motion=np.zeros((64, n)),
        refined=np.zeros((1024, n)),
    )


def free_rows(space: ConstrainedSpace, wide: float = 1.0) -> np.ndarray:
    """Region and axis (free, 2) of rows that are unbounded, or bounded by more than wide [m, rad].

    Axes are those of `TaskSpaceRegion.Bw`: positions 0 to 2, rotation vector 3 to 5.
    """
    if space.constraint is None:
        return np.empty((0, 2), dtype=np.int64)
    regions = space.constraint.inner_regions()
    width = np.full((len(regions.link), 7), np.inf)
    width[regions.region, regions.axis] = regions.upper - regions.lower
    # compiled code reads rows one after the other in memory
    return np.ascontiguousarray(np.argwhere(width[:, :6] > wide))


def enlarged_grids(grids: Grids) -> Grids:
    """The same grids with room for twice as many cells each."""

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
    larger.sums[:, :, -1] = grids.sums[:, :, -1]  # of all cells
    fill_table.unchecked(larger)
    return larger


@entry
def fill_table(grids: Grids):
    """Put all known cells into the empty table."""
    for g in range(grids.place.shape[0]):
        for cell in range(grids.known[g]):
            slot = _slot(grids.place[g], grids.table[g], cell)
            grids.table[g, slot] = cell + 1
