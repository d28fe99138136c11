"""Files that one process at a time can hold; what is held goes with the process, however it ends."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from oodil.pipeline.errors import StorageError


@contextmanager
def held(path: Path) -> Iterator[bool]:
    """Hold a file for this process unless another one does; what is yielded says whether it is held."""
    try:
        file = open(path, "w")  # noqa: SIM115 (closed below, after what it protects)
    except OSError as error:
        raise StorageError(f"{path.parent}: {error.strerror or error}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
            return
        yield True
