"""What a run found out about each demonstration, written to where the demonstrations came from, or to a table."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from oodil.pipeline.artifacts import write_file
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.datasets import minari, npz, robomimic
from oodil.pipeline.errors import DataError

TARGETS = "FILE.csv (a new table), FILE.hdf5 (masks and attributes) or minari:DATASET_ID (episode metadata)"

NEW_FILES = "FILE.csv (a table), FILE.hdf5 or FILE.npz (the demonstrations, with what was found of each)"


def export(demonstrations: Demonstrations, columns: Mapping[str, NDArray[Any]], target: str) -> str:
    """Write cluster, transferability with interval, verdict and weight of (N,) demonstrations and return what was done.

    Args:
        demonstrations: those of the run; an existing target must hold exactly these.
        columns: (N,) each, among them ``cluster`` and ``weight``.
        target: one of `TARGETS`.

    Raises DataError.
    """
    path = Path(target)
    try:
        if target.startswith("minari:"):
            minari.write_metadata(target.removeprefix("minari:"), demonstrations, columns)
            return f"{target}: metadata of {len(demonstrations)} episodes"
        if path.suffix in (".hdf5", ".h5"):
            chosen = robomimic.write_masks(path, demonstrations, columns)
            return f"{path}: mask/oodil_transferable with {chosen} of {len(demonstrations)} demonstrations"
    except ImportError as error:
        raise DataError(f"{target}: needs {error.name}; pip install 'oodil[data]'") from error
    if path.suffix != ".csv":
        raise DataError(f"{target}: unknown format; give {TARGETS}")
    write_file(path, _table(demonstrations, columns))
    return f"{path}: {len(demonstrations)} rows"


def check_new_file(target: Path, source: str) -> None:
    """Raise DataError, before any work, for a file that `write_new` cannot write, or that is the source itself."""
    if target.suffix not in (".csv", ".hdf5", ".h5", ".npz"):
        raise DataError(f"{target}: unknown format; give {NEW_FILES}")
    if target.resolve() == Path(source).resolve():
        raise DataError(f"{target}: is what was to be read; choose another file")
    if not target.parent.is_dir():
        raise DataError(f"{target.parent}: no such folder")


def write_new(
    demonstrations: Demonstrations, environment: str, columns: Mapping[str, NDArray[Any]], target: Path
) -> None:
    """Write one of `NEW_FILES`, with (N,) columns, among them ``cluster`` and ``weight``. Raises DataError."""
    try:
        if target.suffix == ".csv":
            content = _table(demonstrations, columns)
        elif target.suffix == ".npz":
            content = npz.encode(demonstrations, columns)
        else:
            content = robomimic.encode(demonstrations, environment, columns)
    except ImportError as error:
        raise DataError(f"{target}: needs {error.name}; pip install 'oodil[data]'") from error
    write_file(target, content)


def _table(demonstrations: Demonstrations, columns: Mapping[str, NDArray[Any]]) -> bytes:
    """Return CSV with one row a demonstration."""
    text = io.StringIO(newline="")
    table = csv.writer(text)
    table.writerow(["demonstration", "source", "states", *columns])
    for n, length in enumerate(demonstrations.lengths.tolist()):
        source = demonstrations.source_labels[demonstrations.sources[n]]
        table.writerow([n, source, length, *(column[n].item() for column in columns.values())])
    return text.getvalue().encode()
