"""Which arrays of a recording are demonstrations: names decide, and what they do not tell is refused."""

import pickle
from collections import OrderedDict, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from oodil.pipeline.datasets.foreign import check_output, labels_of, read_foreign
from oodil.pipeline.errors import DataError

LENGTHS = (6, 3, 9)
M, N = sum(LENGTHS), len(LENGTHS)
STARTS = np.cumsum([0, *LENGTHS])
STATES = np.random.default_rng(1).standard_normal((M, 5)).astype(np.float32)
EACH = np.split(STATES, STARTS[1:-1])
REWARDS = np.arange(M, dtype=float)
LAST = np.isin(np.arange(M), STARTS[1:] - 1)
OTHER = np.zeros_like(STATES)


def read(path: Path, keys: str = "", ends_are_failures: bool = False) -> tuple[Any, list[str]]:
    """Return the demonstrations of a file and what was said of it."""
    said: list[str] = []
    chosen = tuple(keys.split()) if keys else ()
    return read_foreign(str(path), "lab", chosen, ends_are_failures, warn=said.append)[0], said


def npz(folder: Path, **arrays: Any) -> Path:
    np.savez(folder / "a.npz", **arrays)
    return folder / "a.npz"


def pkl(folder: Path, content: Any, protocol: int = 5) -> Path:
    (folder / "a.pkl").write_bytes(pickle.dumps(content, protocol=protocol))
    return folder / "a.pkl"


def assert_each(found: Any, each: list[np.ndarray] = EACH) -> None:
    assert found.lengths.tolist() == [len(states) for states in each]
    assert found.observations.tobytes() == np.concatenate(each).astype(np.float32).tobytes()


def objects(parts: list[Any]) -> np.ndarray:
    found = np.empty(len(parts), object)
    found[:] = parts
    return found


@pytest.mark.parametrize(
    "columns",
    [
        {"observations": STATES, "offsets": STARTS},
        {"observations": STATES, "actions": OTHER, "offsets": STARTS.astype(np.int32)},
        {"obs": STATES, "actions": OTHER, "episode_starts": np.roll(LAST, 1)},
        {"observations": STATES, "next_observations": OTHER[:, :0], "dones": LAST},
        {"states": STATES, "actions": OTHER, "episode_ends": STARTS[1:]},
        {"states": STATES, "lengths": LENGTHS},
        {"observations": STATES, "terminals": LAST & (REWARDS < 6), "timeouts": LAST & (REWARDS > 6)},
        {"observation": STATES, "episode_id": np.repeat([4, 2, 7], LENGTHS)},
        {"obs": STATES, "acts": STATES[:-N], "indices": STARTS[1:-1] - np.arange(1, N)},
        {"observations": objects(EACH), "actions": objects(EACH)},
        {"demo_1": EACH[1], "demo_0": EACH[0], "demo_10": EACH[2]},
        {"obs_0": EACH[0], "act_0": EACH[0], "obs_1": EACH[1], "act_1": EACH[1], "obs_2": EACH[2], "act_2": EACH[2]},
    ],
    ids=lambda columns: " ".join(columns)[:40],
)
def test_columns_by_their_names(tmp_path: Path, columns: dict[str, Any]) -> None:
    if columns.get("next_observations") is not None:
        columns = columns | {"next_observations": STATES}
        assert_each(read(npz(tmp_path, **columns))[0], [np.concatenate((states, states[-1:])) for states in EACH])
    else:
        assert_each(read(npz(tmp_path, **columns))[0])


def test_one_array_or_dictionary_alone_holds_all_demonstrations(tmp_path: Path) -> None:
    equal = [states[:2] for states in EACH]
    for alone, each in (
        (np.stack(equal), equal),
        (objects(EACH), EACH),
        (objects([{"obs": states, "act": states[:, :2]} for states in EACH]), EACH),
        (np.array({"observations": EACH}, dtype=object), EACH),
    ):
        np.savez(tmp_path / "alone.npz", alone)
        assert_each(read(tmp_path / "alone.npz")[0], each)
        assert_each(read(npz(tmp_path, trajectories=alone))[0], each)
    assert_each(read(npz(tmp_path, demo_0=EACH[0].reshape(len(EACH[0]), -1, 1)))[0], EACH[:1])


def test_actions_of_the_same_width_are_no_demonstration(tmp_path: Path) -> None:
    for name in ("actions", "acts", "velocities"):
        found, said = read(npz(tmp_path, observations=STATES, **{name: OTHER}))
        assert_each(found, [STATES])
        assert said == [
            f"{tmp_path / 'a.npz'}: nothing says where a demonstration ends; its 18 states are taken as one"
        ]


