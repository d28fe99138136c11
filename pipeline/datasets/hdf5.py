"""HDF5 files: robomimic's ``data/demo_N/obs/KEY`` and its relatives, and columns. Needs the extra ``oodil[data]``."""

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.datasets import layouts
from oodil.pipeline.datasets.columns import Warn
from oodil.pipeline.datasets.entries import OURS
from oodil.pipeline.errors import DataError, StorageError


def read(path: Path, keys: tuple[str, ...], warn: Warn) -> tuple[list[Episode], str]:
    """Return the episodes of a file, in the order of their numbers, and the name of the environment, if it has one.

    Args:
        path: the file.
        keys: which entries make up a state, in this order; nothing else is read.
        warn: is told where something was a guess.

    Raises DataError.
    """
    import h5py

    try:
        with h5py.File(path) as file:
            return layouts.episodes(file, keys, warn), _environment(file)
    except (OSError, KeyError, ValueError, IndexError, AttributeError) as error:
        raise DataError(f"not a sound HDF5 file ({error})") from error


def write_masks(path: Path, transferable: NDArray[np.bool_], columns: Mapping[str, NDArray[Any]]) -> None:
    """Add filter keys to a file whose demonstrations, (N,), are known by number; what we added before goes.

    ``mask/oodil_transferable`` names some of them, ``mask/oodil_cluster_K`` the members of each cluster; the columns
    also become attributes of each demonstration. Raises DataError or StorageError.
    """
    import h5py

    try:
        with h5py.File(path, "r+") as file:
            _mark(file, transferable, columns)
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error})") from error


def encode(
    demonstrations: Demonstrations,
    environment: str,
    transferable: NDArray[np.bool_],
    columns: Mapping[str, NDArray[Any]],
) -> bytes:
    """Return a new file with the demonstrations, their states as the one entry ``state``, and what `write_masks` adds.

    ``next_obs`` is there so that no state is lost.
    """
    import h5py

    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file.create_group("data").attrs["env_args"] = json.dumps({"env_name": environment})
        for n in range(len(demonstrations)):
            group, states = file.create_group(f"data/demo_{n}"), demonstrations[n]
            group["obs/state"], group["next_obs/state"] = states[:-1], states[1:]
            group.attrs["num_samples"] = len(states) - 1
        _mark(file, transferable, columns)
    return content.getvalue()


def _mark(file: Any, transferable: NDArray[np.bool_], columns: Mapping[str, NDArray[Any]]) -> None:
    """Add masks and attributes to the demonstrations of an open file."""
    group, found = layouts.numbered(file, ())
    if len(found) != len(transferable):
        raise DataError(f"{file.filename}: has no groups such as data/demo_0 that could be marked; export to FILE.csv")
    names = np.array(found)
    for mask in [name for name in file.get("mask", ()) if name.startswith(OURS)]:
        del file[f"mask/{mask}"]
    masks = {"transferable": transferable}
    masks |= {f"cluster_{k}": columns["cluster"] == k for k in np.unique(columns["cluster"])}
    for mask, members in masks.items():
        file[f"mask/{OURS}{mask}"] = np.array([name.encode() for name in names[members]], "S")
    for n, name in enumerate(found):
        attributes = group[name].attrs
        for old in [each for each in attributes if each.startswith(OURS)]:
            del attributes[old]
        for column, values in columns.items():
            attributes[f"{OURS}{column}"] = values[n].item()


def _environment(file: Any) -> str:
    """Return what robomimic's attributes name, wherever demonstrations lie."""
    arguments = file["data"].attrs.get("env_args", "{}") if "data" in file else "{}"
    return str(json.loads(arguments).get("env_name", ""))
