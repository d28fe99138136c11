"""Demonstrations from elsewhere, whatever their format, for ``oodil demos convert`` and ``oodil score``."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.datasets import hdf5, layouts, lerobot, minari, npz, official
from oodil.pipeline.datasets.columns import Warn
from oodil.pipeline.datasets.native import read_demonstrations
from oodil.pipeline.errors import DataError

_MINARI = "minari:"
FORMATS = "FILE.npz, FILE.hdf5, FILE.pkl, FILE.parquet, a folder of LeRobot's or minari:DATASET_ID"
_POINTER = b"version https://git-lfs"
_LOST = 0.01
"""From which part of its movement on, what 32 bits lose of a state is worth a word."""


def silent(message: str) -> None:
    """Say nothing."""


def read_any(source: str, keys: tuple[str, ...] = (), ends_are_failures: bool = False) -> tuple[Demonstrations, str]:
    """Return the demonstrations of a file of ours, or of one of `FORMATS`, and the imitator's environment they name.

    Only our own files name it: others name the one that they were recorded in, under a name of their own.
    """
    if Path(source).suffix == ".safetensors":
        return read_demonstrations(source)
    return read_foreign(source, labels_of([source])[0], keys, ends_are_failures)[0], ""


def read_foreign(
    source: str, label: str, keys: tuple[str, ...], ends_are_failures: bool, warn: Warn = silent
) -> tuple[Demonstrations, str]:
    """Return the demonstrations of one source and the environment it names, if any.

    Args:
        source: one of `FORMATS`.
        label: what the source is called in reports.
        keys: for observations with several entries, those that make up a state.
        ends_are_failures: whether an episode that the environment ended is one in which the demonstrator failed.
        warn: is told what was a guess, and what 32 bits lose.

    Raises DataError that names the source and what is wrong with it.
    """
    try:
        episodes, environment = _episodes(source, keys, lambda message: warn(f"{source}: {message}"))
        if not ends_are_failures:
            episodes = [replace(episode, terminated=False) for episode in episodes]
        demonstrations = Demonstrations.of(episodes, label, keys)
    except DataError as error:
        raise DataError(f"{source}: {error}") from error
    except ImportError as error:
        # Minari's own errors begin with the name of what is missing.
        raise DataError(f"{source}: needs {error.name or str(error).split()[0]}; pip install 'oodil[data]'") from error
    lost = _lost(episodes)
    if (lost > _LOST).any():
        worst = int(lost.argmax())
        warn(
            f"{source}: as 32-bit floats, {(lost > _LOST).sum()} of {len(lost)} numbers of a state lose part of their "
            f"movement, number {worst} {min(lost[worst], 1):.0%} of it; subtract what they have in common first"
        )
    return demonstrations, environment


def check_output(output: Path, sources: Sequence[str]) -> None:
    """Raise DataError, before any work, for a file that is no place for demonstrations, or one of the sources."""
    if output.suffix != ".safetensors":
        raise DataError(f"{output}: demonstrations are written as FILE.safetensors")
    if output.is_dir():
        raise DataError(f"{output}: is a folder")
    if not output.absolute().parent.is_dir():
        raise DataError(f"{output.parent}: no such folder")
    paths = [Path(source) for source in sources if not source.startswith(_MINARI)]
    if output.exists() and any(path.exists() and path.samefile(output) for path in paths):
        raise DataError(f"{output}: is what was to be read; choose another file")


def labels_of(sources: Sequence[str]) -> list[str]:
    """Return what sources are called: by their file, and where that is not enough, by its folders too.

    Raises DataError for a source that is given twice.
    """
    paths = [None if source.startswith(_MINARI) else Path(source).absolute() for source in sources]
    same = [source for source, count in Counter(map(str, map(_resolved, sources))).items() if count > 1]
    if same:
        raise DataError(f"{same[0]}: is given twice")
    labels = [source if path is None else path.stem for source, path in zip(sources, paths, strict=True)]
    for depth in range(2, max((len(path.parts) for path in paths if path), default=1) + 1):
        counts = Counter(labels)
        labels = [
            label if path is None or counts[label] == 1 else "/".join(path.with_suffix("").parts[-depth:])
            for label, path in zip(labels, paths, strict=True)
        ]
    counts = Counter(labels)  # Those that are left differ in how they end.
    return [
        label if path is None or counts[label] == 1 else path.name for label, path in zip(labels, paths, strict=True)
    ]


def _resolved(source: str) -> str:
    return source if source.startswith(_MINARI) else str(Path(source).resolve())


def _episodes(source: str, keys: tuple[str, ...], warn: Warn) -> tuple[list[Episode], str]:
    if source.startswith(_MINARI):
        return minari.read(source.removeprefix(_MINARI), keys)
    path = Path(source)
    suffix = path.suffix.lower()
    if path.is_dir():
        return lerobot.read(path, keys, warn), ""
    if not path.is_file():
        raise DataError("no such file")
    with path.open("rb") as file:
        if file.read(len(_POINTER)) == _POINTER:
            raise DataError("is the pointer of a file that Git LFS keeps elsewhere; git lfs pull brings the file")
    if suffix == ".npz":
        return npz.read(path, keys, warn), ""
    if suffix in (".hdf5", ".h5"):
        return hdf5.read(path, keys, warn)
    if suffix in (".pkl", ".pickle"):
        return layouts.episodes(official.read(path), keys, warn), ""
    if suffix == ".parquet":
        return lerobot.read(path, keys, warn), ""
    raise DataError(f"unknown format; give {FORMATS}")


def _lost(episodes: list[Episode]) -> NDArray[np.float64]:
    """Return (S,) the part of the movement from state to state that rounding to 32 bits takes or adds."""
    moved, rounded = 0.0, 0.0
    for episode in episodes:
        states = np.asarray(episode.states, np.float64)
        change = np.diff(states, axis=0)
        moved = moved + (change**2).sum(axis=0)
        rounded = rounded + ((np.diff(states.astype(np.float32).astype(np.float64), axis=0) - change) ** 2).sum(axis=0)
    return np.sqrt(rounded / np.maximum(moved, np.finfo(np.float64).tiny))
