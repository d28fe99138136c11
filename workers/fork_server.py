"""The fork server: a small process from which all children are forked; the only file that starts processes.

It has what jobs compute with loaded already, so that a child runs in milliseconds instead of seconds and shares the
memory of the libraries. It computes nothing itself, has one thread, and knows nothing of the caller's ``__main__``: a
script without a guard, a thread and a notebook can all start children. What travels to it is JSON and file descriptors.

For each child there is a pipe on which the server writes the child's process id and, when it has ended, its exit
code. Children die with the server and the server with its parent, each by the end of a pipe.
"""

import atexit
import contextlib
import gc
import importlib
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from multiprocessing import connection
from typing import IO, Any

from oodil.workers.threads import ONE_THREAD

Connection = connection.Connection
wait = connection.wait

IDLE_S = 60.0
"""A server without children ends after this long without a request; the next request starts another one."""
LOST = 1_000
"""The exit code of a child whose server died; no process can end with it."""
_NUMBER = struct.Struct("!q")
_KILLED_WITHIN_S = 10.0

Main = Callable[..., None]
"""What a child runs, a function at the top of a module: called with the file descriptors of its link and of the pipe
that ends with the server, and with JSON values by name."""


class ForkServerError(RuntimeError):
    """The fork server did not start; the message has its output."""


class Process:
    """A child, as its parent sees it; it may still be about to start."""

    def __init__(self, server: "ForkServer", link: Connection, status: int) -> None:
        self.link = link
        self.exit_code: int | None = None
        """How it ended: negative for a signal, LOST when its server died first; None while it runs."""
        self.pid: int | None = None
        """None until the server has forked it."""
        self._server = server
        self._status = status

    def fileno(self) -> int:
        """Return what becomes readable when the child starts and when it ends."""
        return self._status

    def poll(self) -> int | None:
        """Return the exit code of a child that has ended, else None."""
        while self.exit_code is None and wait([self._status], 0.0):
            content = os.read(self._status, _NUMBER.size)
            if len(content) < _NUMBER.size:
                self._end_orphan()
            elif self.pid is None:
                (self.pid,) = _NUMBER.unpack(content)
            else:
                (self.exit_code,) = _NUMBER.unpack(content)
        return self.exit_code

    def describe_end(self) -> str:
        """Say how a child ended that has."""
        assert self.exit_code is not None
        if self.exit_code == LOST:
            output = self._server.output()
            return "its fork server died" + (f": {output}" if output else "")
        if self.exit_code >= 0:
            return f"ended with exit code {self.exit_code} before it was done"
        try:
            return f"killed by {signal.Signals(-self.exit_code).name}"
        except ValueError:
            return f"killed by signal {-self.exit_code}"

    def signal(self, number: int) -> None:
        """Send a signal, if the child runs."""
        if self.poll() is not None:
            return
        if self.pid is None:
            # It cannot be signaled yet; without its server it will never start. Others of the server are lost as well.
            self._server.kill()
        else:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def join(self, timeout_s: float) -> int | None:
        """Wait for the end; return the exit code, or None when the time is over before."""
        deadline = time.monotonic() + timeout_s
        while self.poll() is None and time.monotonic() < deadline:
            wait([self._status], max(0.0, deadline - time.monotonic()))
        return self.exit_code

    def close(self) -> None:
        """Close its pipes; without its link a child that still runs ends itself."""
        self.link.close()
        os.close(self._status)

    def _end_orphan(self) -> None:
        """The server is gone and nobody waits for the child: make sure that it is gone as well.

        The kernel closes the child's end of the link when the child ends, so as long as that is open the process id is
        still its own.
        """
        deadline = time.monotonic() + _KILLED_WITHIN_S
        while not self._is_link_closed(0.0) and time.monotonic() < deadline:
            if self.pid is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(self.pid, signal.SIGKILL)
            self._is_link_closed(0.05)
        self.exit_code = LOST

    def _is_link_closed(self, timeout_s: float) -> bool:
        # Only whether the other end is open is asked for; what the child said stays there to be read.
        poll = select.poll()
        poll.register(self.link.fileno(), 0)
        return bool(poll.poll(1000 * timeout_s))


