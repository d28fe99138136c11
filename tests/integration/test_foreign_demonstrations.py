"""Demonstrations in other formats, with the real libraries: every bit arrives, and what cannot be used is named."""

import csv
import io
import json
import pickle
from collections.abc import Callable
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer
from typer.testing import CliRunner

from oodil.cli import app
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.datasets import read_demonstrations
from oodil.pipeline.datasets.export import export
from oodil.pipeline.datasets.foreign import read_foreign
from oodil.pipeline.errors import DataError
from tests.minari_sets import save_minari

HOPPER = "oodil/Hopper-v0"
LENGTHS = (5, 9, 7)


@pytest.fixture
def states() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.standard_normal((length, 12), dtype=np.float32) for length in LENGTHS]


@pytest.fixture
def minari_id(states: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A local data set of three episodes, the second of which the environment ended."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    (tmp_path / "minari").mkdir()
    episodes = [
        EpisodeBuffer(
            observations=s,
            actions=np.zeros((len(s) - 1, 3), np.float32),
            rewards=np.full(len(s) - 1, 0.5 + n),
            terminations=np.array([False] * (len(s) - 2) + [n == 1]),
            truncations=np.array([False] * (len(s) - 2) + [n != 1]),
        )
        for n, s in enumerate(states)
    ]
    save_minari("mine/hopper-v0", episodes)
    return "minari:mine/hopper-v0"


@pytest.fixture
def robomimic_file(states: list[np.ndarray], tmp_path: Path) -> Path:
    """Demonstrations 0, 2 and 10, whose names do not sort like their numbers."""
    path = tmp_path / "lab.hdf5"
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift"})
        for number, s in zip((0, 2, 10), states, strict=True):
            group = data.create_group(f"demo_{number}")
            for name, rows in (("obs", s[:-1]), ("next_obs", s[1:])):
                group[f"{name}/arm"], group[f"{name}/box"] = rows[:, :8], rows[:, 8:]
            group["rewards"] = np.ones(len(s) - 1)
    return path


def assert_same(found: Demonstrations, states: list[np.ndarray]) -> None:
    assert found.lengths.tolist() == [len(s) for s in states]
    assert found.observations.tobytes() == np.concatenate(states).tobytes()


def test_archives_of_arrays(states: list[np.ndarray], tmp_path: Path) -> None:
    np.savez(tmp_path / "each.npz", *states)
    np.savez(tmp_path / "ours.npz", observations=np.concatenate(states), offsets=np.cumsum([0, *LENGTHS]))
    actions = np.cumsum(LENGTHS)[:-1] - np.arange(1, len(LENGTHS))
    rewards = np.ones(sum(LENGTHS) - len(LENGTHS))
    np.savez(
        tmp_path / "imitation.npz",
        obs=np.concatenate(states),
        indices=actions,
        rews=rewards,
        terminal=[True, False, True],
    )
    for name in ("each", "ours", "imitation"):
        found, environment = read_foreign(str(tmp_path / f"{name}.npz"), name, (), ends_are_failures=True)
        assert_same(found, states)
        assert environment == "" and found.source_labels == (name,)
    assert found.returns.tolist() == [4, 8, 6]
    assert found.terminated.tolist() == [True, False, True]


def test_a_minari_data_set(minari_id: str, states: list[np.ndarray]) -> None:
    found, environment = read_foreign(minari_id, "mine", (), ends_are_failures=False)
    assert_same(found, states)
    assert environment == "Hopper-v5"
    assert found.returns.tolist() == [2.0, 12.0, 15.0]
    assert not found.terminated.any()
    assert read_foreign(minari_id, "mine", (), ends_are_failures=True)[0].terminated.tolist() == [False, True, False]


def test_a_truncated_minari_data_set_is_one_message(minari_id: str, tmp_path: Path) -> None:
    (file,) = (tmp_path / "minari").rglob("main_data.hdf5")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(DataError, match=r"not a sound Minari data set .OSError"):
        read_foreign(minari_id, "mine", (), ends_are_failures=False)


def test_a_minari_data_set_without_rewards_is_one_message(minari_id: str, tmp_path: Path) -> None:
    (file,) = (tmp_path / "minari").rglob("main_data.hdf5")
    with h5py.File(file, "r+") as opened:
        del opened["episode_1/rewards"]
    with pytest.raises(DataError, match=r"not a sound Minari data set .KeyError"):
        read_foreign(minari_id, "mine", (), ends_are_failures=False)


def test_a_robomimic_file(robomimic_file: Path, states: list[np.ndarray]) -> None:
    found, environment = read_foreign(str(robomimic_file), "lab", ("arm", "box"), ends_are_failures=False)
    assert_same(found, states)
    assert environment == "Lift" and found.returns.tolist() == [4, 8, 6]


@pytest.mark.parametrize("wrap", [list, lambda s: {"obs": s, "next_obs": 0}, lambda s: (s, "actions")])
def test_pickles_of_the_released_code(states: list[np.ndarray], tmp_path: Path, wrap: Callable) -> None:
    path = tmp_path / "batch.pkl"
    path.write_bytes(pickle.dumps(wrap([s.astype(np.float64) for s in states])))
    assert_same(read_foreign(str(path), "batch", (), ends_are_failures=False)[0], states)


class Harm:
    def __reduce__(self) -> tuple:
        return (Path.touch, (Path("harm-was-done"),))


def test_a_pickle_that_is_a_program_is_refused_unexecuted(
    states: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for content in (Harm(), [states[0], Harm()], {"obs": Harm()}):
        (tmp_path / "bad.pkl").write_bytes(pickle.dumps(content))
        with pytest.raises(DataError, match=r"bad\.pkl: .*neither an array nor a container"):
            read_foreign(str(tmp_path / "bad.pkl"), "bad", (), ends_are_failures=False)
    assert not (tmp_path / "harm-was-done").exists()


def archive(**arrays: object) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npz", archive(x0=np.zeros((3, 2)), x1=np.zeros((3, 4))), r"demonstration 1 has states of shape \(3, 4\)"),
        ("a.npz", archive(x0=np.zeros((3, 2)), x1=np.zeros((1, 2))), r"demonstration 1 \(x1\) has 1 state.*at least 2"),
        ("a.npz", archive(x=np.array([[0.0], [np.nan]])), "demonstration 0 has the value nan in state 1"),
        ("a.npz", archive(x=np.array([[0.0], [1e300]])), "demonstration 0 has the value inf in state 1"),
        ("a.npz", archive(x=np.array([{}, 1], object)), "demonstration 0: entry 'x' holds object, not real numbers"),
        ("a.npz", archive(x=np.zeros((3, 2)))[:60], "not a sound NumPy archive"),
        ("a.hdf5", b"nothing", "not a sound HDF5 file"),
        ("a.pkl", b"nothing", "not a pickle of demonstrations"),
        ("a.pkl", pickle.dumps({"acts": []}), "has no entry 'x', only acts"),
        ("a.pkl", pickle.dumps([]), "holds list, not a list of arrays"),
        ("a.csv", b"", "unknown format; give FILE.npz"),
    ],
    ids=range(11),
)
def test_what_cannot_be_used_is_named(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=message) as error:
        read_foreign(str(tmp_path / name), "a", ("x",), ends_are_failures=False)
    assert str(tmp_path / name) in str(error.value)


