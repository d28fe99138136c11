"""Where a learner gets its rollouts from when rollout workers collect them.

`Dispatcher` decides which worker gets which unit; it knows neither sockets nor clocks. `ZmqRollouts` serves the socket
in a thread of its own, so that workers are kept busy while the learner learns. A unit may well be collected twice: both
results are the same bytes, the first is taken and the second dropped.
"""

import itertools
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field

from oodil.pipeline.collecting import Follow, nothing_follows
from oodil.pipeline.data import Unit, UnitResult
from oodil.pipeline.stage import JobStoppedError
from oodil.pipeline.versions import collecting_versions
from oodil.workers.channels import Access, Router
from oodil.workers.messages import Header, Ready, Refused, ResultMessage, UnitFailure, UnitMessage, decode, encode
from oodil.workers.wire import MessageError

UNITS_PER_WORKER = 2
"""One in work and one waiting, so that a worker never waits for the learner's answer."""
MAX_FAILURES = 3
"""Times a unit may raise before its learner does."""
LATE_FACTOR = 5.0
LATE_AT_LEAST_S = 1.0
"""A unit is late after this long, and after `LATE_FACTOR` times the slowest recent unit."""
_RECENT = 64
_POLL_S = 0.1
_CLOSE_S = 5.0
_STOP_PATIENCE_S = 5.0
"""After a stop, how long to wait for the next result before giving up the iteration."""

UnitName = tuple[int, int]
"""Iteration and group."""


class CollectError(RuntimeError):
    """A unit raised again and again; the message has the worker's traceback."""


@dataclass
class _Worker:
    held: dict[UnitName, float] = field(default_factory=dict)
    """Units that it was given and has not answered, and when it got them."""
    working_since: float = 0.0
    """When it last answered, or got something to do after having nothing."""


