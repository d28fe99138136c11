"""Every message that one process sends to another, and how it is encoded.

Between learner and rollout workers a message is a list of frames: a msgpack header that declares fields and arrays,
then the raw bytes of each array. Between a child process and its parent a report is one msgpack value. Decoding gives
a message or raises MessageError: names, types, shapes and lengths must be exactly those declared here. Nothing is ever
unpickled, and no memory is reserved on the word of a header; arrays are views into the frames that arrived.

Letters: T steps, G simulators, S observation, A action, E ended episodes, N numbers of a simulator's state.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from pipeline.environments import Snapshot
from pipeline.policy import GaussianPolicy
from pipeline.rollout import Rollout, Unit, UnitResult

SCHEMA = 2
"""Raise it when the meaning of a message changes; other versions are refused."""
MAX_FRAMES = 64
MAX_HEADER_BYTES = 64 * 1024
MAX_FRAME_BYTES = 256 * 1024 * 1024
MAX_TEXT = 32 * 1024
"""Characters of a string; longer tracebacks lose their middle."""
_MAX_ITEMS = 256
_MAX_LENGTH = 2**31
_DTYPES = {"<f4", "<f8", "<i8", "|b1"}


class MessageError(ValueError):
    """Bytes that are not a message of this version, or a message that must not be sent."""


@dataclass(frozen=True)
class Header:
    """Who says it, and to which run and learner it belongs."""

    run_id: str
    incarnation: str
    """Names one start of one learner, so that nothing meant for its predecessor is taken for its own."""
    sender: str
    sequence: int
    """Counts the messages of a sender."""


# rollout worker -> learner, every second while idle: the heartbeat, and how a new learner finds its workers
@dataclass(frozen=True)
class Ready:
    """A rollout worker has nothing to do. One that would work for any run leaves the header's run_id empty."""

    header: Header
    versions: str
    """What its rollouts are made with."""


# learner -> rollout worker, in answer to Ready
@dataclass(frozen=True)
class Refused:
    """The learner takes nothing from this worker; it should end."""

    header: Header
    reason: str


# learner -> rollout worker
@dataclass(frozen=True)
class UnitMessage:
    """A unit to collect."""

    header: Header
    unit: Unit


# rollout worker -> learner; its header repeats the incarnation of the unit's
@dataclass(frozen=True)
class ResultMessage:
    """What collecting a unit gave."""

    header: Header
    result: UnitResult


# rollout worker -> learner; its header repeats the incarnation of the unit's
@dataclass(frozen=True)
class UnitFailure:
    """Collecting a unit raised."""

    header: Header
    iteration: int
    group: int
    traceback: str


Message = Ready | Refused | UnitMessage | ResultMessage | UnitFailure


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


def shortened(text: str) -> str:
    """Return a text that fits into a message: without its middle if it is too long."""
    half = MAX_TEXT // 2 - 16
    return text if len(text) <= MAX_TEXT else f"{text[:half]}\n[...]\n{text[-half:]}"


# --- values ------------------------------------------------------------------------------------------------------


