"""One compute thread for whoever runs a job or collects, so that the bits do not depend on the caller's settings."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import threadpool_limits

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""For libraries that are yet to be loaded; they read it once."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch, BLAS and OpenMP compute with one thread in this process, and as before when it ends.

    It holds for libraries that are loaded meanwhile, too; those keep their one thread. torch itself is loaded here.
    """
    import torch

    before = {name: os.environ.get(name) for name in ONE_THREAD}
    torch_threads = torch.get_num_threads()
    os.environ.update(ONE_THREAD)
    try:
        with threadpool_limits(1):
            torch.set_num_threads(1)
            yield
    finally:
        torch.set_num_threads(torch_threads)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@cache
def limit_this_process() -> None:
    """Let this process, which does nothing else, compute with one thread until it ends."""
    os.environ.update(ONE_THREAD)
    threadpool_limits(1)
