"""Rollout workers on a machine of their own: they join a learner elsewhere, and may leave at any time."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

from oodil.pipeline.errors import OodilError
from oodil.workers import rollout_worker as rollout_process
from oodil.workers.supervisor import Died, Ended, Restarts, Started, Supervisor

_POLL_S = 0.2
_RESTARTS, _DELAY_S = 1_000_000, 1.0


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
        for index in range(workers):
            supervisor.start(f"worker-{index}", rollout_process.main, arguments, Restarts(_RESTARTS, _DELAY_S))
        while not should_stop():
            for event in supervisor.poll(_POLL_S):
                if isinstance(event, Started):
                    say(f"{host}{event.name}: collects for {address}")
                elif isinstance(event, Ended):
                    raise WorkersError(event.outcome)
                elif isinstance(event, Died):
                    say(f"{host}{event.name}: {event.reason}; started again")
