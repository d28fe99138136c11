"""Child processes: watching and ending them; `oodil.workers.fork_server` starts them.

Parent and child share a pipe that carries encoded reports and nothing else. The child watches its end: when the parent
is gone, however it died, the pipe closes and the child ends at once, as it does when the fork server is gone. Whether
something is started again is for the caller to decide (`oodil.workers.engine.Attempts`).
"""

import faulthandler
import importlib
import logging
import os
import signal
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from oodil.workers.fork_server import Connection, Process, fork_server, wait
from oodil.workers.reports import Event, Failed, Finished, Report, Started, Stop, decode_report, encode_report, failure
from oodil.workers.wire import MessageError

_MAX_REPORT_BYTES = 1024 * 1024
_TERMINATE_S = 2.0
"""How long a child may take to follow SIGTERM before it is killed."""
_KILL_S = 5.0
"""How long the kernel may take to end a child that is killed."""
_GRACE_S = 5.0
"""How long children may take to end when asked at the end of a run."""

PRELOAD = ("oodil.workers.rollout_worker",)
"""What children have loaded unless told otherwise."""

Main = Callable[..., str]
"""A child's main function, at the top of a module: called with its Link and texts by name; returns its outcome."""


@dataclass
class _Process:
    """One start of a child."""

    process: Process
    log: Path
    last_words: Finished | Failed | None = None

    def say(self, report: Report) -> None:
        with suppress(OSError):  # It may be gone; `poll` will say so.
            self.process.link.send_bytes(encode_report(report))


@dataclass
class _Child:
    """What runs, or is about to."""

    name: str
    attempt: int
    main: Main
    arguments: dict[str, str]
    due: float
    """When to start it, on the monotonic clock, while it is not running."""
    running: _Process | None = None


class Supervisor:
    """The children of one stage. Use it as a context manager: at its end no child is left."""

    def __init__(self, logs: Path, prefix: str, preload: tuple[str, ...] = PRELOAD) -> None:
        self._server = fork_server(preload)
        self._logs = logs
        self._prefix = prefix
        self._children: dict[str, _Child] = {}
        self._attempts: Counter[str] = Counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # An exception here is a second Ctrl-C or a defect: nobody wants to wait.
        self.close(_GRACE_S if error is None else 0.0)

    def start(self, name: str, main: Main, arguments: dict[str, str], delay_s: float = 0.0) -> None:
        """Let a child run; a `poll` starts it once the delay is over. Its log is ``<prefix>-<name>.<attempt>.log``.

        Starts of one name are counted as its attempts, from 1. Raises ValueError while a child of that name is there.
        """
        if name in self._children:
            raise ValueError(f"a child named {name!r} is already there")
        self._attempts[name] += 1
        self._children[name] = _Child(name, self._attempts[name], main, arguments, time.monotonic() + delay_s)

    def poll(self, timeout_s: float) -> list[Event]:
        """Start what is due, wait until something happens or the deadline, and return what happened, in order.

        The last event of a child is `Finished` or `Failed`; then it is not there any more.
        """
        events: list[Event] = []
        waiting = [child for child in self._children.values() if child.running is None]
        for child in waiting:
            if child.due <= time.monotonic():
                self._launch(child)
                events.append(Event(child.name, Started(child.attempt)))
            else:
                timeout_s = min(timeout_s, child.due - time.monotonic())
        self._wait(0.0 if events else max(timeout_s, 0.0))
        for child, running in self._running():
            # Asked in this order, everything that a dead child said has arrived.
            is_dead = running.process.poll() is not None
            events += [Event(child.name, report) for report in _received(running)]
            if is_dead:
                events.append(Event(child.name, self._ended(child, running)))
        return events

    def stop(self, name: str) -> bool:
        """Ask a child to end; return whether it runs, so that its end is still to come. One not yet due is dropped."""
        child = self._children[name]
        if child.running is None:
            del self._children[name]
            return False
        child.running.say(Stop())
        return True

    def kill(self, identity: str) -> None:
        """Kill the child that is named by ``<name>.<attempt>``; other attempts are left alone."""
        for child, running in self._running():
            if f"{child.name}.{child.attempt}" == identity:
                running.process.signal(signal.SIGKILL)

    def close(self, grace_s: float) -> None:
        """End all children: ask, wait, terminate, kill. Bounded, and harmless when repeated."""
        processes = [running for _, running in self._running()]
        try:
            for running in processes:
                running.say(Stop())
            _join(processes, grace_s)
            for running in processes:
                running.process.signal(signal.SIGTERM)
            _join(processes, _TERMINATE_S)
        finally:  # Another Ctrl-C may come meanwhile; none of them may outlive it.
            for running in processes:
                running.process.signal(signal.SIGKILL)
        _join(processes, _KILL_S)
        for running in processes:
            running.process.close()
        self._children.clear()

    def _running(self) -> list[tuple[_Child, _Process]]:
        return [(child, child.running) for child in self._children.values() if child.running is not None]

    def _wait(self, timeout_s: float) -> None:
        running = [running for _, running in self._running()]
        handles: list[Any] = [each.process for each in running] + [each.process.link for each in running]
        # With no child to wait for, wait() returns at once.
        wait(handles, timeout_s) if handles else time.sleep(timeout_s)

    def _launch(self, child: _Child) -> None:
        self._logs.mkdir(parents=True, exist_ok=True)
        log = self._logs / f"{self._prefix}-{child.name}.{child.attempt}.log"
        arguments = {
            "log": str(log),
            "identity": f"{child.name}.{child.attempt}",
            "main": f"{child.main.__module__}:{child.main.__qualname__}",
            "arguments": child.arguments,
        }
        child.running = _Process(self._server.start(_child_main, arguments), log)

    def _ended(self, child: _Child, running: _Process) -> Finished | Failed:
        running.process.close()
        del self._children[child.name]
        return running.last_words or Failed(f"{running.process.describe_end()}; its log is {running.log}")


