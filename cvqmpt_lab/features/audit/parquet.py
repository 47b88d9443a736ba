"""Columns of parquet files as arrays. The only module that imports pyarrow."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, shown

MOST_ROWS = 5_000_000  # read of one file
MOST_NUMBERS = 50_000_000  # in one column of lists


def read_columns(path: Path, wanted: Collection[str]) -> dict[str, np.ndarray]:
    """Return those of the wanted columns that a file has: (m,), or (m, n) of lists of n numbers.

    Empty cells become NaN. InvalidInputError: the file is broken, too large, or a column has no
    numbers.
    """
    import pyarrow.parquet as pq  # needed for data sets alone

    try:
        with pq.ParquetFile(path) as file:
            if file.metadata.num_rows > MOST_ROWS:
                raise InvalidInputError(
                    f"it has {file.metadata.num_rows} rows, at most {MOST_ROWS} are read: write "
                    "it in several files"
                )
            names = [name for name in file.schema_arrow.names if name in wanted]
            table = file.read(columns=names)
    except InvalidInputError:
        raise
    except Exception as error:  # pyarrow has many errors of its own
        raise InvalidInputError(f"it is no whole parquet file: {shown(str(error))}") from error
    return {name: _array(name, table.column(name)) for name in names}


def _array(name: str, column: Any) -> np.ndarray:
    """Return a column as an array of floats."""
    import pyarrow as pa
    import pyarrow.compute as pc

    kind = column.type
    lists = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
    try:
        if not any(is_kind(kind) for is_kind in lists):
            return column.cast(pa.float64()).to_numpy().astype(float)
        lengths = pc.list_value_length(column).to_numpy()
        if not len(lengths):
            return np.empty((0, 0))
        if np.isnan(lengths.astype(float)).any() or (lengths != lengths[0]).any():
            raise InvalidInputError(
                f"column {name!r} has rows of different lengths: give one value a joint"
            )
        if len(lengths) * int(lengths[0]) > MOST_NUMBERS:
            raise InvalidInputError(f"column {name!r} has more than {MOST_NUMBERS} numbers")
        values = pc.list_flatten(column).cast(pa.float64()).to_numpy()
        return values.astype(float).reshape(len(lengths), int(lengths[0]))
    except pa.ArrowException as error:
        raise InvalidInputError(f"column {name!r} of type {kind} has no numbers") from error
