"""Binary heap of (key, value) pairs in two arrays, for compiled searches."""

from cvqmpt_lab.base.jit import kernel


@kernel(inline="machine")
def push(keys, values, size, key, value):
    """Add an entry to a heap.

    Args:
        keys: (capacity,) keys of the entries, the smallest first.
        values: (capacity,) values of the entries.
        size: number of entries before the call.
        key: key of the new entry.
        value: value of the new entry.
    """
    i = size
    while i > 0 and keys[(i - 1) // 2] > key:
        up = (i - 1) // 2
        keys[i], values[i] = keys[up], values[up]
        i = up
    keys[i], values[i] = key, value


@kernel(inline="machine")
def drop_smallest(keys, values, size):
    """Remove the entry with the smallest key, keys[0], from a heap of `size` entries."""
    last = size - 1
    key, value = keys[last], values[last]
    i = 0
    while 2 * i + 1 < last:
        child = 2 * i + 1
        if child + 1 < last and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[i], values[i] = keys[child], values[child]
        i = child
    keys[i], values[i] = key, value