def test_entries_have_to_be_chosen_and_to_exist(robomimic_file: Path, minari_id: str) -> None:
    with pytest.raises(DataError, match="entries arm, box; choose with --keys"):
        read_foreign(str(robomimic_file), "lab", (), ends_are_failures=False)
    with pytest.raises(DataError, match="no entry 'leg'; there are arm, box"):
        read_foreign(str(robomimic_file), "lab", ("arm", "leg"), ends_are_failures=False)
    with h5py.File(robomimic_file, "r+") as file:
        del file["data/demo_0"], file["data/demo_2"], file["data/demo_10"]
    with pytest.raises(DataError, match="has no entry 'arm', only nothing"):
        read_foreign(str(robomimic_file), "lab", ("arm",), ends_are_failures=False)
    with pytest.raises(DataError, match="not a local Minari data set"):
        read_foreign("minari:nobody/nothing-v0", "lab", (), ends_are_failures=False)


def test_the_command_joins_sources_into_one_file(
    states: list[np.ndarray], robomimic_file: Path, tmp_path: Path
) -> None:
    np.savez(tmp_path / "bench.npz", *states)
    output = tmp_path / "out.safetensors"
    arguments = ["demos", "convert", str(robomimic_file), str(tmp_path / "bench.npz"), "--keys", "arm,box"]
    result = CliRunner().invoke(app, [*arguments, "--environment", HOPPER, "--output", str(output)])
    assert result.exit_code == 0, result.output
    found, environment = read_demonstrations(output)
    assert_same(found, [*states, *states])
    assert environment == HOPPER and found.source_labels == ("lab", "bench")
    assert found.sources.tolist() == [0, 0, 0, 1, 1, 1]
    np.savez(tmp_path / "narrow.npz", np.zeros((3, 2)))
    result = CliRunner().invoke(app, [*arguments, str(tmp_path / "narrow.npz"), "--environment", HOPPER])
    assert result.exit_code == 2 and "narrow has states with 2 dimensions; lab has 12" in result.output


