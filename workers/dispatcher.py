"""Which rollout worker collects which unit; knows neither sockets nor clocks.

A unit may well be collected twice: both results are the same bytes, the first is taken and the second dropped.
"""

from collections import Counter, deque
from dataclasses import dataclass, field

from oodil.pipeline.data import Unit, UnitResult
from oodil.pipeline.errors import UnusableEnvironmentError

UNITS_PER_WORKER = 2
"""One in work and one waiting, so that a worker never waits for the learner's answer."""
MAX_FAILURES = 3
"""Times a unit may raise before its learner does."""
LATE_FACTOR = 5.0
LATE_AT_LEAST_S = 1.0
"""A unit is late after this long, and after `LATE_FACTOR` times the slowest recent unit."""
_RECENT = 64

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
            if given is not None:
                self.failed(worker, name, f"a rollout of {shape} by policy {rollout.policy_version}", now)
            return
        if given is not None:
            self._durations.append(now - given)
        if name in self._queue:
            self._queue.remove(name)
        del self._units[name]
        self._failures.pop(name, None)
        self._results.setdefault(result.iteration, []).append(result)
        self._homes[result.group] = worker

    def failed(self, worker: str, name: UnitName, traceback: str, now: float, is_final: bool = False) -> None:
        """Note that a unit raised; another worker gets it.

        Raises CollectError when that happened too often, and UnusableEnvironmentError for a failure that is final.
        """
        self._answered(worker, name, now)
        if name not in self._units:
            self.dropped["duplicate"] += 1
            return
        if is_final:
            raise UnusableEnvironmentError(traceback)
        failures = self._failures.setdefault(name, {})
        failures[worker] = failures.get(worker, 0) + 1
        if sum(failures.values()) >= MAX_FAILURES:
            raise CollectError(
                f"collecting group {name[1]} of iteration {name[0]} failed {MAX_FAILURES} times, last in {worker}:\n"
                + traceback
            )
        self._requeue(name)

    def lost(self, worker: str) -> None:
        """Forget a worker; its units go to others."""
        gone = self._workers.pop(worker, _Worker())
        for name in gone.held:
            if not any(name in other.held for other in self._workers.values()):
                self._requeue(name)

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

    def _requeue(self, name: UnitName) -> None:
        if name in self._units and name not in self._queue:
            self._queue.appendleft(name)

    def _answered(self, worker: str, name: UnitName, now: float) -> float | None:
        state = self._workers.setdefault(worker, _Worker())
        state.working_since = now
        return state.held.pop(name, None)
