"""Which of the usual layouts a recording has, whatever file it is in: one demonstration at a time, or in columns.

* Numbered: ``demo_0``, ``demo_1``, ... (below ``data`` or not), each an array or a mapping with its states.
* A list: of arrays, of mappings with the states of a demonstration, of lists of its steps; or of steps alone.
* A mapping with such lists, with ``(N, T, S)`` arrays, or with columns (`oodil.pipeline.datasets.columns`).

Letters: N demonstrations, T states, S observation.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from oodil.pipeline.data import Episode
from oodil.pipeline.datasets import columns
from oodil.pipeline.datasets.columns import LENGTHS, MARKS, Warn
from oodil.pipeline.datasets.entries import (
    REWARDS,
    STATES,
    TERMINATED,
    Keys,
    find,
    first,
    flat,
    joined,
    next_paths,
    numbers,
    state_paths,
)
from oodil.pipeline.errors import DataError

_BELOW = ("data", "episodes", "trajectories", "demonstrations")
"""Where numbered demonstrations may lie, if not at the top."""


class Steps(Mapping[str, Any]):
    """Mappings of single steps, seen as one mapping of columns."""

    def __init__(self, steps: Sequence[Mapping[str, Any]]) -> None:
        self.steps = steps

    def __getitem__(self, name: str) -> Any:
        """Return the entries of this name, one below the other. Raises DataError when a step has none."""
        if name not in self.steps[0]:
            raise KeyError(name)
        missing = [t for t, step in enumerate(self.steps) if name not in step]
        if missing:
            raise DataError(f"step {missing[0]} has no entry {name!r}")
        values = [step[name] for step in self.steps]
        return Steps(values) if isinstance(values[0], Mapping) else np.asarray(values)

    def __iter__(self) -> Iterator[str]:
        return iter(self.steps[0])

    def __len__(self) -> int:
        return len(self.steps[0])


def episodes(content: Any, keys: Keys, warn: Warn) -> list[Episode]:
    """Return the demonstrations of a recording; ``warn`` is told where something was a guess. Raises DataError."""
    try:
        if isinstance(content, Mapping):
            return _of_mapping(content, keys, warn)
        if isinstance(content, tuple) and content and _is_list(content[0]):
            content = content[0]  # The released code: states first, then actions.
        if isinstance(content, np.ndarray) and content.ndim == 2 and content.dtype != object:
            return columns.read({STATES[0]: content}, (), warn)
        if not isinstance(content, list | np.ndarray) or not len(content):
            raise DataError(f"holds {type(content).__name__}, not a list of arrays")
        if isinstance(content[0], Mapping) and _is_step(content[0], keys):
            return _of_mapping(Steps(list(content)), keys, warn)
        return [episode(part, keys, f"demonstration {n}") for n, part in enumerate(content)]
    except (TypeError, ValueError) as error:
        raise DataError(f"holds something that is no array of states ({error})") from error


def episode(content: Any, keys: Keys, name: str) -> Episode:
    """Return one demonstration: an array of its states, a mapping with them, or a list of its steps.

    Raises DataError that begins with its ``name``.
    """
    try:
        if isinstance(content, list | tuple) and content and isinstance(content[0], Mapping):
            content = Steps(content)
        if not isinstance(content, Mapping):
            array = numbers(content, "states")
            found = Episode(flat(array) if array.ndim > 2 else array)
        else:
            found = _of_entries(content, state_paths(content, keys))
    except DataError as error:
        raise DataError(f"{name}: {error}") from error
    if len(found.states) < 2:
        raise DataError(f"{name} has {len(found.states)} state(s); a transition needs at least 2")
    return found


def _of_entries(content: Mapping[str, Any], paths: list[str]) -> Episode:
    states, following = joined(content, paths), next_paths(content, paths)
    if following:
        states = np.concatenate((states, joined(content, following)[-1:]))
    rewards, terminated = first(content, REWARDS), first(content, TERMINATED)
    return Episode(
        states,
        float(numbers(content[rewards], rewards).sum()) if rewards else np.nan,
        bool(numbers(content[terminated], terminated).ravel()[-1:].any()) if terminated else False,
    )


def _of_mapping(content: Mapping[str, Any], keys: Keys, warn: Warn) -> list[Episode]:
    alone = _alone(content)
    if alone is not None and not keys:
        return episodes(alone, keys, warn)
    group, names = numbered(content, keys)
    if names:
        return [episode(group[name], keys, f"demonstration {n} ({name})") for n, name in enumerate(names)]
    paths = state_paths(content, keys)
    value = find(content, paths[0])
    if not _is_list(value) or _has_columns(content, value):
        return columns.read(content, keys, warn)
    lengths = first(content, LENGTHS)
    limits = numbers(content[lengths], lengths).tolist() if lengths else [None] * len(value)
    if len(limits) != len(value) or (lengths and max(limits) > max(map(len, value))):
        raise DataError(f"{lengths} do not fit {len(value)} demonstrations of {len(value[0])} states")
    wanted = [*paths, *next_paths(content, paths), first(content, REWARDS), first(content, TERMINATED)]
    found = {path: find(content, path) for path in wanted if path}
    lists = {path: each for path, each in found.items() if hasattr(each, "__len__")}
    uneven = [path for path, each in lists.items() if len(each) != len(value)]
    if uneven:
        raise DataError(f"{uneven[0]} has {len(lists[uneven[0]])} entries for {len(value)} demonstrations")
    return [
        episode(
            {path: np.atleast_1d(each[n])[:limit] for path, each in lists.items()}, tuple(paths), f"demonstration {n}"
        )
        for n, limit in enumerate(limits)
    ]


def _alone(content: Mapping[str, Any]) -> Any:
    """Return the one entry that there is, if it holds demonstrations one by one; None otherwise.

    ``numpy.savez`` calls it ``arr_0`` where it is given no name, and makes an array without axes of a dictionary.
    """
    name = next(iter(content), "")
    if len(content) != 1 or (name != "arr_0" and re.search(r"\d$", str(name))):
        return None
    value = content[name]
    if isinstance(value, np.ndarray) and not value.ndim:
        return value.item() if value.dtype == object else None
    if not _is_list(value):
        return None
    return list(value) if isinstance(value, list | tuple) else np.asarray(value)


def numbered(content: Mapping[str, Any], keys: Keys) -> tuple[Mapping[str, Any], list[Any]]:
    """Return the mapping that holds demonstrations by number, and their names in that order; none for others.

    Arrays have to be all that there is: beside one that has another name, they may be anything.
    """
    below = first(content, _BELOW)
    group = content[below] if below and isinstance(content[below], Mapping) else content
    if first(group, STATES) or (keys and all(find(group, key) is not None for key in keys)):
        return group, []
    found: dict[str, list[tuple[int, Any]]] = {}
    for name in group:
        parts = re.fullmatch(r"(.*?)(\d+)", str(name))
        if parts:
            found.setdefault(parts[1], []).append((int(parts[2]), name))
    alike = [prefix for prefix in found if len(found) == 1 or prefix.strip("_-") in STATES]
    if len(alike) != 1:
        return group, []
    names = [name for _, name in sorted(found[alike[0]])]
    whole = len(names) == len(group) or alike[0].strip("_-") in STATES or isinstance(group[names[0]], Mapping)
    return group, names if whole else []


def _is_list(value: Any) -> bool:
    """Return whether a value holds demonstrations one by one: a list or an array (N, T, S) of them."""
    if isinstance(value, list | tuple):
        return len(value) > 0 and np.ndim(value[0]) >= 1
    return getattr(value, "ndim", 0) > 2 or np.dtype(getattr(value, "dtype", float)).hasobject


def _has_columns(content: Mapping[str, Any], value: Any) -> bool:
    """Return whether an array of more than two axes has one row a state, as what is beside it says."""
    if getattr(value, "ndim", 0) < 3:
        return False
    lengths = first(content, LENGTHS)
    if lengths:
        return int(np.sum(content[lengths])) == len(value)
    marks = [name for name in MARKS if name in content]
    uneven = [name for name in marks if np.ndim(content[name]) != 1]
    if uneven:
        raise DataError(f"{uneven[0]} have the shape {np.shape(content[uneven[0]])}; expected one row")
    return bool(marks)


def _is_step(content: Mapping[str, Any], keys: Keys) -> bool:
    return all(np.ndim(find(content, path)) < 2 for path in state_paths(content, keys))
