"""The sockets between the learner and its rollout workers; the only file that knows ZeroMQ.

The learner binds a ROUTER and every worker connects a DEALER, so workers come and go as they like and the learner
answers each by its name. By default both ends are on this machine: the socket lies in a folder that only this user may
enter. For workers on other machines the same socket also listens on an address, and then every peer, local ones
included, must prove with CURVE that it holds a key that is allowed (`oodil.workers.keys`). Every wait has a
deadline, queues are bounded, and closing drops what was not sent, so nothing here can hang.
"""

import hashlib
import logging
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import zmq
from zmq.auth.thread import ThreadAuthenticator

from oodil.pipeline.errors import OodilError
from oodil.workers.keys import KeyPair, KeysError, client_keys, server_keys
from oodil.workers.messages import MAX_FRAME_BYTES

_QUEUE_LIMIT = 64
"""Messages waiting per peer and direction; a worker holds two units, so only a defect reaches it."""
_SOCKET = "learner"
_MAX_PATH = 100
"""Operating systems allow 104 (macOS) to 108 (Linux) bytes for the path of a socket."""
_BATCH = 64
"""Messages that the learner takes in before it looks at anything else."""
_HEARTBEAT_MS, _HEARTBEAT_TIMEOUT_MS = 2_000, 10_000
"""How soon a connection that was cut without a word is given up; a worker connects again by itself."""


_DOMAIN = "oodil"
"""Of ZeroMQ's authentication protocol; nothing else shares our context."""


@dataclass(frozen=True)
class Access:
    """How workers on other machines reach a learner."""

    address: str
    """Such as ``tcp://0.0.0.0:5555``."""
    keys: Path
    """The folder of the learner's keys and of the allowed ones."""


class EndpointError(OodilError):
    """The folder for the socket cannot be used."""


class AddressError(OodilError):
    """Nothing can listen on an address; the message says why."""


def endpoint_folder(run_path: Path) -> Path:
    """Return the folder of a run's socket; the same run has the same folder, so a resumed run clears what was left."""
    digest = hashlib.sha256(str(run_path.absolute()).encode()).hexdigest()[:12]
    return Path(tempfile.gettempdir()) / f"oodil-{os.getuid()}-{digest}"


def refuse_long_path(run_path: Path) -> None:
    """Raise EndpointError if the path of a run's socket would be too long; it is as long for every run."""
    socket = endpoint_folder(run_path) / _SOCKET
    if len(os.fsencode(socket)) > _MAX_PATH:
        raise EndpointError(f"{socket} is too long for a socket; set TMPDIR to a folder with a shorter path")


@contextmanager
def private_endpoint(run_path: Path) -> Iterator[str]:
    """Make the folder of a run's socket, empty and closed to other users, and remove it at the end.

    Raises EndpointError if something else is there, or if the path is too long for a socket.
    """
    refuse_long_path(run_path)
    folder = endpoint_folder(run_path)
    socket = folder / _SOCKET
    _remove(folder)
    folder.mkdir(mode=0o700)
    try:
        yield f"ipc://{socket}"
    finally:
        _remove(folder)


def _remove(folder: Path) -> None:
    try:
        status = folder.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
        raise EndpointError(f"{folder} is not a private folder of this user; remove it or set TMPDIR")
    shutil.rmtree(folder)


class _Socket:
    def __init__(self, kind: int) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(kind)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, _QUEUE_LIMIT)
        self._socket.setsockopt(zmq.RCVHWM, _QUEUE_LIMIT)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_FRAME_BYTES)
        self._socket.setsockopt(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
        self._socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, _HEARTBEAT_TIMEOUT_MS)

    def close(self) -> None:
        """Close at once, dropping what was not sent."""
        self._context.destroy(linger=0)


