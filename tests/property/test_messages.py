"""Whatever is sent arrives bit for bit; whatever is not a message is refused and costs no memory."""

import tracemalloc
from contextlib import suppress
from itertools import pairwise
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of
from numpy.typing import NDArray

from oodil.pipeline.data import Rollout, Snapshot, Unit, UnitResult
from oodil.pipeline.policy import GaussianPolicy
from oodil.workers import messages
from oodil.workers.messages import (
    Header,
    Message,
    Ready,
    Refused,
    ResultMessage,
    UnitFailure,
    UnitMessage,
    decode,
    encode,
)
from oodil.workers.reports import Failed, Finished, Progress, Report, Silent, Stop, Warn, decode_report, encode_report
from oodil.workers.wire import MessageError, shortened

texts = st.text(max_size=50)
plain_texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=50)
counts = st.integers(0, 2**63)
sizes = st.integers(0, 4)
headers = st.builds(Header, plain_texts, plain_texts, plain_texts, counts)


@st.composite
def array(draw: st.DrawFn, dtype: type, *shape: int) -> NDArray[Any]:
    """Draw an array of any bits, NaN and infinities included."""
    drawn: NDArray[Any] = draw(arrays_of.arrays(dtype, shape, fill=st.nothing()))
    return drawn


@st.composite
def snapshots(draw: st.DrawFn, group: int) -> Snapshot:
    """Draw a snapshot of a group."""
    states = array(np.float64, group, draw(sizes))
    return Snapshot(draw(states), draw(array(np.int64, group)), draw(array(np.float64, group)))


@st.composite
def policies(draw: st.DrawFn) -> GaussianPolicy:
    """Draw a policy of one to three layers."""
    widths = draw(st.lists(st.integers(1, 4), min_size=2, max_size=4))
    f4 = np.float32
    return GaussianPolicy(
        tuple(draw(array(f4, a, b)) for a, b in pairwise(widths)),
        tuple(draw(array(f4, b)) for b in widths[1:]),
        draw(array(f4, widths[-1])),
        draw(array(f4, widths[0])),
        draw(array(f4, widths[0])),
    )


@st.composite
def unit_messages(draw: st.DrawFn) -> UnitMessage:
    """Draw a unit."""
    group, policy = draw(sizes), draw(policies())
    unit = Unit(
        iteration=draw(counts),
        group=draw(counts),
        env_id=draw(plain_texts),
        dynamics=tuple(draw(st.dictionaries(plain_texts, st.floats(), max_size=3)).items()),
        num_simulators=draw(counts),
        num_steps=draw(counts),
        policy_version=draw(counts),
        policy=policy,
        key=tuple(draw(st.lists(counts, max_size=5))),
        snapshot=draw(st.none() | snapshots(group)),
        starts=draw(st.none() | array(np.float32, draw(sizes), len(policy.input_mean))),
    )
    return UnitMessage(draw(headers), unit)


@st.composite
def result_messages(draw: st.DrawFn) -> ResultMessage:
    """Draw a result."""
    steps, group, state, action, ended = (draw(sizes) for _ in range(5))
    rollout = Rollout(
        policy_version=draw(counts),
        observations=draw(array(np.float32, steps, group, state)),
        next_observations=draw(array(np.float32, steps, group, state)),
        actions=draw(array(np.float32, steps, group, action)),
        log_probs=draw(array(np.float32, steps, group)),
        terminated=draw(array(np.bool_, steps, group)),
        truncated=draw(array(np.bool_, steps, group)),
        env_rewards=draw(array(np.float64, steps, group)),
        episode_returns=draw(array(np.float64, ended)),
        episode_lengths=draw(array(np.int64, ended)),
    )
    return ResultMessage(draw(headers), UnitResult(draw(counts), draw(counts), rollout, draw(snapshots(group))))


failures = st.builds(UnitFailure, headers, counts, counts, plain_texts)
all_messages = st.one_of(
    st.builds(Ready, headers, plain_texts),
    st.builds(Refused, headers, plain_texts),
    unit_messages(),
    result_messages(),
    failures,
)


