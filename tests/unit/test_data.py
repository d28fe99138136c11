"""Demonstrations: their parts, and a message for each bad input that names demonstration, value and limit."""

from dataclasses import fields, replace

import numpy as np
import pytest

from oodil.pipeline.data import Demonstrations, TransitionBatch
from oodil.pipeline.datasets import decode_demonstrations, encode_demonstrations
from oodil.pipeline.errors import DataError


def make(lengths=(3, 2, 4), **changes):
    total = sum(lengths)
    parts = {
        "observations": np.arange(total * 2, dtype=np.float32).reshape(total, 2),
        "offsets": np.cumsum([0, *lengths]).astype(np.int64),
        "sources": np.arange(len(lengths), dtype=np.int32) % 2,
        "source_labels": ("a", "b"),
        "returns": np.linspace(0, 1, len(lengths)),
        "terminated": np.arange(len(lengths)) == 2,
    }
    return Demonstrations(**(parts | changes))


def test_parts():
    made = make()
    assert (len(made), made.observation_dim) == (3, 2)
    assert made.lengths.tolist() == [3, 2, 4]
    assert [made[n][0, 0] for n in range(3)] == [0, 6, 10]
    assert [len(made[n]) for n in range(3)] == [3, 2, 4]


def test_transitions_start_everywhere_but_at_the_last_states():
    # rows 0 1 2 | 3 4 | 5 6 7 8
    assert make().transition_starts().tolist() == [0, 1, 3, 5, 6, 7]


def test_select_keeps_order_and_labels():
    chosen = make().select(np.array([2, 0]))
    assert chosen.lengths.tolist() == [4, 3]
    np.testing.assert_array_equal(chosen[1], make()[0])
    assert chosen.sources.tolist() == [0, 0]
    assert chosen.returns.tolist() == [1.0, 0.0]
    assert chosen.terminated.tolist() == [True, False]
    assert chosen.transition_starts().tolist() == [0, 1, 2, 4, 5]


def test_unknown_returns_are_legal():
    assert np.isnan(make(returns=np.full(3, np.nan)).returns).all()


def with_value(value, row):
    observations = np.zeros((9, 2), np.float32)
    observations[row, 1] = value
    return observations


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": np.zeros((9, 2))}, r"float64\(9, 2\).*float32"),
        ({"observations": np.zeros(9, np.float32)}, r"float32\(9,\)"),
        ({"observations": np.zeros((9, 0), np.float32)}, r"\(9, 0\)"),
        ({"offsets": np.array([0])}, "at least one demonstration"),
        ({"offsets": np.array([1, 3, 5, 9])}, "start at 0"),
        ({"offsets": np.array([[0, 3, 5, 9]])}, r"\(N \+ 1,\)"),
        ({"offsets": np.array([0, 3, 5, 8])}, "end at 8 but there are 9 states"),
        ({"offsets": np.array([0, 3, 4, 9])}, r"demonstration 1 has 1 state.*at least 2"),
        ({"offsets": np.array([0, 3, 3, 9])}, r"demonstration 1 has 0 state.*at least 2"),
        ({"offsets": np.array([0, 6, 4, 9])}, r"demonstration 1 has -2 state.*at least 2"),
        ({"observations": with_value(np.nan, 4)}, "demonstration 1 has the value nan in state 1; must be finite"),
        ({"observations": with_value(-np.inf, 8)}, "demonstration 2 has the value -inf in state 3; must be finite"),
        ({"observations": with_value(np.inf, 0)}, "demonstration 0 has the value inf in state 0; must be finite"),
        ({"sources": np.zeros(2, np.int32)}, "each of the 3 demonstrations"),
        ({"returns": np.zeros(4)}, "each of the 3 demonstrations"),
        ({"terminated": np.zeros(1, np.bool_)}, "terminated must have one entry for each of the 3 demonstrations"),
        ({"sources": np.array([0, 1, 2], np.int32)}, r"\[0, 2\)"),
        ({"sources": np.array([0, -1, 1], np.int32)}, r"\[0, 2\)"),
    ],
)
def test_bad_demonstrations_are_refused(changes, message):
    with pytest.raises(DataError, match=message):
        make(**changes)


def test_nothing_selected_is_refused():
    with pytest.raises(DataError, match="no demonstration"):
        make().select(np.array([], np.int64))


def test_equal_demonstrations_are_equal_files(demonstrations):
    made = demonstrations(4, 3)
    files = {encode_demonstrations(made, "oodil/Hopper-v0") for _ in range(20)}
    assert len(files) == 1
    read, environment = decode_demonstrations(files.pop(), "here")
    assert environment == "oodil/Hopper-v0" and read.source_labels == made.source_labels
    assert read.observations.tobytes() == made.observations.tobytes()
    assert read.offsets.tolist() == made.offsets.tolist()


def test_a_batch_is_the_rollouts_side_by_side(rollout):
    first, second = rollout(0, num_simulators=2), rollout(1, num_simulators=3)
    first = replace(first, episode_returns=np.array([1.0, 2.0]), episode_lengths=np.array([10, 20]))
    second = replace(second, episode_returns=np.array([3.0]), episode_lengths=np.array([30]))
    batch = TransitionBatch.of([first, second])
    assert len(batch) == 6 * 5
    assert batch.observations.shape == (6, 5, 3)
    for field in fields(batch):
        joined, parts = getattr(batch, field.name), [getattr(part, field.name) for part in (first, second)]
        if field.name == "policy_version":
            assert joined == 0
        elif field.name.startswith("episode"):
            np.testing.assert_array_equal(joined, np.concatenate(parts))
        else:
            assert joined.dtype == parts[0].dtype
            np.testing.assert_array_equal(joined[:, :2], parts[0], err_msg=field.name)
            np.testing.assert_array_equal(joined[:, 2:], parts[1], err_msg=field.name)
    np.testing.assert_array_equal(batch.ended, batch.terminated | batch.truncated)


def test_a_batch_has_one_policy_version(rollout):
    with pytest.raises(ValueError, match=r"one policy version; these have \[0, 3\]"):
        TransitionBatch.of([rollout(0), replace(rollout(1), policy_version=3)])
    with pytest.raises(ValueError, match=r"these have \[\]"):
        TransitionBatch.of([])
