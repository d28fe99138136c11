"""The project's own file of demonstrations: safetensors, with a schema version and the labels in its header."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from oodil.pipeline.data import Demonstrations
from oodil.pipeline.errors import DataError

SCHEMA = "1"
_HEADER = "oodil"
_DTYPES = {
    "observations": np.float32,
    "offsets": np.int64,
    "sources": np.int32,
    "returns": np.float64,
    "terminated": np.bool_,
}


def encode_demonstrations(demonstrations: Demonstrations, environment_id: str) -> bytes:
    """Return the file's bytes."""
    arrays = {name: np.ascontiguousarray(getattr(demonstrations, name)) for name in _DTYPES}
    header: dict[str, Any] = {
        "schema": SCHEMA,
        "environment": environment_id,
        "source_labels": list(demonstrations.source_labels),
    }
    if any(demonstrations.source_keys):
        header["source_keys"] = demonstrations.source_keys
    # One entry only: safetensors writes several in no fixed order, and equal sets must be equal files.
    return safetensors.numpy.save(arrays, metadata={_HEADER: json.dumps(header)})


def read_demonstrations(path: str | Path) -> tuple[Demonstrations, str]:
    """Return the demonstrations of a file and the id of the environment they are from.

    ``observations`` and ``offsets`` are required; without ``sources`` all are from one source, without ``terminated``
    none ended in failure. Raises DataError that names the file and what is wrong with it.
    """
    return decode_demonstrations(read_file(Path(path)), str(path))


def read_file(path: Path) -> bytes:
    """Return the bytes of a file. Raises DataError that names it."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: {error.strerror or error}") from error


def decode_demonstrations(content: bytes, origin: str) -> tuple[Demonstrations, str]:
    """Return what `read_demonstrations` does, from bytes; ``origin`` is named in errors."""
    try:
        header_size = int.from_bytes(content[:8], "little")
        metadata = json.loads(content[8 : 8 + header_size]).get("__metadata__", {})
        arrays = safetensors.numpy.load(content)
        header = {"schema": SCHEMA, "environment": "", "source_labels": ["demonstrations"]}
        header |= json.loads(metadata.get(_HEADER, "{}"))
        keys = tuple(tuple(each) for each in header.get("source_keys", ()))
    except (safetensors.SafetensorError, ValueError, AttributeError, TypeError) as error:
        if not origin.endswith(".safetensors"):
            raise DataError(f"{origin}: is no file of ours; oodil demos convert makes one of it") from error
        raise DataError(f"{origin}: not a sound safetensors file, truncated perhaps ({error})") from error
    if header["schema"] != SCHEMA:
        raise DataError(f"{origin}: schema {header['schema']}; this version reads schema {SCHEMA}")
    for name in ("observations", "offsets"):
        if name not in arrays:
            raise DataError(f"{origin}: has no array {name!r}")
    count = max(len(arrays["offsets"]) - 1, 0)
    arrays.setdefault("sources", np.zeros(count, np.int32))
    arrays.setdefault("returns", np.full(count, np.nan))
    arrays.setdefault("terminated", np.zeros(count, np.bool_))
    for name, dtype in _DTYPES.items():
        if arrays[name].dtype != dtype:
            raise DataError(f"{origin}: array {name!r} is {arrays[name].dtype}; expected {np.dtype(dtype)}")
    try:
        parts = {name: arrays[name] for name in _DTYPES}
        demonstrations = Demonstrations(source_labels=tuple(header["source_labels"]), source_keys=keys, **parts)
    except DataError as error:
        raise DataError(f"{origin}: {error}") from error
    return demonstrations, str(header["environment"])