def test_next_states_say_where_a_demonstration_ends(tmp_path: Path) -> None:
    before = np.concatenate([states[:-1] for states in EACH])
    after = np.concatenate([states[1:] for states in EACH])
    for names in (("observations", "next_observations"), ("obs", "next_obs"), ("obs", "next_observations")):
        found, said = read(npz(tmp_path, **dict(zip(names, (before, after), strict=True)), actions=before))
        assert_each(found)
        assert "2 of them are not in the next row" in said[0]
    with pytest.raises(DataError, match="no next state is the state of the next row"):
        read(npz(tmp_path, obs=before[::-1], next_obs=after[::-1]))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"observations": STATES, "offsets": STARTS[:-1]}, "offsets end at 9 but there are 18 states"),
        ({"observations": STATES, "offsets": STARTS[1:]}, "does not start at the first state"),
        ({"observations": STATES, "offsets": [0, 9, 9, 18]}, "offsets: demonstration 1 has no state"),
        ({"observations": STATES, "offsets": STARTS + 0.5}, "offsets are float64.*expected whole numbers"),
        ({"observations": STATES, "lengths": [6, 3]}, "lengths end at 9 but there are 18 states"),
        ({"observations": STATES, "episode_ends": STARTS[1:-1]}, "episode_ends end at 9"),
        ({"observations": STATES, "dones": LAST[:-1]}, r"dones have the shape \(17,\), but there are 18 states"),
        ({"obs": STATES, "episode_starts": LAST}, "does not start at the first state"),
        ({"obs": STATES, "episode_index": [0, 1] * 9}, "not together"),
        ({"qpos": STATES, "qvel": STATES}, "choose with --keys of qpos, qvel"),
        ({"joints_1": EACH[0], "speed_1": EACH[0]}, "choose with --keys of joints_1, speed_1"),
        ({"observations": STATES.astype(str)}, "entry 'observations' holds <U"),
        ({"obs": STATES, "rewards": REWARDS[:4]}, "rewards have 4 entries"),
    ],
    ids=range(13),
)
def test_what_does_not_cover_everything_or_cannot_be_told_is_refused(
    tmp_path: Path, columns: dict[str, Any], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        read(npz(tmp_path, **columns))


def test_keys_choose_and_returns_come_along(tmp_path: Path) -> None:
    path = npz(tmp_path, qpos=STATES[:, :2], qvel=STATES[:, 2:], rewards=REWARDS, terminals=LAST & (REWARDS < 6))
    found, said = read(path, "qvel qpos", ends_are_failures=True)
    swapped = STATES[:, [2, 3, 4, 0, 1]]
    assert found.observations.tobytes() == swapped.tobytes() and found.source_keys == (("qvel", "qpos"),)
    assert found.lengths.tolist() == [6, 12], "a time limit that is not marked joins two"
    assert found.returns.tolist() == [15.0, 138.0] and found.terminated.tolist() == [True, False]
    assert "several may have become one" in said[0]
    with pytest.raises(DataError, match="no entry 'qacc', only qpos, qvel, rewards, terminals"):
        read(path, "qpos qacc")


def steps(states: np.ndarray) -> list[dict[str, Any]]:
    end = len(states) - 1
    return [{"observation": s, "action": s[:2], "reward": 1.0, "done": t == end} for t, s in enumerate(states)]


PICKLES: dict[str, Callable[[], Any]] = {
    "list": lambda: EACH,
    "float64": lambda: [states.astype(np.float64) for states in EACH],
    "transposed in memory": lambda: [np.asfortranarray(states) for states in EACH],
    "dictionary of lists": lambda: defaultdict(list, {"observations": EACH, "actions": EACH}),
    "list of dictionaries": lambda: [OrderedDict(observations=s, actions=s, env_infos={"a": [1]}) for s in EACH],
    "dictionary by number": lambda: {n: {"obs": states} for n, states in enumerate(EACH)},
    "lists of steps": lambda: [steps(states) for states in EACH],
    "steps in a row": lambda: [step for states in EACH for step in steps(states)],
    "lists of numbers": lambda: [states.tolist() for states in EACH],
    "states, then actions": lambda: (EACH, [s[:, :1] for s in EACH]),
    "objects": lambda: objects(EACH),
    "columns": lambda: {"obs": STATES, "dones": LAST},
}


@pytest.mark.parametrize("kind", PICKLES)
@pytest.mark.parametrize("protocol", range(6))
def test_pickles_of_every_protocol(tmp_path: Path, kind: str, protocol: int) -> None:
    assert_each(read(pkl(tmp_path, PICKLES[kind](), protocol))[0])


def test_pickles_of_numpy_before_2(tmp_path: Path) -> None:
    for protocol in (2, 4, 5):
        content = pickle.dumps(EACH, protocol=protocol)
        if protocol == 2:  # names are ended by a line feed, and not counted
            content = content.replace(b"numpy._core.", b"numpy.core.")
        else:
            for module in (b"multiarray", b"numeric"):
                new, old = b"numpy._core." + module, b"numpy.core." + module
                content = content.replace(bytes([len(new)]) + new, bytes([len(old)]) + old)
            content = content[:2] + b"\x95" + (len(content) - 11).to_bytes(8, "little") + content[11:]
        assert b"numpy.core." in content and b"numpy._core." not in content
        (tmp_path / "a.pkl").write_bytes(content)
        assert_each(read(tmp_path / "a.pkl")[0])


class Harm:
    def __reduce__(self) -> tuple:
        return (Path.touch, (Path("harm-was-done"),))


def test_objects_in_an_archive_are_unpickled_by_the_same_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match="neither an array nor a container"):
        read(npz(tmp_path, observations=objects([EACH[0], Harm()])))
    assert_each(read(npz(tmp_path, observations=STATES, offsets=STARTS, infos=objects([Harm()])))[0])
    assert not (tmp_path / "harm-was-done").exists()