class ForkServer:
    """The parent's side of a fork server that imports the modules of ``preload`` before it forks.

    The server is started by the first `start` and stays for the next until it has been idle for `IDLE_S`. Use one
    object per process and preload (`fork_server`); it may be used from any thread.
    """

    def __init__(self, preload: tuple[str, ...]) -> None:
        # macOS does not allow most of its libraries to be used after a fork.
        self._preload = preload if sys.platform == "linux" else ()
        self._lock = threading.Lock()
        self._owner = 0
        self._socket: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._output: IO[bytes] | None = None

    @property
    def pid(self) -> int | None:
        """The process id of the server; None before the first start."""
        return self._process.pid if self._process else None

    def start(self, main: Main, arguments: dict[str, Any]) -> Process:
        """Start a child in the environment, folder and module path that this process has now.

        Raises ForkServerError when there is no server and none can be started.
        """
        request = {
            "main": f"{main.__module__}:{main.__qualname__}",
            "arguments": arguments,
            "environment": os.environ.copy() | ONE_THREAD,
            "path": _module_path(),
            "folder": os.getcwd(),
        }
        content = json.dumps(request).encode()
        with self._lock:
            for _ in range(3):
                link, childs_end = connection.Pipe()
                status, servers_end = os.pipe()
                try:
                    self._send(content, [childs_end.fileno(), servers_end])
                except OSError:
                    link.close()
                    os.close(status)
                    self._forget()
                else:
                    return Process(self, link, status)
                finally:
                    childs_end.close()
                    os.close(servers_end)
        raise ForkServerError(f"the fork server does not start: {self.output()}")

    def kill(self) -> None:
        """End the server and all its children at once."""
        with self._lock:
            self._forget()

    def _send(self, content: bytes, descriptors: list[int]) -> None:
        if self._socket is None or self._owner != os.getpid():
            self._launch()
        assert self._socket is not None
        socket.send_fds(self._socket, [b"!"], descriptors)
        self._socket.sendall(_NUMBER.pack(len(content)) + content)
        # A server that ended itself just before may have left the connection behind.
        if self._process is not None and self._process.poll() is not None:
            raise BrokenPipeError

    def _launch(self) -> None:
        ours, theirs = socket.socketpair()
        code = (
            f"import sys; sys.path[:] = {_module_path()!r}\n"
            f"from {__name__} import serve; serve({theirs.fileno()}, {self._preload!r}, {IDLE_S!r})"
        )
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the server
        # A terminal sends Ctrl-C to the server as well; until it can say that it ignores it, it is blocked.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code],
                env=os.environ | ONE_THREAD,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=self._output,
                stderr=self._output,
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            theirs.close()
        self._socket, self._owner = ours, os.getpid()

    def _forget(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._process is not None and self._owner == os.getpid():
            self._process.kill()
            self._process.wait()
        self._process = None

    def output(self) -> str:
        """Return the last that the server printed, which it does only when something is wrong with it."""
        if self._output is None:
            return ""
        self._output.seek(0)
        return self._output.read()[-2000:].decode(errors="replace").strip()


_servers: dict[tuple[str, ...], ForkServer] = {}
_servers_lock = threading.Lock()


def fork_server(preload: tuple[str, ...]) -> ForkServer:
    """Return this process's fork server with some modules loaded."""
    with _servers_lock:
        return _servers.setdefault(preload, ForkServer(preload))


def started() -> list[ForkServer]:
    """Return the fork servers of this process."""
    return list(_servers.values())


@atexit.register
def end_fork_servers() -> None:
    """End all fork servers of this process, and with them all their children."""
    for server in started():
        server.kill()


def _module_path() -> list[str]:
    return [os.path.abspath(entry) for entry in sys.path]


# --- in the server ------------------------------------------------------------------------------------------------


def serve(descriptor: int, preload: tuple[str, ...], idle_s: float) -> None:
    """Fork a child for each request until the parent is gone or there is nothing to do; returns in no process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    for module in preload:
        # What cannot be imported will say so in the child that needs it.
        with contextlib.suppress(Exception):
            importlib.import_module(module)
    # Nothing of what is loaded will ever be garbage; looking for it would copy the pages that children share.
    gc.collect()
    gc.freeze()
    try:
        _Server(descriptor, idle_s).run()
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(0)


class _Server:
    def __init__(self, descriptor: int, idle_s: float) -> None:
        self._requests = socket.socket(fileno=descriptor)
        self._idle_s = idle_s
        self._status: dict[int, int] = {}
        """The pipe of each child, by process id."""
        self._wake_up, servers_end = os.pipe()
        os.set_blocking(servers_end, False)
        signal.set_wakeup_fd(servers_end, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda number, frame: None)
        self._alive, held = os.pipe()
        """Ends with the server, which alone holds the other end."""
        self._own = (self._wake_up, servers_end, held)

    def run(self) -> None:
        """Serve; at the end no child is left."""
        try:
            while True:
                timeout_s = None if self._status else self._idle_s
                watched: list[Any] = [self._requests, self._wake_up]
                readable, _, _ = select.select(watched, [], [], timeout_s)
                if self._wake_up in readable:
                    os.read(self._wake_up, 4096)
                    self._reap()
                if self._requests in readable and not self._answer():
                    return
                if not readable:
                    # From here on the parent cannot send; a request at this very moment is lost like a killed child.
                    self._requests.shutdown(socket.SHUT_RD)
                    return
        finally:
            for pid in self._status:
                os.kill(pid, signal.SIGKILL)

    def _answer(self) -> bool:
        """Fork one child; return whether the parent is still there."""
        mark, descriptors, _, _ = socket.recv_fds(self._requests, 1, 2)
        header = self._receive(_NUMBER.size) if mark else b""
        content = self._receive(_NUMBER.unpack(header)[0]) if header else b""
        if not content:
            return False
        link, status = descriptors
        for descriptor in descriptors:
            os.set_inheritable(descriptor, False)
        pid = os.fork()
        if pid == 0:
            self._become_child(link, status, json.loads(content))
        os.close(link)
        self._status[pid] = status
        self._write(status, pid)
        return True

    def _receive(self, size: int) -> bytes:
        content = b""
        while len(content) < size:
            part = self._requests.recv(size - len(content))
            if not part:
                return b""
            content += part
        return content

    def _become_child(self, link: int, status: int, request: dict[str, Any]) -> None:
        try:
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            self._requests.close()
            for descriptor in (*self._own, *self._status.values(), status):
                os.close(descriptor)
            os.environ.clear()
            os.environ.update(request["environment"])
            sys.path[:] = request["path"]
            os.chdir(request["folder"])
            module, _, function = request["main"].partition(":")
            getattr(importlib.import_module(module), function)(link, self._alive, **request["arguments"])
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(1)

    def _reap(self) -> None:
        while self._status:
            pid, how = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return
            status = self._status.pop(pid)
            self._write(status, os.waitstatus_to_exitcode(how))
            os.close(status)

    def _write(self, status: int, number: int) -> None:
        # The parent may have lost interest, or be gone.
        with contextlib.suppress(BrokenPipeError):
            os.write(status, _NUMBER.pack(number))
