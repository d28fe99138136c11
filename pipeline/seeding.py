"""One root seed; every random stream is named by what it is for.

A key is the root seed followed by a path such as ``("rollout", group, iteration)``. Equal keys give equal
streams in any process, so no generator state has to be stored or sent.
"""

import zlib

import numpy as np

Key = tuple[int, ...]


def derive_key(root_seed: int, *path: str | int) -> Key:
    """Return the key of the stream that ``path`` names below ``root_seed``."""
    return (root_seed, *(zlib.crc32(part.encode()) if isinstance(part, str) else part for part in path))


def numpy_rng(key: Key) -> np.random.Generator:
    """Return a fresh generator for a key; the same key always starts the same stream."""
    return np.random.Generator(np.random.PCG64(_sequence(key)))


def torch_seed(key: Key) -> int:
    """Return a 63-bit seed for ``torch.Generator.manual_seed``."""
    return int(_sequence(key).generate_state(1, np.uint64)[0] >> 1)


def _sequence(key: Key) -> np.random.SeedSequence:
    # As entropy, NumPy would pad the key with zeros, and a path would share its stream with the same path and a zero.
    return np.random.SeedSequence(key[0], spawn_key=key[1:])
