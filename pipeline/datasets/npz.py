"""NumPy archives; which of their arrays are demonstrations, `oodil.pipeline.datasets.layouts` knows."""

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.datasets import layouts, official
from oodil.pipeline.datasets.columns import Warn
from oodil.pipeline.datasets.entries import OURS
from oodil.pipeline.errors import DataError


class _Archive(Mapping[str, Any]):
    """The arrays of an archive, each read when it is asked for, once; objects by the restricted reader."""

    def __init__(self, archive: np.lib.npyio.NpzFile, zipped: ZipFile) -> None:
        self.archive, self.zipped = archive, zipped
        self.found: dict[str, NDArray[Any]] = {}

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self.found:
            try:
                self.found[name] = self.archive[name]
            except ValueError as error:
                if "Object arrays" not in str(error):
                    raise
                with self.zipped.open(f"{name}.npy") as file:
                    self.found[name] = official.read_objects(file)
        return self.found[name]

    def __contains__(self, name: object) -> bool:
        return name in self.archive.files

    def __iter__(self) -> Iterator[str]:
        return iter(self.archive.files)

    def __len__(self) -> int:
        return len(self.archive.files)


def read(path: Path, keys: tuple[str, ...], warn: Warn) -> list[Episode]:
    """Return the episodes of an archive. Raises DataError."""
    try:
        with np.load(path, allow_pickle=False) as archive, ZipFile(path) as zipped:
            return layouts.episodes(_Archive(archive, zipped), keys, warn)
    except (OSError, ValueError, EOFError, BadZipFile, TypeError) as error:
        raise DataError(f"not a sound NumPy archive ({error})") from error


def encode(demonstrations: Demonstrations, columns: Mapping[str, NDArray[Any]]) -> bytes:
    """Return an archive of ``observations`` and ``offsets``, with an array ``oodil_*`` for each (N,) column."""
    content = io.BytesIO()
    found = {f"{OURS}{name}": column for name, column in columns.items()}
    arrays: dict[str, Any] = {"observations": demonstrations.observations, "offsets": demonstrations.offsets} | found
    np.savez(content, **arrays)
    return content.getvalue()
