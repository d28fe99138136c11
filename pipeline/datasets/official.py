"""Demonstrations in pickles, as of the method's released code; the only file that may read any.

A pickle is a program. This reader runs only what rebuilds NumPy arrays and plain containers, and refuses the rest, but
a file from somebody you do not trust is still better left alone. It is reached by ``oodil demos convert`` and
``oodil score`` alone.
"""

import pickle
from collections import OrderedDict, defaultdict, deque
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.errors import DataError


def _latin1(text: str, encoding: str) -> bytes:
    """Return the bytes that pickles before protocol 3 hold as text."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"it holds bytes as {encoding}")
    return text.encode("latin1")


_PLAIN: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): OrderedDict,
    ("collections", "defaultdict"): defaultdict,
    ("collections", "deque"): deque,
    ("builtins", "list"): list,
    ("builtins", "dict"): dict,
    ("builtins", "int"): int,
    ("builtins", "float"): float,
    ("builtins", "bytearray"): bytearray,
    ("_codecs", "encode"): _latin1,
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}
_NUMPY = {
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),  # Protocol 5.
}


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        # As they were called before NumPy 2 and Python 3.
        own = module.replace("numpy.core.", "numpy._core.").replace("__builtin__", "builtins")
        if (own, name) in _PLAIN:
            return _PLAIN[own, name]
        if (own, name) in _NUMPY:
            return super().find_class(own, name)
        raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is neither an array nor a container")


def read(path: Path) -> Any:
    """Return what a pickle holds: arrays and plain containers. Raises DataError."""
    try:
        with open(path, "rb") as file:
            return _ArraysOnly(file, encoding="latin1").load()
    except Exception as error:  # a damaged pickle raises whatever it likes
        raise DataError(f"not a pickle of demonstrations ({error})") from error


def read_objects(file: IO[bytes]) -> NDArray[Any]:
    """Return an array of objects, which NumPy keeps as a pickle, from an open .npy. Raises DataError."""
    try:
        version = np.lib.format.read_magic(file)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, _ = header(file)
        objects: NDArray[Any] = _ArraysOnly(file, encoding="latin1").load()
        return objects.reshape(shape)
    except Exception as error:  # a damaged pickle raises whatever it likes
        raise DataError(f"not an array of arrays ({error})") from error