def _count(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise MessageError(f"expected a count, found {_brief(value)}")
    return value


def _number(value: Any) -> float:
    if type(value) is not float:
        raise MessageError(f"expected a floating-point number, found {_brief(value)}")
    return value


def _text(value: Any) -> str:
    if type(value) is not str or len(value) > MAX_TEXT:
        raise MessageError(f"expected a text of at most {MAX_TEXT} characters, found {_brief(value)}")
    return value


def _key(value: Any) -> tuple[int, ...]:
    return tuple(_count(part) for part in _list(value))


def _numbers_by_name(value: Any) -> dict[str, float]:
    if type(value) is not dict:
        raise MessageError(f"expected numbers by name, found {_brief(value)}")
    return {_text(name): _number(number) for name, number in value.items()}


def _list(value: Any) -> list[Any]:
    if type(value) is not list:
        raise MessageError(f"expected a list, found {_brief(value)}")
    return value


def _brief(value: Any) -> str:
    return f"{type(value).__name__} {str(value)[:40]!r}"


Readers = dict[str, Callable[[Any], Any]]

_HEADER: Readers = {"run_id": _text, "incarnation": _text, "sender": _text, "sequence": _count}
_UNIT: Readers = {
    "iteration": _count,
    "group": _count,
    "env_id": _text,
    "dynamics": _numbers_by_name,
    "num_simulators": _count,
    "num_steps": _count,
    "policy_version": _count,
    "key": _key,
}
_FIELDS: dict[str, Readers] = {
    "Ready": {"versions": _text},
    "Refused": {"reason": _text},
    "UnitMessage": _UNIT,
    "ResultMessage": {"iteration": _count, "group": _count, "policy_version": _count},
    "UnitFailure": {"iteration": _count, "group": _count, "traceback": _text},
}
_REPORTS: dict[type[Report], Readers] = {
    Stop: {},
    Progress: {"done": _count, "total": _count, "metrics": _numbers_by_name},
    Warn: {"text": _text},
    Silent: {"worker": _text},
    Finished: {"outcome": _text},
    Failed: {"traceback": _text},
}

Arrays = dict[str, NDArray]

# Type and shape of every array. Equal letters are equal lengths within a message; a star is any length. Layers are
# numbered, and `GaussianPolicy.from_arrays` checks that they chain.
_SNAPSHOT = {
    "snapshot.states": ("<f8", "GN"),
    "snapshot.elapsed_steps": ("<i8", "G"),
    "snapshot.episode_returns": ("<f8", "G"),
}
_ARRAYS: dict[str, dict[str, tuple[str, str]]] = {
    "Ready": {},
    "Refused": {},
    "UnitMessage": {
        "policy.weight": ("<f4", "**"),
        "policy.bias": ("<f4", "*"),
        "policy.log_std": ("<f4", "A"),
        "policy.input_mean": ("<f4", "S"),
        "policy.input_scale": ("<f4", "S"),
        **_SNAPSHOT,
    },
    "ResultMessage": {
        "rollout.observations": ("<f4", "TGS"),
        "rollout.next_observations": ("<f4", "TGS"),
        "rollout.actions": ("<f4", "TGA"),
        "rollout.log_probs": ("<f4", "TG"),
        "rollout.terminated": ("|b1", "TG"),
        "rollout.truncated": ("|b1", "TG"),
        "rollout.env_rewards": ("<f8", "TG"),
        "rollout.episode_returns": ("<f8", "E"),
        "rollout.episode_lengths": ("<i8", "E"),
        **_SNAPSHOT,
    },
    "UnitFailure": {},
}


# --- messages between learner and rollout workers ----------------------------------------------------------------


def encode(message: Message) -> list[bytes]:
    """Return the frames of a message. Raises MessageError for values that `decode` would refuse."""
    kind = type(message).__name__
    values, arrays = _take_apart(message)
    for name, array in arrays.items():
        # The layout of a matrix changes the bits of its products, and it does not travel.
        if not array.flags.c_contiguous:
            raise MessageError(f"array {name} of {kind} is not C-contiguous")
    described = [[name, array.dtype.str, list(array.shape)] for name, array in arrays.items()]
    _check_shapes(kind, described)
    try:
        head = _pack([SCHEMA, kind, vars(message.header), values, described])
    except (OverflowError, ValueError) as error:
        raise MessageError(f"{kind} cannot be sent: {error}") from error
    if len(head) > MAX_HEADER_BYTES:
        raise MessageError(f"header of {kind} has {len(head)} bytes; at most {MAX_HEADER_BYTES} are allowed")
    return [head, *(array.tobytes() for array in arrays.values())]


def decode(frames: Sequence[bytes]) -> Message:
    """Return the message of some frames, its arrays read-only views of them. Raises MessageError, and nothing else."""
    if not 1 <= len(frames) <= MAX_FRAMES:
        raise MessageError(f"a message has 1 to {MAX_FRAMES} frames, not {len(frames)}")
    head = _list(_unpack(frames[0]))
    if len(head) != 5 or type(head[0]) is not int or head[0] != SCHEMA:
        raise MessageError(f"not a message of schema {SCHEMA}")
    _, kind, header, values, described = head
    if type(kind) is not str or kind not in _FIELDS:
        raise MessageError(f"unknown message {_brief(kind)}")
    read = _read(_FIELDS[kind], values)
    arrays = _read_arrays(kind, _list(described), frames[1:])
    return _put_together(kind, Header(**_read(_HEADER, header)), read, arrays)


def _take_apart(message: Message) -> tuple[dict[str, Any], Arrays]:
    if isinstance(message, UnitMessage):
        unit = message.unit
        values = {name: getattr(unit, name) for name in _UNIT} | {"dynamics": dict(unit.dynamics)}
        arrays = {f"policy.{name}": array for name, array in unit.policy.arrays().items()}
        return values, arrays | (_arrays_of("snapshot", unit.snapshot) if unit.snapshot else {})
    if isinstance(message, ResultMessage):
        result = message.result
        values = {
            "iteration": result.iteration,
            "group": result.group,
            "policy_version": result.rollout.policy_version,
        }
        return values, _arrays_of("rollout", result.rollout) | _arrays_of("snapshot", result.snapshot)
    return {name: value for name, value in vars(message).items() if name != "header"}, {}


def _put_together(kind: str, header: Header, values: dict[str, Any], arrays: Arrays) -> Message:
    try:
        if kind == "UnitMessage":
            values["dynamics"] = tuple(values["dynamics"].items())
            policy = GaussianPolicy.from_arrays(_below("policy.", arrays))
            states = _below("snapshot.", arrays)
            return UnitMessage(header, Unit(**values, policy=policy, snapshot=Snapshot(**states) if states else None))
        if kind == "ResultMessage":
            rollout = Rollout(policy_version=values.pop("policy_version"), **_below("rollout.", arrays))
            return ResultMessage(header, UnitResult(**values, rollout=rollout, snapshot=_snapshot(arrays)))
        others: dict[str, Callable[..., Message]] = {"Ready": Ready, "Refused": Refused, "UnitFailure": UnitFailure}
        return others[kind](header, **values)
    except (TypeError, ValueError) as error:
        raise MessageError(f"incomplete {kind}: {error}") from error


def _snapshot(arrays: Arrays) -> Snapshot:
    return Snapshot(**_below("snapshot.", arrays))


def _arrays_of(prefix: str, value: Rollout | Snapshot) -> Arrays:
    named = {f"{prefix}.{field.name}": getattr(value, field.name) for field in fields(value)}
    return {name: array for name, array in named.items() if isinstance(array, np.ndarray)}


def _below(prefix: str, arrays: Arrays) -> Arrays:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _check_shapes(kind: str, described: list[Any]) -> None:
    """Raise MessageError unless every (name, type, shape) is as declared for this kind of message."""
    lengths: dict[str, int] = {}
    names = set()
    if len(described) >= MAX_FRAMES:
        raise MessageError(f"{kind} has {len(described)} arrays; fewer than {MAX_FRAMES} are allowed")
    for entry in described:
        if len(_list(entry)) != 3:
            raise MessageError("an array is described by name, type and shape")
        name, dtype, shape = _text(entry[0]), entry[1], _list(entry[2])
        layer, _, number = name.rpartition("_")
        declared = _ARRAYS[kind].get(layer if number.isdecimal() else name)
        if declared is None or name in names:
            raise MessageError(f"{kind} has no array {name[:40]!r}, or has it twice")
        names.add(name)
        if dtype != declared[0] or len(shape) != len(declared[1]):
            raise MessageError(
                f"array {name} is {_brief(dtype)} with {len(shape)} axes; expected {declared[0]} ({declared[1]})"
            )
        for letter, length in zip(declared[1], shape, strict=True):
            if _count(length) >= _MAX_LENGTH or (letter != "*" and lengths.setdefault(letter, length) != length):
                raise MessageError(f"array {name} has the shape {shape}; expected ({declared[1]}) with {lengths}")
        if math.prod(shape) * np.dtype(dtype).itemsize > MAX_FRAME_BYTES:
            raise MessageError(f"array {name} of shape {shape} is larger than {MAX_FRAME_BYTES} bytes")


def _read_arrays(kind: str, described: list[Any], frames: Sequence[bytes]) -> Arrays:
    _check_shapes(kind, described)
    if len(described) != len(frames):
        raise MessageError(f"{kind} describes {len(described)} arrays but has {len(frames)}")
    arrays = {}
    for (name, dtype, shape), frame in zip(described, frames, strict=True):
        if dtype not in _DTYPES or len(frame) != math.prod(shape) * np.dtype(dtype).itemsize:
            raise MessageError(f"array {name} has {len(frame)} bytes, which is not {dtype} of shape {shape}")
        if dtype == "|b1" and np.frombuffer(frame, np.uint8).max(initial=0) > 1:
            raise MessageError(f"array {name} has bytes that are no truth values")
        try:
            arrays[name] = np.ndarray(shape, dtype, frame)
        except ValueError as error:
            raise MessageError(f"array {name} has an impossible shape {shape}: {error}") from error
    return arrays


# --- reports between a child process and its parent --------------------------------------------------------------


def encode_report(report: Report) -> bytes:
    """Return the bytes of a report."""
    return _pack([type(report).__name__, vars(report)])


def decode_report(content: bytes) -> Report:
    """Return the report of some bytes. Raises MessageError, and nothing else."""
    value = _list(_unpack(content))
    for kind, readers in _REPORTS.items():
        if len(value) == 2 and value[0] == kind.__name__:
            return kind(**_read(readers, value[1]))
    raise MessageError(f"unknown report {_brief(value)}")


def _read(readers: Readers, values: Any) -> dict[str, Any]:
    if type(values) is not dict or values.keys() != readers.keys():
        raise MessageError(f"expected the fields {sorted(readers)}, found {_brief(values)}")
    return {name: read(values[name]) for name, read in readers.items()}


def _pack(value: Any) -> bytes:
    content: bytes = msgpack.packb(value, unicode_errors="backslashreplace")
    return content


def _unpack(content: bytes) -> Any:
    if len(content) > MAX_HEADER_BYTES:
        raise MessageError(f"header has {len(content)} bytes; at most {MAX_HEADER_BYTES} are allowed")
    try:
        return msgpack.unpackb(
            content,
            strict_map_key=True,
            max_str_len=4 * MAX_TEXT,
            max_bin_len=0,
            max_array_len=_MAX_ITEMS,
            max_map_len=_MAX_ITEMS,
            max_ext_len=0,
        )
    except (ValueError, msgpack.UnpackException) as error:
        raise MessageError(f"not msgpack within the limits: {error}") from error