def bits(value: Any) -> Any:
    """Return plain values that are equal if and only if every bit is."""
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    if isinstance(value, float):
        return np.float64(value).tobytes()
    if isinstance(value, tuple):
        return tuple(bits(item) for item in value)
    if hasattr(value, "__dataclass_fields__"):
        return (type(value).__name__, {name: bits(getattr(value, name)) for name in value.__dataclass_fields__})
    return value


@settings(max_examples=60)
@given(all_messages)
def test_a_message_arrives_bit_for_bit(message: Message) -> None:
    assert bits(decode(encode(message))) == bits(message)


@settings(max_examples=60)
@given(all_messages, st.data())
def test_a_message_cut_short_or_with_other_frames_is_refused(message: Message, data: st.DataObject) -> None:
    frames = encode(message)
    index = data.draw(st.integers(0, len(frames) - 1))
    for damaged in (
        [*frames[:index], frames[index] + b"\0", *frames[index + 1 :]],
        [*frames, b""],
        frames[:-1],
    ):
        with pytest.raises(MessageError):
            decode(damaged)
    if frames[index]:
        with pytest.raises(MessageError):
            decode([*frames[:index], frames[index][:-1], *frames[index + 1 :]])


@settings(max_examples=100)
@given(all_messages, st.data())
def test_a_flipped_byte_gives_a_message_or_an_error_and_nothing_else(message: Message, data: st.DataObject) -> None:
    frames = encode(message)
    index = data.draw(st.integers(0, len(frames) - 1).filter(lambda i: len(frames[i]) > 0))
    at = data.draw(st.integers(0, len(frames[index]) - 1))
    flipped = bytearray(frames[index])
    flipped[at] ^= data.draw(st.integers(1, 255))
    with suppress(MessageError):
        decode([*frames[:index], bytes(flipped), *frames[index + 1 :]])


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | plain_texts | st.binary(max_size=20),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(plain_texts | st.integers(0, 9), inner, max_size=5),
    max_leaves=20,
)


@settings(max_examples=150)
@given(st.lists(st.binary(max_size=100), max_size=4), values)
def test_arbitrary_bytes_are_refused(frames: list[bytes], value: Any) -> None:
    for attempt in (frames, [msgpack.packb(value)], [msgpack.packb(value), *frames]):
        with pytest.raises(MessageError):
            decode(attempt)
    for content in (*frames, msgpack.packb(value)):
        with pytest.raises(MessageError):
            decode_report(content)


@settings(max_examples=100)
@given(st.integers(0, 4), values)
def test_any_part_of_a_header_may_be_a_lie(part: int, value: Any) -> None:
    message = UnitFailure(Header("run", "learner.1", "worker.1", 3), 1, 2, "traceback")
    head = msgpack.unpackb(encode(message)[0])
    if value == head[part]:
        return
    head[part] = value
    with pytest.raises(MessageError):
        decode([msgpack.packb(head)])


def result() -> ResultMessage:
    """Return a small result: three steps of two simulators."""
    f4, f8 = np.float32, np.float64
    rollout = Rollout(
        policy_version=4,
        observations=np.zeros((3, 2, 5), f4),
        next_observations=np.zeros((3, 2, 5), f4),
        actions=np.zeros((3, 2, 1), f4),
        log_probs=np.zeros((3, 2), f4),
        terminated=np.zeros((3, 2), np.bool_),
        truncated=np.zeros((3, 2), np.bool_),
        env_rewards=np.zeros((3, 2), f8),
        episode_returns=np.zeros(0, f8),
        episode_lengths=np.zeros(0, np.int64),
    )
    snapshot = Snapshot(np.zeros((2, 7)), np.zeros(2, np.int64), np.zeros(2))
    return ResultMessage(Header("run", "learner.1", "worker.1", 3), UnitResult(4, 1, rollout, snapshot))


