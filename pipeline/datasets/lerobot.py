"""LeRobot's folders and parquet files, one row a step. Needs pyarrow alone."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Episode
from oodil.pipeline.datasets import columns
from oodil.pipeline.datasets.columns import Warn
from oodil.pipeline.datasets.entries import REWARDS, first, state_paths
from oodil.pipeline.errors import DataError

_EPISODE, _FRAME = "episode_index", "frame_index"


def read(path: Path, keys: tuple[str, ...], warn: Warn) -> list[Episode]:
    """Return the episodes below a folder, or of one parquet file, in the order of their numbers.

    Args:
        path: a data set's folder, with ``data/chunk-*/*.parquet``, or a file.
        keys: which columns make up a state, in this order; ``observation.state`` without.
        warn: is told where something was a guess.

    Raises DataError. Videos are not looked at.
    """
    import pyarrow
    import pyarrow.parquet

    files = sorted(path.glob("data/**/*.parquet")) if path.is_dir() else [path]
    if not files:
        raise DataError("is a folder, and none of LeRobot's (data/chunk-*/*.parquet); name the files in it")
    try:
        names = dict.fromkeys(pyarrow.parquet.read_schema(files[0]).names, True)
        if _EPISODE not in names:
            raise DataError(f"has no column {_EPISODE!r}, only {', '.join(names)}")
        wanted = [*state_paths(names, keys), _EPISODE, *filter(None, (first(names, REWARDS), first(names, (_FRAME,))))]
        table = pyarrow.concat_tables([pyarrow.parquet.read_table(file, columns=wanted) for file in files])
    except (pyarrow.ArrowException, OSError) as error:
        raise DataError(f"not a sound parquet file ({error})") from error
    rows: dict[str, NDArray] = {name: table[name].to_numpy() for name in wanted}
    order = np.lexsort([rows[name] for name in (_FRAME, _EPISODE) if name in rows])
    try:
        return columns.read({name: values[order] for name, values in rows.items()}, keys, warn)
    except ValueError as error:
        raise DataError(f"rows of a column have different sizes, or none ({error})") from error
