"""Minari data sets that are on this machine already; nothing is downloaded. Needs the extra ``oodil[data]``."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Demonstrations, Episode
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
    for episode in dataset.iterate_episodes():
        # A terminated episode may have ended in success: whether it is a failure, only its owner knows.
        states = _states(episode.observations, keys)
        episodes.append(Episode(states, float(np.sum(episode.rewards)), bool(episode.terminations[-1])))
    return episodes, dataset.env_spec.id if dataset.env_spec is not None else ""


def write_metadata(dataset_id: str, demonstrations: Demonstrations, columns: Mapping[str, NDArray[Any]]) -> None:
    """Add ``oodil_*`` entries to the metadata of each episode of the data set that the demonstrations came from.

    Raises DataError when it has another number of episodes, or episodes of other lengths.
    """
    dataset = _local(dataset_id)
    lengths = [len(episode) + 1 for episode in dataset.iterate_episodes()]
    if lengths != demonstrations.lengths.tolist():
        raise DataError(
            f"{dataset_id} has {len(lengths)} episodes with {sum(lengths)} states; the run has "
            f"{len(demonstrations)} with {demonstrations.lengths.sum()}: it was made from other data"
        )
    rows = [{f"oodil_{name}": column[n].item() for name, column in columns.items()} for n in range(len(lengths))]
    dataset.storage.update_episode_metadata(rows, dataset.episode_indices)


def _local(dataset_id: str) -> Any:
    import minari

    try:
        return minari.load_dataset(dataset_id, download=False)
    except (FileNotFoundError, ValueError) as error:
        raise DataError(f"not a local Minari data set ({error})") from error


def _states(observations: Any, keys: tuple[str, ...]) -> NDArray[np.floating]:
    if isinstance(observations, dict):
        if not keys:
            raise DataError(f"observations have entries {', '.join(sorted(observations))}; choose with --keys")
        missing = [key for key in keys if key not in observations]
        if missing:
            raise DataError(f"observations have no entry {missing[0]!r}; there are {', '.join(sorted(observations))}")
        parts = [np.asarray(observations[key]) for key in keys]
        return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
    return np.asarray(observations)
