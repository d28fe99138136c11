"""All states of a recording one after the other, and beside them what says where each demonstration ends.

Letters: N demonstrations, M states in all.
"""

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Episode
from oodil.pipeline.datasets.entries import (
    REWARDS,
    TERMINATED,
    TRUNCATED,
    Keys,
    first,
    joined,
    next_paths,
    numbers,
    state_paths,
)
from oodil.pipeline.errors import DataError

Warn = Callable[[str], None]

OFFSETS = ("offsets",)
ENDS = ("episode_ends",)
LENGTHS = ("lengths", "episode_lengths", "traj_lengths", "trajectory_lengths")
STARTS = ("episode_starts", "is_first")
LAST = ("dones", "done", "is_last")
NUMBERS = ("episode_index", "episode_id", "episode_ids", "episode", "traj_id", "traj_ids")
CUTS = ("indices",)
MARKS = (*OFFSETS, *ENDS, *CUTS, *LENGTHS, *STARTS, *NUMBERS, *LAST, *TERMINATED, *TRUNCATED)
"""What says where a demonstration ends, by every name that it goes by."""


def read(columns: Mapping[str, Any], keys: Keys, warn: Warn) -> list[Episode]:
    """Return the demonstrations of a mapping of columns; ``warn`` is told where their ends are a guess.

    Where the state after each step is there (``next_observations``), the last one ends its demonstration. Raises
    DataError.
    """
    paths = state_paths(columns, keys)
    states = joined(columns, paths)
    following = joined(columns, next_paths(columns, paths)) if next_paths(columns, paths) else None
    if following is not None and following.shape != states.shape:
        raise DataError(f"there are states of shape {states.shape}, but next states of shape {following.shape}")
    offsets = _offsets(columns, len(states), warn)
    if offsets is None and following is not None:
        offsets = _where_chain_breaks(states, following, warn)
    elif offsets is None:
        warn(f"nothing says where a demonstration ends; its {len(states):,} states are taken as one")
        offsets = np.array([0, len(states)])
    returns, terminated = _returns(columns, offsets), _terminated(columns, offsets)
    episodes = []
    for n, (start, end) in enumerate(pairwise(offsets)):
        own = states[start:end]
        if following is not None:
            own = np.concatenate((own, following[end - 1 : end]))
        episodes.append(Episode(own, returns[n], bool(terminated[n])))
    return episodes


def _offsets(columns: Mapping[str, Any], count: int, warn: Warn) -> NDArray[np.int64] | None:
    """Return (N + 1,) where each demonstration starts, and the end; None where nothing says so."""
    for names, offsets_of in (
        (OFFSETS, lambda offsets: offsets),
        (ENDS, lambda ends: [0, *ends]),
        (CUTS, lambda cuts: [0, *(cuts + np.arange(1, len(cuts) + 1)), count]),  # `imitation` counts actions
        (LENGTHS, lambda lengths: np.cumsum([0, *lengths])),
    ):
        name = first(columns, names)
        if name is not None:
            whole = numbers(columns[name], name)
            if whole.ndim != 1 or whole.dtype.kind not in "iu":
                raise DataError(f"{name} are {whole.dtype}{whole.shape}; expected whole numbers in one row")
            return _checked(np.asarray(offsets_of(whole.astype(np.int64)), np.int64), name, count)
    name = first(columns, STARTS)
    if name is not None:
        return _checked(np.append(np.flatnonzero(_column(columns, name, count)), count), name, count)
    name = first(columns, NUMBERS)
    if name is not None:
        return _by_number(_column(columns, name, count), name)
    return _by_last(columns, count, warn)


def _by_number(ids: NDArray[Any], name: str) -> NDArray[np.int64]:
    starts = np.flatnonzero(np.append(True, ids[1:] != ids[:-1]))
    if len(np.unique(ids)) != len(starts):
        raise DataError(f"{name}: the states of a demonstration are not together; sort them first")
    return np.append(starts, len(ids))


def _by_last(columns: Mapping[str, Any], count: int, warn: Warn) -> NDArray[np.int64] | None:
    """Return the offsets by the marks of last states, those of time limits among them."""
    known = [first(columns, names) for names in (LAST, TERMINATED, TRUNCATED)]
    names = [name for name in known if name is not None]
    if not names:
        return None
    last = np.any([_column(columns, name, count) for name in names], axis=0)
    if not last[-1] or (names[0] in TERMINATED and len(names) == 1):
        warn(
            f"{' and '.join(names)}: {last.sum()} of {count:,} states are marked as last"
            + ("" if last[-1] else ", and what follows the last of them is a demonstration too")
            + ("" if len(names) > 1 else "; where time limits are not marked, several may have become one")
        )
    ends = np.flatnonzero(last) + 1
    return np.unique([0, *ends, count])


def _where_chain_breaks(states: NDArray[Any], following: NDArray[Any], warn: Warn) -> NDArray[np.int64]:
    """Return the offsets by where a state is not the one that followed the state before."""
    breaks = np.flatnonzero((following[:-1] != states[1:]).any(axis=1)) + 1
    if len(states) > 2 and len(breaks) == len(states) - 1:
        raise DataError("nothing says where a demonstration ends, and no next state is the state of the next row")
    warn(f"nothing says where a demonstration ends but the next states: {len(breaks)} of them are not in the next row")
    return np.array([0, *breaks, len(states)])


def _checked(offsets: NDArray[np.int64], name: str, count: int) -> NDArray[np.int64]:
    if len(offsets) < 2 or offsets[0] != 0:
        raise DataError(f"{name}: the first demonstration does not start at the first state")
    if offsets[-1] != count:
        raise DataError(f"{name} end at {offsets[-1]} but there are {count} states")
    if (np.diff(offsets) <= 0).any():
        raise DataError(f"{name}: demonstration {np.flatnonzero(np.diff(offsets) <= 0)[0]} has no state")
    return offsets


def _column(columns: Mapping[str, Any], name: str, count: int) -> NDArray[Any]:
    column = numbers(columns[name], name)
    if column.shape not in ((count,), (count, 1)):
        raise DataError(f"{name} have the shape {column.shape}, but there are {count} states")
    return column.reshape(count)


def _returns(columns: Mapping[str, Any], offsets: NDArray[np.int64]) -> list[float]:
    """Return N sums of rewards, NaN where there are none; a demonstration may have one fewer than states."""
    name, count = first(columns, REWARDS), len(offsets) - 1
    if name is None:
        return [np.nan] * count
    rewards = numbers(columns[name], name).ravel()
    if len(rewards) == offsets[-1] - count:
        offsets = offsets - np.arange(count + 1)
    if len(rewards) != offsets[-1]:
        raise DataError(f"{name} have {len(rewards)} entries; expected one a state or one a step")
    return [float(rewards[start:end].sum()) for start, end in pairwise(offsets)]


def _terminated(columns: Mapping[str, Any], offsets: NDArray[np.int64]) -> NDArray[Any]:
    """Return (N,) whether the environment ended each; it may be marked by demonstration or by state."""
    name, count = first(columns, TERMINATED), len(offsets) - 1
    if name is None:
        return np.zeros(count, np.bool_)
    marks = numbers(columns[name], name)
    return marks if marks.shape == (count,) else _column(columns, name, int(offsets[-1]))[offsets[1:] - 1]
