"""Where a learner gets its rollouts from when rollout workers collect them.

`ZmqRollouts` serves the socket in a thread of its own, so that workers are kept busy while the learner learns;
`oodil.workers.dispatcher` decides which worker gets which unit.
"""

import itertools
import logging
import threading
import time
from collections.abc import Callable

from oodil.pipeline.collecting import Follow, nothing_follows
from oodil.pipeline.data import Unit, UnitResult
from oodil.pipeline.stage import JobStoppedError
from oodil.pipeline.versions import collecting_versions
from oodil.workers.channels import Access, Router
from oodil.workers.dispatcher import Dispatcher
from oodil.workers.messages import Header, Ready, Refused, ResultMessage, UnitFailure, UnitMessage, decode, encode
from oodil.workers.wire import MessageError

_POLL_S = 0.1
_CLOSE_S = 5.0
_STOP_PATIENCE_S = 5.0
"""After a stop, how long to wait for the next result before giving up the iteration."""


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
                        self._handle(worker, frames)
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

    def _handle(self, worker: str, frames: list[bytes]) -> None:
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
            self._admit(worker, message.versions)
        elif message.header.run_id != self._run_id:
            dropped["foreign"] += 1
        elif message.header.incarnation != self._incarnation:
            dropped["stale"] += 1
        elif isinstance(message, ResultMessage):
            self._dispatcher.result(worker, message.result, now)
            self._last_result = now
        elif isinstance(message, UnitFailure):
            self._dispatcher.failed(
                worker, (message.iteration, message.group), message.traceback, now, message.is_final
            )

    def _admit(self, worker: str, versions: str) -> None:
        """Accept a worker, unless its libraries could give other bits than ours."""
        if versions == self._versions:
            self._dispatcher.ready(worker)
            return
        self._dispatcher.dropped["versions"] += 1
        reason = f"this worker has {versions}; the learner has {self._versions}"
        logging.warning("%s refused: %s", worker, reason)
        self._channel.send(worker, encode(Refused(Header(self._run_id, "", "learner", next(self._sequence)), reason)))
