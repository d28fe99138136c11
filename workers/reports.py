"""What a child process says to its parent, and the one thing that a parent says: each report is one msgpack value."""

from dataclasses import dataclass

from oodil.workers.wire import MessageError, Readers, brief, count, items, numbers_by_name, pack, read, text, unpack


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
    """The child did what it was started for; ``outcome`` is what its main function returned."""

    outcome: str


# child -> parent, its last words
@dataclass(frozen=True)
class Failed:
    """The child's main function raised."""

    traceback: str


Report = Stop | Progress | Warn | Silent | Finished | Failed

_REPORTS: dict[type[Report], Readers] = {
    Stop: {},
    Progress: {"done": count, "total": count, "metrics": numbers_by_name},
    Warn: {"text": text},
    Silent: {"worker": text},
    Finished: {"outcome": text},
    Failed: {"traceback": text},
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