def test_padded_arrays_end_where_their_lengths_say(tmp_path: Path) -> None:
    padded = np.zeros((N, 9, 5), np.float32)
    for n, states in enumerate(EACH):
        padded[n, : len(states)] = states
    found, _ = read(npz(tmp_path, states=padded, lengths=LENGTHS, rewards=np.ones((N, 9)), actions=padded))
    assert_each(found)
    assert found.returns.tolist() == [6, 3, 9]
    assert_each(read(npz(tmp_path, observations=padded))[0], list(padded))
    with pytest.raises(DataError, match="lengths do not fit 3 demonstrations of 9 states"):
        read(npz(tmp_path, states=padded, lengths=[6, 3, 10]))


def test_states_of_two_axes_are_flattened(tmp_path: Path) -> None:
    stacked = STATES[:, :4].reshape(M, 2, 2)
    found, _ = read(npz(tmp_path, observations=stacked, offsets=STARTS))
    assert found.observations.tobytes() == STATES[:, :4].tobytes() and len(found) == N
    found, _ = read(pkl(tmp_path, np.split(stacked, STARTS[1:-1])))
    assert found.observations.tobytes() == STATES[:, :4].tobytes() and len(found) == N


def test_a_demonstration_that_cannot_be_used_is_named_by_number(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"demonstration 2 .*has 1 state\(s\)"):
        read(pkl(tmp_path, [{"obs": EACH[0]}, {"obs": EACH[1]}, {"obs": EACH[2][:1]}]))
    with pytest.raises(DataError, match=r"demonstration 1.*has no entry"):
        read(pkl(tmp_path, [{"obs": EACH[0]}, {"acts": EACH[1]}]))


def test_what_32_bits_lose_is_said(tmp_path: Path) -> None:
    walk = np.cumsum(np.full((50, 3), 0.004), axis=0)
    _, said = read(npz(tmp_path, observations=walk + np.array([0, 3.7e6, 0])))
    assert any("1 of 3 numbers of a state lose part of their movement, number 1" in each for each in said)
    assert len(read(npz(tmp_path, observations=walk + 100, offsets=[0, 50]))[1]) == 0


def test_a_pointer_of_git_lfs_is_not_the_file(tmp_path: Path) -> None:
    for name in ("a.npz", "a.hdf5", "a.pkl"):
        (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 12\n")
        with pytest.raises(DataError, match="Git LFS"):
            read(tmp_path / name)


def test_files_of_one_name_have_labels_that_differ() -> None:
    assert labels_of(["a/b.npz", "c/d.npz"]) == ["b", "d"]
    assert labels_of(["x/a/b.npz", "x/c/b.npz", "x/c/e.npz"]) == ["a/b", "c/b", "e"]
    assert labels_of(["x/a/b.npz", "y/a/b.npz", "minari:a/b-v0"]) == ["x/a/b", "y/a/b", "minari:a/b-v0"]
    assert labels_of(["a/b.npz", "a/b.hdf5"]) == ["b.npz", "b.hdf5"]
    with pytest.raises(DataError, match=r"a/b.npz: is given twice"):
        labels_of(["a/b.npz", "a/../a/b.npz"])


def test_the_output_is_no_input(tmp_path: Path) -> None:
    (tmp_path / "b.safetensors").write_bytes(b"")
    (tmp_path / "link.safetensors").symlink_to(tmp_path / "b.safetensors")
    for output, message in (
        (tmp_path / "link.safetensors", "what was to be read"),
        (tmp_path / "a.npz", "are written as FILE.safetensors"),
        (tmp_path / "none" / "a.safetensors", "no such folder"),
    ):
        with pytest.raises(DataError, match=message):
            check_output(output, [str(tmp_path / "b.safetensors"), "minari:a/b-v0"])
