"""What is in a recording and what it is called: nested entries by their paths, such as ``obs/arm``.

A recording is a tree: mappings (a dictionary, an archive, a group of an HDF5 file) and tuples, whose entries are
``0``, ``1`` and so on, with arrays at the ends. Arrays are read when they are asked for, and no earlier.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.errors import DataError

STATES = ("observations", "obs", "observation", "observation.state", "states", "state")
REWARDS = ("rewards", "rews", "reward", "next.reward")
TERMINATED = ("terminals", "terminations", "terminated", "terminal")
TRUNCATED = ("timeouts", "truncations", "truncated")

OURS = "oodil_"
"""How what an export adds is called; what an earlier one added goes when new comes."""

Keys = tuple[str, ...]
"""Which entries make up a state, in this order; empty where there is no choice."""


def find(tree: Any, path: str) -> Any:
    """Return the entry at a path, or None where there is none."""
    if isinstance(tree, tuple):
        tree = {str(i): part for i, part in enumerate(tree)}
    if not isinstance(tree, Mapping):
        return None
    if path in tree:
        return tree[path]
    head, _, rest = path.partition("/")
    return find(tree[head], rest) if rest and head in tree else None


def first(tree: Mapping[str, Any], names: Sequence[str]) -> str | None:
    """Return the first of the names that a mapping has an entry for."""
    return next((name for name in names if name in tree), None)


def leaves(tree: Any, prefix: str = "") -> Iterator[str]:
    """Yield the paths of all arrays below a mapping or tuple."""
    parts = enumerate(tree) if isinstance(tree, tuple) else ((name, tree[name]) for name in tree)
    for name, part in parts:
        if isinstance(part, Mapping | tuple):
            yield from leaves(part, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}"


def state_paths(tree: Mapping[str, Any], keys: Keys) -> list[str]:
    """Return the paths of the entries that make up a state; keys may leave out ``obs/`` and the like.

    Raises DataError, naming the entries there are, for keys that are none and for a choice that was not made.
    """
    container = first(tree, STATES)
    observations = tree[container] if container else None
    nested = isinstance(observations, Mapping | tuple)
    if keys:
        return [_state_path(tree, container if nested else None, key) for key in keys]
    if container is None:
        raise DataError(f"has no entry {', '.join(STATES)}; choose with --keys of {_listed(tree)}")
    if not nested:
        return [container]
    found = list(leaves(observations))
    if len(found) > 1 and not _in_order(observations):
        raise DataError(f"observations have entries {', '.join(sorted(found))}; choose with --keys")
    return [f"{container}/{path}" for path in found]


def _state_path(tree: Mapping[str, Any], container: str | None, key: str) -> str:
    inside = None if container is None else find(tree[container], key)
    chosen = find(tree, key) if inside is None else inside
    if chosen is None:
        known = f"observations have no entry {key!r}; there are" if container else f"has no entry {key!r}, only"
        raise DataError(f"{known} {_listed(tree[container] if container else tree)}")
    if isinstance(chosen, Mapping | tuple):
        raise DataError(f"entry {key!r} has entries itself; choose of {', '.join(leaves(chosen, f'{key}/'))}")
    return key if inside is None else f"{container}/{key}"


def _in_order(tree: Any) -> bool:
    """Return whether there is only one order of the arrays in a tree: that of tuples."""
    return isinstance(tree, tuple) and all(_in_order(part) for part in tree if isinstance(part, Mapping | tuple))


def _listed(tree: Any) -> str:
    found = sorted(leaves(tree)) or ["nothing"]
    return ", ".join(found[:20]) + (f" and {len(found) - 20} more" if len(found) > 20 else "")


def numbers(value: Any, name: str) -> NDArray[Any]:
    """Return an array of real numbers. Raises DataError for anything else."""
    array = np.asarray(value)
    if array.dtype == object and array.ndim == 1 and len(array):
        array = np.stack([np.asarray(row) for row in array])
    if array.dtype.kind not in "biuf":
        raise DataError(f"entry {name!r} holds {array.dtype}, not real numbers")
    return array


def flat(array: NDArray[Any]) -> NDArray[Any]:
    """Return (T, S) numbers; what a state holds besides is flattened as an observation is in training."""
    return array.reshape(len(array), math.prod(array.shape[1:])) if array.ndim else array


def joined(tree: Any, paths: Sequence[str]) -> NDArray[Any]:
    """Return (T, S) the entries at some paths side by side. Raises DataError when they differ in length."""
    parts = []
    for path in paths:
        value = find(tree, path)
        if value is None:
            raise DataError(f"has no entry {path!r}, only {_listed(tree)}")
        parts.append(flat(numbers(value, path)))
        if parts[-1].shape[:1] != parts[0].shape[:1]:
            raise DataError(f"entry {path!r} has {len(parts[-1])} rows, {paths[0]!r} has {len(parts[0])}")
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


def next_paths(tree: Any, paths: Sequence[str]) -> list[str]:
    """Return the paths of the states that follow, called ``next_...``; empty unless all are there.

    What is ``obs`` may be followed by ``next_observations``, but not by ``next_states``, which are something else.
    """
    head = paths[0].partition("/")[0]
    for name in (head, *(each for each in STATES if head in STATES and each[:3] == head[:3])):
        called = [name + path.removeprefix(head) if path.startswith(head) else path for path in paths]
        following = [f"next_{path}" for path in called]
        if all(find(tree, path) is not None for path in following):
            return following
    return []
