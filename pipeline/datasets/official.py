"""Demonstrations of the method's released code, which are pickles; the only file that may read any.

A pickle is a program. This reader runs only what rebuilds NumPy arrays and plain containers, and refuses the rest, but
a file from somebody you do not trust is still better left alone. It is reached by ``oodil demos convert`` alone.
"""

import pickle
from pathlib import Path
from typing import Any

import numpy as np

from oodil.pipeline.data import Episode
from oodil.pipeline.errors import DataError

_ALLOWED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("collections", "OrderedDict"),
}
_STATES = ("obs", "observations", "states")


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is neither an array nor a container")


def read(path: Path) -> list[Episode]:
    """Return the episodes of a pickle: a list of (T, S) arrays, or a dictionary or tuple that holds it.

    In a dictionary the list is called obs, observations or states; in a tuple it comes first, before the actions.
    Raises DataError.
    """
    try:
        with open(path, "rb") as file:
            content = _ArraysOnly(file, encoding="latin1").load()
    except Exception as error:  # a damaged pickle raises whatever it likes
        raise DataError(f"not a pickle of demonstrations ({error})") from error
    if isinstance(content, dict):
        found = [name for name in _STATES if name in content]
        if not found:
            raise DataError(f"has no entry {' or '.join(_STATES)}, only {', '.join(map(str, content))}")
        content = content[found[0]]
    elif isinstance(content, tuple):
        content = content[0]
    if not isinstance(content, list | np.ndarray) or not len(content):
        raise DataError(f"holds {type(content).__name__}, not a list of arrays")
    try:
        return [Episode(np.asarray(states, np.float64)) for states in content]
    except (TypeError, ValueError) as error:
        raise DataError(f"holds something that is no array of states ({error})") from error
