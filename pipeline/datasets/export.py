"""What a run found out about each demonstration, written to where the demonstrations came from, or to a table."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import write_file
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.datasets import hdf5, minari, npz
from oodil.pipeline.datasets.foreign import read_foreign
from oodil.pipeline.errors import DataError

TARGETS = "FILE.csv (a new table), FILE.hdf5 (masks and attributes) or minari:DATASET_ID (episode metadata)"

NEW_FILES = "FILE.csv (a table), FILE.hdf5 or FILE.npz (the demonstrations, with what was found of each)"


def export(demonstrations: Demonstrations, columns: Mapping[str, NDArray[Any]], target: str) -> str:
    """Write cluster, transferability with interval, verdict and weight of (N,) demonstrations and return what was done.

    Args:
        demonstrations: those of the run; an existing target must hold exactly those of one of its sources.
        columns: (N,) each, among them ``cluster`` and ``weight``.
        target: one of `TARGETS`.

    Raises DataError or StorageError.
    """
    path = Path(target)
    if path.suffix == ".csv":
        write_file(path, _table(demonstrations, columns))
        return f"{path}: {len(demonstrations)} rows"
    if not target.startswith("minari:") and path.suffix not in (".hdf5", ".h5"):
        raise DataError(f"{target}: unknown format; give {TARGETS}")
    rows = _held(target, demonstrations)
    transferable = _heavy(columns)[rows]
    columns = {name: column[rows] for name, column in columns.items()}
    if target.startswith("minari:"):
        minari.write_metadata(target.removeprefix("minari:"), columns)
        return f"{target}: metadata of {len(rows)} episodes"
    hdf5.write_masks(path, transferable, columns)
    return f"{path}: mask/oodil_transferable with {transferable.sum()} of {len(rows)} demonstrations"


def _heavy(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Return (N,) which demonstrations weigh more than the average; they are called transferable where one says so."""
    heavier: NDArray[np.bool_] = columns["weight"] > columns["weight"].mean()
    return heavier


def _held(target: str, demonstrations: Demonstrations) -> NDArray[np.int64]:
    """Return which demonstrations a recording holds: those of the source whose states it has, bit by bit.

    Raises DataError when it is none of them.
    """
    reason = ""
    for source, label in enumerate(demonstrations.source_labels):
        rows = np.flatnonzero(demonstrations.sources == source)
        if not len(rows):
            continue
        own = demonstrations.select(rows)
        try:
            found, _ = read_foreign(target, label, own.source_keys[source] if own.source_keys else (), False)
        except DataError as error:
            reason = reason or str(error)
            continue
        bits = [(each.offsets.tobytes(), each.observations.tobytes()) for each in (found, own)]
        if bits[0] == bits[1]:
            return rows
        reason = (
            f"{target}: is not what the run's demonstrations are from: it has {len(found)} demonstrations with "
            f"{found.offsets[-1]} states; the run has {len(own)} of {label or 'unnamed'} with {own.offsets[-1]}"
        )
    raise DataError(reason)


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
            content = hdf5.encode(demonstrations, environment, _heavy(columns), columns)
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
