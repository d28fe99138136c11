"""Rollout workers on a machine of their own: they join a learner elsewhere, and may leave at any time."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

from oodil.pipeline.errors import OodilError
from oodil.workers import rollout_worker
from oodil.workers.engine import Attempts
from oodil.workers.reports import Failed, Finished, Started
from oodil.workers.supervisor import Supervisor

_POLL_S = 0.2
_ATTEMPTS, _DELAY_S = 1_000_000, 1.0


class WorkersError(OodilError):
    """The learner does not want these workers; the message says why."""


def serve(
    address: str, keys: Path, workers: int, logs: Path, say: Callable[[str], None], should_stop: Callable[[], bool]
) -> None:
    """Keep ``workers`` processes collecting for the learner at an address until asked to stop.

    They wait for a learner that is not there yet, or not any more, and work for one run after another. One that dies is
    replaced. Raises WorkersError when the learner refuses them.
    """
    host = f"{socket.gethostname()}-{os.getpid()}-"
    arguments = {"endpoint": address, "host": host, "keys": str(keys)}
    with Supervisor(logs, "remote") as supervisor:
        attempts = {f"worker-{index}": Attempts(_ATTEMPTS, _DELAY_S) for index in range(workers)}
        for name in attempts:
            supervisor.start(name, rollout_worker.main, arguments)
        while not should_stop():
            for event in supervisor.poll(_POLL_S):
                match event.report:
                    case Started(_):
                        say(f"{host}{event.name}: collects for {address}")
                    case Finished(outcome):
                        raise WorkersError(outcome)
                    case Failed(reason):
                        say(f"{host}{event.name}: {reason}; started again")
                        delay_s = attempts[event.name].failed(reason)
                        supervisor.start(event.name, rollout_worker.main, arguments, delay_s or 0.0)
