"""Key files for learners that workers on other machines may join.

A folder of keys belongs to one lab: the learner's own pair, and under ``allowed/`` the public key of every worker that
may join. A worker gets a folder of its own to be copied to its machine: its pair, and the learner's public key. Keys
are 40 characters in ZeroMQ's Z85 encoding; secret ones are readable by their owner alone.
"""

import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from oodil.pipeline.errors import OodilError

LEARNER, WORKER = "learner", "worker"
_LENGTH = 40


class KeysError(OodilError):
    """Keys that are missing, malformed or open to others; the message names the file."""


@dataclass(frozen=True)
class KeyPair:
    """A public and a secret key."""

    public: bytes
    secret: bytes


@dataclass(frozen=True)
class ServerKeys:
    """What a learner needs: its own pair, and the public keys of the workers that may join."""

    own: KeyPair
    allowed: frozenset[bytes]


@dataclass(frozen=True)
class ClientKeys:
    """What a worker needs: its own pair, and the public key of the learner."""

    own: KeyPair
    server: bytes


def create_learner_keys(folder: Path, new_pair: Callable[[], KeyPair]) -> None:
    """Create the learner's pair. Raises KeysError when there is one, which workers rely on, or no place."""
    if (folder / f"{LEARNER}.secret").exists():
        raise KeysError(f"{folder}: already has a learner's keys; add a worker with --worker NAME")
    with _written():
        (folder / "allowed").mkdir(parents=True, exist_ok=True)
        _write_pair(folder, LEARNER, new_pair())


def create_worker_keys(folder: Path, name: str, new_pair: Callable[[], KeyPair]) -> Path:
    """Create the pair of a worker, allow it, and return the folder to copy to the worker's machine.

    Raises KeysError when the learner has no keys, or when the name is taken or not a plain one.
    """
    if not name.replace("-", "").replace("_", "").isalnum() or name == "allowed":
        raise KeysError(f"worker name {name!r}: use letters, digits, - and _")
    server = _read(folder / f"{LEARNER}.public")
    own = folder / name
    if own.exists():
        raise KeysError(f"{own}: is there already")
    with _written():
        own.mkdir(mode=0o700)
        pair = new_pair()
        _write_pair(own, WORKER, pair)
        (own / f"{LEARNER}.public").write_bytes(server)
        (folder / "allowed" / f"{name}.public").write_bytes(pair.public)
    return own


def server_keys(folder: Path) -> ServerKeys:
    """Read what a learner needs; its own workers use its own pair. Raises KeysError."""
    own = _read_pair(folder, LEARNER)
    allowed = {_read(file) for file in sorted((folder / "allowed").glob("*.public"))}
    return ServerKeys(own, frozenset({own.public, *allowed}))


def client_keys(folder: Path) -> ClientKeys:
    """Read what a worker needs, from its own folder or, beside the learner, from the learner's. Raises KeysError."""
    role = WORKER if (folder / f"{WORKER}.secret").exists() else LEARNER
    return ClientKeys(_read_pair(folder, role), _read(folder / f"{LEARNER}.public"))


@contextmanager
def _written() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise KeysError(f"{error.filename}: {error.strerror}") from error


def _write_pair(folder: Path, name: str, pair: KeyPair) -> None:
    descriptor = os.open(folder / f"{name}.secret", os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with open(descriptor, "wb") as file:
        file.write(pair.secret)
    (folder / f"{name}.public").write_bytes(pair.public)


def _read_pair(folder: Path, name: str) -> KeyPair:
    secret = folder / f"{name}.secret"
    key = _read(secret)
    if stat.S_IMODE(secret.stat().st_mode) & 0o077:
        raise KeysError(f"{secret}: others may read this secret key; chmod 600 it, or make new keys")
    return KeyPair(_read(folder / f"{name}.public"), key)


def _read(file: Path) -> bytes:
    try:
        key = file.read_bytes().strip()
    except OSError as error:
        raise KeysError(f"{file}: {error.strerror}; `oodil keys new` makes keys") from error
    if len(key) != _LENGTH or not key.isascii():
        raise KeysError(f"{file}: is no key, which has {_LENGTH} characters")
    return key
