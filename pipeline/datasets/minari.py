"""Minari data sets that are on this machine already; nothing is downloaded. Needs the extra ``oodil[data]``."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from oodil.pipeline.artifacts import write_file
from oodil.pipeline.data import Episode
from oodil.pipeline.datasets import layouts
from oodil.pipeline.datasets.entries import OURS, STATES, TERMINATED
from oodil.pipeline.errors import DataError


def read(dataset_id: str, keys: tuple[str, ...]) -> tuple[list[Episode], str]:
    """Return the episodes of a local data set and the id of its environment, empty where it names none.

    Args:
        dataset_id: as listed by ``minari list local``.
        keys: where observations are dictionaries, which entries make up a state, in this order.

    Raises DataError.
    """
    dataset = _local(dataset_id)
    episodes = []
    try:
        for n, episode in enumerate(dataset.iterate_episodes()):
            nested = isinstance(episode.observations, dict | tuple)
            # A terminated episode may have ended in success: whether it is a failure, only its owner knows.
            parts = {
                STATES[0]: episode.observations,
                "rewards": episode.rewards,
                TERMINATED[0]: episode.terminations,
            }
            episodes.append(layouts.episode(parts, keys if nested else (), f"demonstration {n}"))
    except (OSError, KeyError, ValueError) as error:
        raise DataError(f"not a sound Minari data set ({type(error).__name__}: {error})") from error
    return episodes, dataset.env_spec.id if dataset.env_spec is not None else ""


def write_metadata(dataset_id: str, columns: Mapping[str, NDArray[Any]]) -> None:
    """Add ``oodil_*`` entries to the metadata of the (N,) episodes of a data set; what we added before goes."""
    dataset = _local(dataset_id)
    indices = [int(index) for index in dataset.episode_indices]
    rows = [{f"{OURS}{name}": column[n].item() for name, column in columns.items()} for n in range(len(indices))]
    _forget(dataset.storage, indices)
    dataset.storage.update_episode_metadata(rows, indices)


def _forget(storage: Any, indices: list[int]) -> None:
    """Remove our metadata, for which Minari has no way of its own."""
    folder = Path(storage.data_path)
    if storage.FORMAT == "hdf5":
        import h5py

        with h5py.File(folder / "main_data.hdf5", "r+") as file:
            for index in indices:
                attributes = file[f"episode_{index}"].attrs
                for old in [name for name in attributes if name.startswith(OURS)]:
                    del attributes[old]
        return
    for path in (folder / str(index) / "metadata.json" for index in indices):
        if path.exists():
            kept = {name: value for name, value in json.loads(path.read_text()).items() if not name.startswith(OURS)}
            write_file(path, json.dumps(kept).encode())


def _local(dataset_id: str) -> Any:
    import minari

    try:
        return minari.load_dataset(dataset_id, download=False)
    except (FileNotFoundError, ValueError) as error:
        raise DataError(f"not a local Minari data set ({error})") from error