class Dispatcher:
    """Which worker gets which unit. Times are passed in, in seconds on any clock that does not go back."""

    def __init__(self, unit_timeout_s: float) -> None:
        self.dropped: Counter[str] = Counter()
        """Messages that were not used, by reason."""
        self._unit_timeout_s = unit_timeout_s
        self._workers: dict[str, _Worker] = {}
        self._units: dict[UnitName, Unit] = {}
        """Those without a result."""
        self._queue: deque[UnitName] = deque()
        self._submitted: Counter[int] = Counter()
        self._results: dict[int, list[UnitResult]] = {}
        self._failures: dict[UnitName, dict[str, int]] = {}
        self._durations: deque[float] = deque(maxlen=_RECENT)
        self._homes: dict[int, str] = {}
        """The worker that collected a group last; it may still have the group's simulators where they stopped."""

    def submit(self, units: list[Unit]) -> None:
        """Take units to be collected. Raises ValueError for one that is waited for already."""
        for unit in units:
            name = (unit.iteration, unit.group)
            if name in self._units:
                raise ValueError(f"unit {name} was submitted twice")
            self._units[name] = unit
            self._queue.append(name)
            self._submitted[unit.iteration] += 1

    def next_iteration(self) -> tuple[int, int]:
        """Return the earliest iteration that nobody has asked for, and how many units of it were submitted."""
        first = min(self._submitted)
        return first, self._submitted.pop(first)

    def take(self, iteration: int) -> list[UnitResult]:
        """Return the results of an iteration that have come since they were taken last."""
        return self._results.pop(iteration, [])

    def ready(self, worker: str) -> None:
        """Note that a worker is there."""
        self._workers.setdefault(worker, _Worker())

    def result(self, worker: str, result: UnitResult, now: float) -> None:
        """Take a result, or drop and count it if it is none of those that are missing."""
        name = (result.iteration, result.group)
        given = self._answered(worker, name, now)
        unit = self._units.get(name)
        if unit is None:
            self.dropped["duplicate"] += 1
            return
        rollout = result.rollout
        shape = rollout.observations.shape[:2]
        if rollout.policy_version != unit.policy_version or shape != (unit.num_steps, unit.num_simulators):
            self.dropped["mismatch"] += 1
            return
        if given is not None:
            self._durations.append(now - given)
        if name in self._queue:
            self._queue.remove(name)
        del self._units[name]
        self._failures.pop(name, None)
        self._results.setdefault(result.iteration, []).append(result)
        self._homes[result.group] = worker

    def failed(self, worker: str, name: UnitName, traceback: str, now: float) -> None:
        """Note that a unit raised; another worker gets it. Raises CollectError when that happened too often."""
        self._answered(worker, name, now)
        if name not in self._units:
            self.dropped["duplicate"] += 1
            return
        failures = self._failures.setdefault(name, {})
        failures[worker] = failures.get(worker, 0) + 1
        if sum(failures.values()) >= MAX_FAILURES:
            raise CollectError(
                f"collecting group {name[1]} of iteration {name[0]} failed {MAX_FAILURES} times, last in {worker}:\n"
                + traceback
            )
        self._give_back(name)

    def lost(self, worker: str) -> None:
        """Forget a worker; its units go to others."""
        gone = self._workers.pop(worker, _Worker())
        for name in gone.held:
            if not any(name in other.held for other in self._workers.values()):
                self._give_back(name)

    def silent(self, now: float) -> list[str]:
        """Return, and forget, the workers that have answered nothing for the time allowed for a unit."""
        limit = now - self._unit_timeout_s
        silent = [name for name, worker in self._workers.items() if worker.held and worker.working_since < limit]
        for name in silent:
            self.lost(name)
        return silent

    def assign(self, now: float) -> list[tuple[str, Unit]]:
        """Return who is to be given what, now: waiting units first, then late ones to workers with nothing to do."""
        given = []
        for name in list(self._queue):
            worker = self._least_busy(name)
            if worker is not None:
                self._queue.remove(name)
                given.append(self._give(worker, name, now))
        late = max(LATE_AT_LEAST_S, LATE_FACTOR * max(self._durations, default=0.0))
        for worker, state in self._workers.items():
            overdue = {name: since for name, since in self._last_given().items() if now - since > late}
            if not state.held and overdue:
                given.append(self._give(worker, min(overdue, key=overdue.__getitem__), now))
        return given

    def _least_busy(self, name: UnitName) -> str | None:
        """Return the worker with room that holds least, the group's last one if there are several.

        One on which the unit failed is taken only if there is no other.
        """
        failures = self._failures.get(name, {})
        free = [worker for worker, state in self._workers.items() if len(state.held) < UNITS_PER_WORKER]
        if any(worker not in failures for worker in self._workers):
            free = [worker for worker in free if worker not in failures]
        home = self._homes.get(name[1])
        return min(free, key=lambda worker: (len(self._workers[worker].held), worker != home), default=None)

    def _last_given(self) -> dict[UnitName, float]:
        """Return when each missing unit that some worker holds was given away last."""
        given: dict[UnitName, float] = {}
        for worker in self._workers.values():
            for name, since in worker.held.items():
                if name in self._units:
                    given[name] = max(since, given.get(name, since))
        return given

    def _give(self, worker: str, name: UnitName, now: float) -> tuple[str, Unit]:
        state = self._workers[worker]
        if not state.held:
            state.working_since = now
        state.held[name] = now
        return worker, self._units[name]

    def _give_back(self, name: UnitName) -> None:
        if name in self._units and name not in self._queue:
            self._queue.appendleft(name)

    def _answered(self, worker: str, name: UnitName, now: float) -> float | None:
        state = self._workers.setdefault(worker, _Worker())
        state.working_since = now
        return state.held.pop(name, None)


