"""Demonstrations from elsewhere, whatever their format, for ``oodil demos convert`` and ``oodil score``."""

from dataclasses import replace
from pathlib import Path

from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.datasets import minari, npz, official, robomimic
from oodil.pipeline.datasets.native import read_demonstrations
from oodil.pipeline.errors import DataError

_MINARI = "minari:"
FORMATS = "FILE.npz, FILE.hdf5 (robomimic), FILE.pkl (released code) or minari:DATASET_ID"


def read_any(source: str, keys: tuple[str, ...] = (), ends_are_failures: bool = False) -> tuple[Demonstrations, str]:
    """Return the demonstrations of a file of ours, or of one of `FORMATS`, and the imitator's environment they name.

    Only our own files name it: others name the one that they were recorded in, under a name of their own.
    """
    if Path(source).suffix == ".safetensors":
        return read_demonstrations(source)
    label = source if source.startswith(_MINARI) else Path(source).stem
    return read_foreign(source, label, keys, ends_are_failures)[0], ""


def read_foreign(source: str, label: str, keys: tuple[str, ...], ends_are_failures: bool) -> tuple[Demonstrations, str]:
    """Return the demonstrations of one source and the environment it names, if any.

    Args:
        source: one of `FORMATS`.
        label: what the source is called in reports.
        keys: for observations with several entries, those that make up a state.
        ends_are_failures: whether an episode that the environment ended is one in which the demonstrator failed.

    Raises DataError that names the source and what is wrong with it.
    """
    try:
        episodes, environment = _episodes(source, keys)
        if not ends_are_failures:
            episodes = [replace(episode, terminated=False) for episode in episodes]
        return Demonstrations.of(episodes, label), environment
    except DataError as error:
        raise DataError(f"{source}: {error}") from error
    except ImportError as error:
        raise DataError(f"{source}: needs {error.name}; pip install 'oodil[data]'") from error


def _episodes(source: str, keys: tuple[str, ...]) -> tuple[list[Episode], str]:
    if source.startswith(_MINARI):
        return minari.read(source.removeprefix(_MINARI), keys)
    path = Path(source)
    if not path.is_file():
        raise DataError("no such file")
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return npz.read(path), ""
    if suffix in (".hdf5", ".h5"):
        return robomimic.read(path, keys)
    if suffix in (".pkl", ".pickle"):
        return official.read(path), ""
    raise DataError(f"unknown format; give {FORMATS}")