class Router(_Socket):
    """The learner's end. One thread uses it; only `wake` may be called from others."""

    def __init__(self, endpoint: str, access: Access | None = None) -> None:
        """Bind the endpoint, and the address of ``access`` too; then only peers with an allowed key get in."""
        super().__init__(zmq.ROUTER)
        # Without it, what is sent to a worker that is gone disappears without a word.
        self._socket.setsockopt(zmq.ROUTER_MANDATORY, 1)
        # A worker that connects again before its old connection is given up takes its name over.
        self._socket.setsockopt(zmq.ROUTER_HANDOVER, 1)
        self._authenticator: ThreadAuthenticator | None = None
        if access is not None:
            own = server_keys(access.keys).own
            # Before the first bind: until somebody answers for the domain, nobody is let in.
            self._authenticator = _authenticator(self._context, access.keys)
            self._socket.curve_secretkey, self._socket.curve_publickey = own.secret, own.public
            self._socket.curve_server = True
            self._socket.zap_domain = _DOMAIN.encode()
            self._socket.bind(access.address)
        self._socket.bind(endpoint)
        self._wake_reader, self._wake_writer = os.pipe()
        os.set_blocking(self._wake_reader, False)
        os.set_blocking(self._wake_writer, False)
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._poller.register(self._wake_reader, zmq.POLLIN)

    def receive(self, timeout_s: float) -> list[tuple[str, list[bytes]]]:
        """Wait for messages, `wake` or the deadline; return what is there as (name of the worker, frames)."""
        self._poller.poll(round(timeout_s * 1000))
        with suppress(BlockingIOError):
            os.read(self._wake_reader, 4096)
        messages: list[tuple[str, list[bytes]]] = []
        while len(messages) < _BATCH:
            try:
                name, *frames = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                break
            messages.append((name.decode("ascii", "replace"), frames))
        return messages

    def send(self, worker: str, frames: Sequence[bytes]) -> bool:
        """Send to a worker; return whether it is there and its queue took it."""
        try:
            self._socket.send_multipart([worker.encode(), *frames], zmq.NOBLOCK)
        except zmq.ZMQError as error:
            if error.errno in (zmq.EHOSTUNREACH, zmq.EAGAIN):
                return False
            raise
        return True

    def wake(self) -> None:
        """Let `receive` return now; callable from any thread until the socket is closed."""
        with suppress(BlockingIOError):
            os.write(self._wake_writer, b"\0")

    def close(self) -> None:
        """Close at once, dropping what was not sent."""
        if self._authenticator is not None:
            self._authenticator.stop()
        super().close()
        os.close(self._wake_reader)
        os.close(self._wake_writer)


class Dealer(_Socket):
    """A rollout worker's end; it connects again by itself when a learner is replaced."""

    def __init__(self, endpoint: str, name: str, keys_folder: Path | None = None) -> None:
        super().__init__(zmq.DEALER)
        if keys_folder is not None:
            keys = client_keys(keys_folder)
            self._socket.curve_secretkey, self._socket.curve_publickey = keys.own.secret, keys.own.public
            self._socket.curve_serverkey = keys.server
        self._socket.setsockopt(zmq.IDENTITY, name.encode())
        self._socket.setsockopt(zmq.RECONNECT_IVL, 50)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, 500)
        self._socket.connect(endpoint)

    def receive(self, timeout_s: float) -> list[bytes] | None:
        """Return the frames of the next message, or None when the deadline passes first."""
        return self._socket.recv_multipart() if self._socket.poll(round(timeout_s * 1000)) else None

    def send(self, frames: Sequence[bytes]) -> bool:
        """Send to the learner; return whether the queue took it. What it did not take, nobody waits for any more."""
        try:
            self._socket.send_multipart(list(frames), zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True


def new_key_pair() -> KeyPair:
    """Return a fresh CURVE key pair."""
    public, secret = zmq.curve_keypair()
    return KeyPair(public, secret)


def check_address(address: str) -> None:
    """Raise AddressError for an address that no worker can connect to, whether or not a learner is there."""
    with _trial(zmq.DEALER, f"connect to {address!r}, which is no tcp://HOST:PORT") as socket:
        socket.connect(address)


def open_access(address: str | None, keys: Path | None) -> Access | None:
    """Return where other machines may join, or None when nothing was asked for.

    Raises AddressError or KeysError without keys, with malformed ones, or if nothing can listen there now.
    """
    if address is None and keys is None:
        return None
    if address is None or keys is None:
        raise KeysError("--bind and --keys belong together: nobody joins a run without a key (`oodil keys new`)")
    server_keys(keys)
    with _trial(zmq.ROUTER, f"listen on {address}") as socket:
        socket.bind(address)
    return Access(address, keys)


@contextmanager
def _trial(kind: int, what: str) -> Iterator[zmq.Socket[bytes]]:
    """Open a socket to see whether an address can be used, and close it again. Raises AddressError if it cannot."""
    context = zmq.Context()
    try:
        yield context.socket(kind)
    except zmq.ZMQError as error:
        raise AddressError(f"cannot {what}: {error.strerror}") from error
    finally:
        context.destroy(linger=0)


def _authenticator(context: zmq.Context, keys: Path) -> ThreadAuthenticator:
    """Start the thread that ZeroMQ asks about every peer; only keys that are listed at that moment are let in."""

    class AllowList:
        def callback(self, domain: str, key: bytes) -> bool:
            try:
                return key in server_keys(keys).allowed
            except KeysError as error:
                logging.warning("nobody is let in: %s", error)
                return False

    authenticator = ThreadAuthenticator(context)
    authenticator.start()
    authenticator.configure_curve_callback(_DOMAIN, AllowList())
    return authenticator
