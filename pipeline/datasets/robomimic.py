"""HDF5 files as robomimic writes them: ``data/demo_N/obs/KEY``. Needs the extra ``oodil[data]``."""

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.errors import DataError


def read(path: Path, keys: tuple[str, ...]) -> tuple[list[Episode], str]:
    """Return the episodes of a file, in the order of their numbers, and the name of the environment, if it has one.

    Args:
        path: the file.
        keys: which low-dimensional observations make up a state, in this order.

    ``next_obs`` gives the last state where it is there. Raises DataError.
    """
    import h5py

    try:
        with h5py.File(path) as file:
            names = _names(file)
            available = sorted(file[f"data/{names[0]}/obs"])
            if not keys:
                raise DataError(f"observations have entries {', '.join(available)}; choose with --keys")
            missing = [key for key in keys if key not in available]
            if missing:
                raise DataError(f"observations have no entry {missing[0]!r}; there are {', '.join(available)}")
            return [_episode(file[f"data/{name}"], keys) for name in names], _environment(file)
    except DataError:
        raise
    except (OSError, KeyError, ValueError, IndexError) as error:
        raise DataError(f"not a sound robomimic file ({error})") from error


def write_masks(path: Path, demonstrations: Demonstrations, columns: Mapping[str, NDArray[Any]]) -> int:
    """Add filter keys to a file that the demonstrations came from, and return how many are in the first.

    ``mask/oodil_transferable`` names those that weigh more than the average, ``mask/oodil_cluster_K`` the members of
    each cluster; the columns also become attributes of each demonstration. Raises DataError when the file has another
    number of demonstrations.
    """
    import h5py

    with h5py.File(path, "r+") as file:
        count = len(_names(file))
        if count != len(demonstrations):
            raise DataError(f"{path}: has {count} demonstrations; the run has {len(demonstrations)}")
        return _mark(file, columns)


def encode(demonstrations: Demonstrations, environment: str, columns: Mapping[str, NDArray[Any]]) -> bytes:
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
        _mark(file, columns)
    return content.getvalue()


def _mark(file: Any, columns: Mapping[str, NDArray[Any]]) -> int:
    """Add masks and attributes to the demonstrations of an open file; return how many are called transferable."""
    names = np.array(_names(file))
    transferable = columns["weight"] > columns["weight"].mean()
    masks = {"oodil_transferable": transferable}
    masks |= {f"oodil_cluster_{k}": columns["cluster"] == k for k in np.unique(columns["cluster"])}
    for mask, members in masks.items():
        if f"mask/{mask}" in file:
            del file[f"mask/{mask}"]
        file[f"mask/{mask}"] = np.array(names[members], "S")
    for n, name in enumerate(names):
        for column, values in columns.items():
            file[f"data/{name}"].attrs[f"oodil_{column}"] = values[n].item()
    return int(transferable.sum())


def _names(file: Any) -> list[str]:
    return sorted(file["data"], key=lambda name: int(name.rpartition("_")[2]))


def _episode(group: Any, keys: tuple[str, ...]) -> Episode:
    states = _states(group["obs"], keys)
    if "next_obs" in group:
        states = np.concatenate((states, _states(group["next_obs"], keys)[-1:]))
    return Episode(states, float(np.sum(group["rewards"])) if "rewards" in group else float("nan"))


def _states(group: Any, keys: tuple[str, ...]) -> NDArray[np.floating]:
    return np.concatenate([np.asarray(group[key]).reshape(len(group[key]), -1) for key in keys], axis=1)


def _environment(file: Any) -> str:
    return str(json.loads(file["data"].attrs.get("env_args", "{}")).get("env_name", ""))