FOUND = {
    "cluster": np.array([1, 0, 1], np.int32),
    "transferability": np.array([0.25, 0.5, 0.01]),
    "weight": np.array([0.3, 0.7, 0.0]),
}


def test_export_to_a_table(states: list[np.ndarray], tmp_path: Path) -> None:
    demonstrations = Demonstrations.of([Episode(s) for s in states], "lab")
    export(demonstrations, FOUND, str(tmp_path / "found.csv"))
    rows = list(csv.DictReader((tmp_path / "found.csv").open()))
    assert [row["states"] for row in rows] == ["5", "9", "7"]
    assert [float(row["transferability"]) for row in rows] == [0.25, 0.5, 0.01]
    assert [int(row["cluster"]) for row in rows] == [1, 0, 1]
    with pytest.raises(DataError, match="unknown format"):
        export(demonstrations, FOUND, str(tmp_path / "found.xlsx"))


def test_export_to_where_they_came_from(
    states: list[np.ndarray], robomimic_file: Path, minari_id: str, tmp_path: Path
) -> None:
    demonstrations = Demonstrations.of([Episode(s) for s in states], "lab", ("arm", "box"))
    for _ in range(2):  # a second export replaces the first
        export(demonstrations, FOUND, str(robomimic_file))
        export(demonstrations, FOUND, minari_id)
    with h5py.File(robomimic_file) as file:
        assert file["mask/oodil_transferable"][:].tolist() == [b"demo_2"]
        assert file["mask/oodil_cluster_1"][:].tolist() == [b"demo_0", b"demo_10"]
        assert file["data/demo_10"].attrs["oodil_transferability"] == 0.01
    metadata = list(minari.load_dataset("mine/hopper-v0").storage.get_episode_metadata([0, 1, 2]))
    assert [entry["oodil_cluster"] for entry in metadata] == [1, 0, 1]
    assert [entry["oodil_weight"] for entry in metadata] == [0.3, 0.7, 0.0]
    assert_same(read_foreign(minari_id, "lab", (), ends_are_failures=False)[0], states)
    fewer = Demonstrations.of([Episode(s) for s in states[:2]], "lab", ("arm", "box"))
    for target in (str(robomimic_file), minari_id):
        with pytest.raises(DataError, match=r"3 (demonstrations|episodes).*the run has 2"):
            export(fewer, {name: column[:2] for name, column in FOUND.items()}, target)
    with pytest.raises(DataError, match="not a local Minari data set"):
        export(demonstrations, FOUND, "minari:nobody/nothing-v0")
