"""Child processes: starting, watching and ending them; the only file that starts any.

Parent and child share a pipe that carries encoded reports and nothing else. The child watches its end: when the parent
is gone, however it died, the pipe closes and the child ends at once. Whether something is started again is for the
caller to decide (`oodil.workers.engine.Attempts`).
"""

import faulthandler
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection, resource_tracker
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import TracebackType
from typing import Self

from oodil.workers.reports import Event, Failed, Finished, Report, Started, Stop, decode_report, encode_report
from oodil.workers.wire import MessageError, shortened

_MAX_REPORT_BYTES = 1024 * 1024
_TERMINATE_S = 2.0
"""How long a child may take to follow SIGTERM before it is killed."""
_GRACE_S = 5.0
"""How long children may take to end when asked at the end of a run."""
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_context = multiprocessing.get_context("spawn")

Pipe = connection.Connection
Main = Callable[..., str]
"""A child's main function: called with its Link and plain keyword arguments; returns its outcome."""


@dataclass
class _Process:
    """One start of a child."""

    process: SpawnProcess
    pipe: Pipe
    log: Path
    last_words: Finished | Failed | None = None

    def say(self, report: Report) -> None:
        with suppress(OSError):  # It may be gone; `poll` will say so.
            self.pipe.send_bytes(encode_report(report))

    def close(self) -> None:
        self.process.join()
        self.process.close()
        self.pipe.close()


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

    def __init__(self, logs: Path, prefix: str) -> None:
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
            is_dead = not running.process.is_alive()
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
                running.process.kill()

    def close(self, grace_s: float) -> None:
        """End all children: ask, wait, terminate, kill. Bounded, and harmless when repeated."""
        processes = [running for _, running in self._running()]
        for running in processes:
            running.say(Stop())
        _join(processes, grace_s)
        for running in processes:
            running.process.terminate()
        _join(processes, _TERMINATE_S)
        for running in processes:
            running.process.kill()
            running.close()
        self._children.clear()

    def _running(self) -> list[tuple[_Child, _Process]]:
        return [(child, child.running) for child in self._children.values() if child.running is not None]

    def _wait(self, timeout_s: float) -> None:
        running = [running for _, running in self._running()]
        handles = [process.pipe for process in running] + [process.process.sentinel for process in running]
        # With no child to wait for, wait() returns at once.
        connection.wait(handles, timeout_s) if handles else time.sleep(timeout_s)

    def _launch(self, child: _Child) -> None:
        self._logs.mkdir(parents=True, exist_ok=True)
        log = self._logs / f"{self._prefix}-{child.name}.{child.attempt}.log"
        pipe, childs_end = _context.Pipe()
        link = (childs_end, str(log), f"{child.name}.{child.attempt}")
        process = _context.Process(
            target=_child_main, args=(*link, child.main, child.arguments), name=child.name, daemon=True
        )
        with _environment_of_children():
            process.start()
        childs_end.close()
        child.running = _Process(process, pipe, log)

    def _ended(self, child: _Child, running: _Process) -> Finished | Failed:
        exit_code = running.process.exitcode
        assert exit_code is not None
        running.close()
        del self._children[child.name]
        return running.last_words or Failed(f"{_describe(exit_code)}; its log is {running.log}")


def _received(running: _Process) -> list[Report]:
    """Return what a child said, and remember its last words."""
    reports: list[Report] = []
    try:
        while running.pipe.poll():
            report = decode_report(running.pipe.recv_bytes(_MAX_REPORT_BYTES))
            if isinstance(report, Finished | Failed):
                running.last_words = report
            else:
                reports.append(report)
    except (EOFError, OSError):
        # It is just about to end. If it is not, it cannot be supervised any more.
        running.process.join(_TERMINATE_S)
        running.process.kill()
    except MessageError as error:
        running.last_words = Failed(f"the child sent something that is no report: {error}")
        running.process.kill()
    return reports


def _join(processes: list[_Process], timeout_s: float) -> None:
    deadline = time.monotonic() + timeout_s
    for running in processes:
        running.process.join(max(0.0, deadline - time.monotonic()))


def _describe(exit_code: int) -> str:
    if exit_code >= 0:
        return f"ended with exit code {exit_code} before it was done"
    try:
        return f"killed by {signal.Signals(-exit_code).name}"
    except ValueError:
        return f"killed by signal {-exit_code}"


@contextmanager
def _environment_of_children() -> Iterator[None]:
    """Let processes that start here compute with one thread, and not be interrupted before they can say so."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    # Starting the tracker unblocks signals, so it must run before they are blocked.
    resource_tracker.ensure_running()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(_ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


class Link:
    """A child's end of the pipe to its parent."""

    def __init__(self, pipe: Pipe, identity: str) -> None:
        self.identity = identity
        """Name and attempt: no two processes of a stage share it."""
        self._pipe = pipe
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
            try:
                report = decode_report(self._pipe.recv_bytes(_MAX_REPORT_BYTES))
            except (EOFError, OSError):
                # The parent is gone. Nobody would read a result, so nothing is tidied up.
                os._exit(1)
            assert isinstance(report, Stop)
            self._stop.set()


def _compute_in_batches() -> None:
    """Ask Linux for fewer, longer turns: more processes than cores compute all the time and respond to nobody."""
    if hasattr(os, "SCHED_BATCH"):
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def _child_main(pipe: Pipe, log: str, identity: str, main: Main, arguments: dict[str, str]) -> None:
    # A terminal sends Ctrl-C to all of them; the parent alone decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    with open(log, "ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    faulthandler.enable()
    _compute_in_batches()
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO)
    link = Link(pipe, identity)
    try:
        link.send(Finished(main(link, **arguments)))
        exit_code = 0
    except BaseException:
        text = traceback.format_exc()
        logging.error("%s", text)
        link.send(Failed(shortened(text)))
        exit_code = 1
    # What a library does at the end of the interpreter must not undo what was reported.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(exit_code)
