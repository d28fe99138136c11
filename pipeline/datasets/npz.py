"""NumPy archives: our own two arrays, one array per demonstration, or the trajectories of the `imitation` library."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.errors import DataError


def read(path: Path) -> list[Episode]:
    """Return the episodes of an archive. It holds one of these:

    * ``observations`` (sum T, S) and ``offsets`` (N + 1),
    * ``obs`` (sum T, S) and ``indices`` (N - 1), as saved by `imitation`, with ``rews`` and ``terminal`` if there,
    * any number of (T, S) arrays, taken in the order in which they were saved.

    Raises DataError. Objects, which would have to be unpickled, are not touched.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            if "obs" in archive and "indices" in archive:
                return _imitation(archive)
            if "observations" in archive and "offsets" in archive:
                parts = np.split(archive["observations"], archive["offsets"][1:-1])
            else:
                parts = [archive[name] for name in archive.files]
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise DataError(f"not a sound NumPy archive ({error})") from error
    return [Episode(part) for part in parts]


def _imitation(archive: np.lib.npyio.NpzFile) -> list[Episode]:
    """Read concatenated trajectories; ``indices`` counts actions, of which each has one fewer than states."""
    cuts = archive["indices"]
    states = np.split(archive["obs"], cuts + np.arange(1, len(cuts) + 1))
    returns = [float(r.sum()) for r in np.split(archive["rews"], cuts)] if "rews" in archive else [np.nan] * len(states)
    ended = archive["terminal"] if "terminal" in archive else np.zeros(len(states), np.bool_)
    return [Episode(s, r, bool(e)) for s, r, e in zip(states, returns, ended, strict=True)]


def encode(demonstrations: Demonstrations, columns: Mapping[str, NDArray[Any]]) -> bytes:
    """Return an archive of ``observations`` and ``offsets``, with an array ``oodil_*`` for each (N,) column."""
    content = io.BytesIO()
    found = {f"oodil_{name}": column for name, column in columns.items()}
    arrays: dict[str, Any] = {"observations": demonstrations.observations, "offsets": demonstrations.offsets} | found
    np.savez(content, **arrays)
    return content.getvalue()
