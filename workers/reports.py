"""What is said about jobs and rollout workers.

Reports travel between a child process and its parent, each as one msgpack value. An `Event` says whom a report is
about; whoever watches a run gets events whose reports are those of the job itself, passed on as they are, and those
that only an engine can make.
"""

import traceback
from dataclasses import dataclass

from oodil.pipeline.errors import ConfigError, DataError, ExpertError, UnfinishedError, UnusableEnvironmentError
from oodil.workers.wire import (
    MessageError,
    Readers,
    brief,
    count,
    flag,
    items,
    numbers_by_name,
    pack,
    read,
    shortened,
    text,
    unpack,
)

DONE, STOPPED = "done", "stopped"
"""Outcomes of a job: its artifact is written; it wrote a checkpoint and stopped because it was asked to."""


# parent -> child
@dataclass(frozen=True)
class Stop:
    """Finish what is being done, then end."""


# job -> parent
@dataclass(frozen=True)
class Progress:
    """How far a job is."""

    done: int
    total: int
    metrics: dict[str, float]


# job -> parent
@dataclass(frozen=True)
class Warn:
    """Something the user should see."""

    text: str


# learner -> parent
@dataclass(frozen=True)
class Silent:
    """A rollout worker holds a unit for too long and should be replaced."""

    worker: str


# child -> parent, its last words
@dataclass(frozen=True)
class Finished:
    """It did what it was started for; ``outcome`` is DONE or STOPPED for a job."""

    outcome: str


# child -> parent, its last words
@dataclass(frozen=True)
class Failed:
    """It raised, or it died, which its parent finds out; ``reason`` is its traceback if there is one."""

    reason: str
    is_final: bool = False
    """Whether it should not be tried again: it needs something that cannot be used, and the reason is one message."""


Report = Stop | Progress | Warn | Silent | Finished | Failed


# made by a supervisor or an engine
@dataclass(frozen=True)
class Started:
    """An attempt begins; the first is 1."""

    attempt: int


# made by an engine
@dataclass(frozen=True)
class AttemptFailed:
    """An attempt at a job raised or was killed."""

    attempt: int
    reason: str
    """Its traceback if there is one."""
    will_retry: bool


# made by an engine
@dataclass(frozen=True)
class Replaced:
    """A rollout worker died and another one is started in its place."""

    reason: str


@dataclass(frozen=True)
class Event:
    """A report and whom it is about."""

    name: str
    """Of a job or of a rollout worker."""
    report: Report | Started | AttemptFailed | Replaced


_UNUSABLE = ConfigError, DataError, ExpertError, UnusableEnvironmentError
"""What another attempt would meet again."""


def failure(error: BaseException) -> Failed:
    """Return the last words of what raised an error that is being handled."""
    is_final = isinstance(error, _UNUSABLE) or (isinstance(error, UnfinishedError) and error.is_final)
    return Failed(shortened(str(error) if is_final else traceback.format_exc()), is_final)


_REPORTS: dict[type[Report], Readers] = {
    Stop: {},
    Progress: {"done": count, "total": count, "metrics": numbers_by_name},
    Warn: {"text": text},
    Silent: {"worker": text},
    Finished: {"outcome": text},
    Failed: {"reason": text, "is_final": flag},
}


def encode_report(report: Report) -> bytes:
    """Return the bytes of a report."""
    return pack([type(report).__name__, vars(report)])


def decode_report(content: bytes) -> Report:
    """Return the report of some bytes. Raises MessageError, and nothing else."""
    value = items(unpack(content))
    for kind, readers in _REPORTS.items():
        if len(value) == 2 and value[0] == kind.__name__:
            return kind(**read(readers, value[1]))
    raise MessageError(f"unknown report {brief(value)}")