def _received(running: _Process) -> list[Report]:
    """Return what a child said, and remember its last words."""
    process, reports = running.process, list[Report]()
    try:
        while process.link.poll():
            report = decode_report(process.link.recv_bytes(_MAX_REPORT_BYTES))
            if isinstance(report, Finished | Failed):
                running.last_words = report
            else:
                reports.append(report)
    except (EOFError, OSError):
        # It is just about to end. If it is not, it cannot be supervised any more.
        if process.join(_TERMINATE_S) is None:
            process.signal(signal.SIGKILL)
    except MessageError as error:
        running.last_words = Failed(f"the child sent something that is no report: {error}")
        process.signal(signal.SIGKILL)
    return reports


def _join(processes: list[_Process], timeout_s: float) -> None:
    deadline = time.monotonic() + timeout_s
    for running in processes:
        running.process.join(max(0.0, deadline - time.monotonic()))


class Link:
    """A child's end of the pipe to its parent; ``server`` is a pipe that ends with the fork server."""

    def __init__(self, pipe: Connection, server: int, identity: str) -> None:
        self.identity = identity
        """Name and attempt: no two processes of a stage share it."""
        self._pipe = pipe
        self._server = server
        self._stop = threading.Event()
        self._sending = threading.Lock()
        threading.Thread(target=self._listen, daemon=True).start()

    def should_stop(self) -> bool:
        """Return whether the parent asked for an end."""
        return self._stop.is_set()

    def send(self, report: Report) -> None:
        """Tell the parent; callable from any thread."""
        with self._sending:
            try:
                self._pipe.send_bytes(encode_report(report))
            except OSError:
                os._exit(1)

    def _listen(self) -> None:
        while True:
            ready = wait([self._pipe, self._server])
            try:
                if self._server in ready:
                    raise EOFError
                report = decode_report(self._pipe.recv_bytes(_MAX_REPORT_BYTES))
            except (EOFError, OSError):
                # The parent or the server is gone. Nobody would read a result, so nothing is tidied up.
                os._exit(1)
            assert isinstance(report, Stop)
            self._stop.set()


def _compute_in_batches() -> None:
    """Ask Linux for fewer, longer turns: more processes than cores compute all the time and respond to nobody."""
    if hasattr(os, "SCHED_BATCH"):
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def _name_process(name: str) -> None:
    """Let Linux show a name of at most 15 bytes in lists of processes."""
    with suppress(OSError), open("/proc/self/comm", "wb") as file:
        file.write(name.encode()[:15])


def _child_main(link: int, server: int, log: str, identity: str, main: str, arguments: dict[str, str]) -> None:
    """What every child runs. It ignores Ctrl-C, as the fork server does; the parent alone decides what that means."""
    with open(log, "ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    faulthandler.enable()
    _name_process(identity)
    _compute_in_batches()
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO)
    parent = Link(Connection(link), server, identity)
    try:
        module, _, function = main.partition(":")
        called: Main = getattr(importlib.import_module(module), function)
        parent.send(Finished(called(parent, **arguments)))
        exit_code = 0
    except BaseException as error:
        logging.error("%s", traceback.format_exc())
        parent.send(failure(error))
        exit_code = 1
    # What a library does at the end of the interpreter must not undo what was reported.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(exit_code)