class ZmqRollouts:
    """A rollout source served by whatever rollout workers are connected."""

    def __init__(
        self,
        endpoint: str,
        run_id: str,
        incarnation: str,
        unit_timeout_s: float,
        should_stop: Callable[[], bool] = lambda: False,
        report_silent: Callable[[str], None] = lambda worker: None,
        access: Access | None = None,
    ) -> None:
        self._run_id = run_id
        self._incarnation = incarnation
        self._should_stop = should_stop
        self._report_silent = report_silent
        self._dispatcher = Dispatcher(unit_timeout_s)
        self._changed = threading.Condition()
        self._last_result = time.monotonic()
        self._error: Exception | None = None
        self._is_closing = False
        self._sequence = itertools.count()
        self._versions = collecting_versions()
        self._channel = Router(endpoint, access)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> dict[str, int]:
        """Messages that were not used, by reason: bad, foreign, stale, duplicate, mismatch."""
        with self._changed:
            return dict(self._dispatcher.dropped)

    def submit(self, units: list[Unit]) -> None:
        """Hand over units; workers begin at once."""
        with self._changed:
            self._dispatcher.submit(units)
        self._channel.wake()

    def gather(self, follow: Follow = nothing_follows) -> list[UnitResult]:
        """Wait for the iteration that was submitted first; see `RolloutSource`.

        Raises CollectError when a unit raised too often, and JobStoppedError when a stop was asked for and no result
        has come since for some seconds. A stop alone does not end the wait: the job finishes its iteration.
        """
        began = time.monotonic()
        results: list[UnitResult] = []
        with self._changed:
            iteration, count = self._dispatcher.next_iteration()
        while len(results) < count:
            with self._changed:
                arrived = self._dispatcher.take(iteration)
                if not arrived:
                    self._wait(began)
            for result in arrived:
                results.append(result)
                self.submit(follow(result))
        return sorted(results, key=lambda result: result.group)

    def _wait(self, began: float) -> None:
        """Wait until something changes, with the lock held; raise what `gather` raises."""
        if self._error is not None:
            raise self._error
        quiet_s = time.monotonic() - max(began, self._last_result)
        if quiet_s > _STOP_PATIENCE_S and self._should_stop():
            raise JobStoppedError(f"stopped, and no rollout worker answered for {quiet_s:.0f} s")
        self._changed.wait(_POLL_S)

    def close(self) -> None:
        """Stop serving and close the socket; harmless when repeated."""
        if self._is_closing:
            return
        self._is_closing = True
        self._channel.wake()
        self._thread.join(_CLOSE_S)
        self._channel.close()

    def _serve(self) -> None:
        try:
            while not self._is_closing:
                messages = self._channel.receive(_POLL_S)
                with self._changed:
                    for worker, frames in messages:
                        self._take_in(worker, frames)
                    given, silent = self._decide()
                    self._changed.notify()
                for worker in silent:
                    self._report_silent(worker)
                for worker, unit in given:
                    self._send(worker, unit)
        except Exception as error:
            with self._changed:
                self._error = error
                self._changed.notify()

    def _decide(self) -> tuple[list[tuple[str, Unit]], list[str]]:
        now = time.monotonic()
        silent = self._dispatcher.silent(now)
        return self._dispatcher.assign(now), silent

    def _send(self, worker: str, unit: Unit) -> None:
        header = Header(self._run_id, self._incarnation, "learner", next(self._sequence))
        if not self._channel.send(worker, encode(UnitMessage(header, unit))):
            with self._changed:
                self._dispatcher.lost(worker)

    def _take_in(self, worker: str, frames: list[bytes]) -> None:
        dropped, now = self._dispatcher.dropped, time.monotonic()
        try:
            message = decode(frames)
        except MessageError as error:
            logging.warning("message of %s dropped: %s", worker, error)
            dropped["bad"] += 1
            return
        if isinstance(message, UnitMessage | Refused) or message.header.sender != worker:
            dropped["bad"] += 1
        elif isinstance(message, Ready) and message.header.run_id in ("", self._run_id):
            self._take_on(worker, message.versions)
        elif message.header.run_id != self._run_id:
            dropped["foreign"] += 1
        elif message.header.incarnation != self._incarnation:
            dropped["stale"] += 1
        elif isinstance(message, ResultMessage):
            self._dispatcher.result(worker, message.result, now)
            self._last_result = now
        elif isinstance(message, UnitFailure):
            self._dispatcher.failed(worker, (message.iteration, message.group), message.traceback, now)

    def _take_on(self, worker: str, versions: str) -> None:
        """Let a worker in, unless its libraries could give other bits than ours."""
        if versions == self._versions:
            self._dispatcher.ready(worker)
            return
        self._dispatcher.dropped["versions"] += 1
        reason = f"this worker has {versions}; the learner has {self._versions}"
        logging.warning("%s refused: %s", worker, reason)
        self._channel.send(worker, encode(Refused(Header(self._run_id, "", "learner", next(self._sequence)), reason)))
