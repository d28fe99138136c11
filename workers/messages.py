"""Every message between learner and rollout workers, and how it is encoded.

A message is a list of frames: a msgpack header that declares fields and arrays, then the raw bytes of each array.
Decoding gives a message or raises MessageError: names, types, shapes and lengths must be exactly those declared here.
No memory is reserved on the word of a header; arrays are views into the frames that arrived.

Letters: T steps, G simulators, S observation, A action, E ended episodes, P starts, N numbers of a simulator's state.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Rollout, Snapshot, Unit, UnitResult
from oodil.pipeline.policy import GaussianPolicy
from oodil.workers.wire import (
    MAX_HEADER_BYTES,
    MessageError,
    Readers,
    brief,
    count,
    flag,
    items,
    key,
    pack,
    read,
    text,
    unpack,
    values_by_name,
)

SCHEMA = 4
"""Raise it when the meaning of a message changes; other versions are refused."""
MAX_FRAMES = 64
MAX_FRAME_BYTES = 256 * 1024 * 1024
_MAX_LENGTH = 2**31
_DTYPES = {"<f4", "<f8", "<i8", "|b1"}


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
    is_final: bool = False
    """Whether nobody should try again: the environment cannot be used, and instead of a traceback it is said why."""


Message = Ready | Refused | UnitMessage | ResultMessage | UnitFailure


_HEADER: Readers = {"run_id": text, "incarnation": text, "sender": text, "sequence": count}
_UNIT: Readers = {
    "iteration": count,
    "group": count,
    "env_id": text,
    "dynamics": values_by_name,
    "num_simulators": count,
    "num_steps": count,
    "policy_version": count,
    "key": key,
}
_FIELDS: dict[str, Readers] = {
    "Ready": {"versions": text},
    "Refused": {"reason": text},
    "UnitMessage": _UNIT,
    "ResultMessage": {"iteration": count, "group": count, "policy_version": count},
    "UnitFailure": {"iteration": count, "group": count, "traceback": text, "is_final": flag},
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
        "policy.input_limit": ("<f4", ""),
        "starts": ("<f4", "PS"),
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
        head = pack([SCHEMA, kind, vars(message.header), values, described])
    except (OverflowError, ValueError) as error:
        raise MessageError(f"{kind} cannot be sent: {error}") from error
    if len(head) > MAX_HEADER_BYTES:
        raise MessageError(f"header of {kind} has {len(head)} bytes; at most {MAX_HEADER_BYTES} are allowed")
    return [head, *(array.tobytes() for array in arrays.values())]


def decode(frames: Sequence[bytes]) -> Message:
    """Return the message of some frames, its arrays read-only views of them. Raises MessageError, and nothing else."""
    if not 1 <= len(frames) <= MAX_FRAMES:
        raise MessageError(f"a message has 1 to {MAX_FRAMES} frames, not {len(frames)}")
    head = items(unpack(frames[0]))
    if len(head) != 5 or type(head[0]) is not int or head[0] != SCHEMA:
        raise MessageError(f"not a message of schema {SCHEMA}")
    _, kind, header, values, described = head
    if type(kind) is not str or kind not in _FIELDS:
        raise MessageError(f"unknown message {brief(kind)}")
    fields_read = read(_FIELDS[kind], values)
    arrays = _read_arrays(kind, items(described), frames[1:])
    return _put_together(kind, Header(**read(_HEADER, header)), fields_read, arrays)


def _take_apart(message: Message) -> tuple[dict[str, Any], Arrays]:
    if isinstance(message, UnitMessage):
        unit = message.unit
        values = {name: getattr(unit, name) for name in _UNIT} | {"dynamics": dict(unit.dynamics)}
        arrays = {f"policy.{name}": array for name, array in unit.policy.arrays().items()}
        arrays |= {} if unit.starts is None else {"starts": unit.starts}
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
            snapshot, starts = Snapshot(**states) if states else None, arrays.get("starts")
            return UnitMessage(header, Unit(**values, policy=policy, snapshot=snapshot, starts=starts))
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
        if len(items(entry)) != 3:
            raise MessageError("an array is described by name, type and shape")
        name, dtype, shape = text(entry[0]), entry[1], items(entry[2])
        layer, _, number = name.rpartition("_")
        declared = _ARRAYS[kind].get(layer if number.isdecimal() else name)
        if declared is None or name in names:
            raise MessageError(f"{kind} has no array {name[:40]!r}, or has it twice")
        names.add(name)
        if dtype != declared[0] or len(shape) != len(declared[1]):
            raise MessageError(
                f"array {name} is {brief(dtype)} with {len(shape)} axes; expected {declared[0]} ({declared[1]})"
            )
        for letter, length in zip(declared[1], shape, strict=True):
            if count(length) >= _MAX_LENGTH or (letter != "*" and lengths.setdefault(letter, length) != length):
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