LIES: list[tuple[str, Any, str]] = [
    ("shape", [2**30, 2**30, 2**30], "larger than"),
    ("shape", [2**31, 0, 0], "expected"),
    ("shape", [0, 2**30, 2**30], "bytes, which is not|impossible shape|expected"),
    ("shape", [-3, -2, 5], "count"),
    ("shape", [3.0, 2, 5], "count"),
    ("shape", [True, 30, 1], "count"),
    ("shape", [3, 2, 4], "expected|bytes"),
    ("shape", [2, 3, 5], "expected"),
    ("shape", [30], "axes"),
    ("dtype", "<i4", "axes|expected"),
    ("dtype", "|O", "expected"),
    ("dtype", "O", "expected"),
    ("dtype", ">f4", "expected"),
    ("dtype", ["<f4"], "expected"),
    ("name", "rollout.secrets", "no array"),
    ("name", "policy.weight_0", "no array"),
    ("name", "rollout.actions", "twice"),
]


@pytest.mark.parametrize(("part", "lie", "complaint"), LIES)
def test_a_lie_about_an_array_is_refused_without_reserving_memory(part: str, lie: Any, complaint: str) -> None:
    frames = encode(result())
    head = msgpack.unpackb(frames[0])
    assert head[4][0][0] == "rollout.observations"
    head[4][0][("name", "dtype", "shape").index(part)] = lie
    tracemalloc.start()
    try:
        with pytest.raises(MessageError, match=complaint):
            decode([msgpack.packb(head), *frames[1:]])
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "content",
    [
        b"\xdd\xff\xff\xff\xff",  # an array of 2**32 - 1 items
        b"\xdf\xff\xff\xff\xff",  # a map of as many
        b"\xdb\xff\xff\xff\xff",  # a text of as many bytes
        b"\xc6\xff\xff\xff\xff",  # bytes
        b"\xc9\xff\xff\xff\xff\x01",  # an extension
        b"\xd4\x01\x00",  # a small extension
        b"\xd6\xff\x00\x00\x00\x00",  # a time, msgpack's own extension
        b"\x91" * 10_000,  # lists in lists
        b"\xa2\xff\xff",  # a text that is not UTF-8
        b"\xc1",  # no value at all
        b"",
    ],
)
def test_what_msgpack_might_fall_for_is_refused(content: bytes) -> None:
    tracemalloc.start()
    try:
        for decoder in (lambda: decode([content]), lambda: decode_report(content)):
            with pytest.raises(MessageError):
                decoder()
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_a_message_of_another_schema_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = encode(Ready(Header("run", "", "worker.1", 0), "numpy 2"))
    monkeypatch.setattr(messages, "SCHEMA", messages.SCHEMA + 1)
    with pytest.raises(MessageError, match="schema"):
        decode(frames)


def test_arrays_in_another_layout_are_not_sent() -> None:
    sent = result()
    rollout = Rollout(**vars(sent.result.rollout) | {"observations": np.zeros((5, 2, 3), np.float32).T})
    with pytest.raises(MessageError, match="C-contiguous"):
        encode(ResultMessage(sent.header, UnitResult(4, 1, rollout, sent.result.snapshot)))


def test_a_byte_that_is_no_truth_value_is_refused() -> None:
    frames = encode(result())
    names = [entry[0] for entry in msgpack.unpackb(frames[0])[4]]
    frames[1 + names.index("rollout.terminated")] = b"\x02" * 6
    with pytest.raises(MessageError, match="truth"):
        decode(frames)


reports = st.one_of(
    st.just(Stop()),
    st.builds(Progress, counts, counts, st.dictionaries(plain_texts, st.floats(allow_nan=False), max_size=4)),
    st.builds(Warn, plain_texts),
    st.builds(Silent, plain_texts),
    st.builds(Finished, plain_texts),
    st.builds(Failed, plain_texts),
)


@given(reports)
def test_a_report_arrives_as_it_was(report: Report) -> None:
    assert decode_report(encode_report(report)) == report


@given(texts)
def test_any_text_can_be_reported(text: str) -> None:
    received = decode_report(encode_report(Failed(text)))
    assert received == Failed(text.encode(errors="backslashreplace").decode())


def test_a_long_traceback_keeps_its_ends() -> None:
    text = shortened("first" + "x" * 10**6 + "last")
    assert text.startswith("first") and text.endswith("last")
    assert decode_report(encode_report(Failed(text))) == Failed(text)
