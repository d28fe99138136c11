"""Recordings as they are, with the real libraries: what is read of them, what is refused, and what goes back."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import minari
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from typer.testing import CliRunner

import oodil
from oodil.cli import app
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.datasets import encode_demonstrations, read_demonstrations
from oodil.pipeline.datasets.export import export
from oodil.pipeline.datasets.foreign import read_foreign
from oodil.pipeline.errors import DataError
from tests.runs import MICRO, ROOT

PENDULUM = "Pendulum-v1"
LENGTHS = (7, 4, 11, 5)
EACH = [np.random.default_rng(n).standard_normal((length, 3), dtype=np.float32) for n, length in enumerate(LENGTHS)]
STATES = np.concatenate(EACH)
FOUND = {
    "cluster": np.array([2, 0, 2, 1], np.int32),
    "transferability": np.array([0.5, 0.25, 0.125, 1.0]),
    "weight": np.array([0.4, 0.1, 0.1, 0.4]),
}


def read(source: str | Path, *keys: str) -> Demonstrations:
    return read_foreign(str(source), "lab", keys, ends_are_failures=False)[0]


def assert_each(found: Demonstrations, each: list[np.ndarray] = EACH) -> None:
    assert found.lengths.tolist() == [len(states) for states in each]
    assert found.observations.tobytes() == np.concatenate(each).tobytes()


def command(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(each) for each in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


def convert(output: Path, *sources: object, environment: str = PENDULUM) -> tuple[int, str]:
    return command("demos", "convert", *sources, "--environment", environment, "--output", output)


# HDF5


def groups(path: Path, form: Callable[[np.ndarray], dict[str, Any]], at: str = "data/demo_{}") -> Path:
    """Write a group a demonstration, numbers 0, 5, 10 and 15, whose names do not sort like their numbers."""
    with h5py.File(path, "w") as file:
        for n, states in enumerate(EACH):
            for name, values in form(states).items():
                file[f"{at.format(5 * n)}/{name}"] = values
    return path


def robomimic(states: np.ndarray) -> dict[str, Any]:
    return {
        "obs/robot/arm": states[:-1, :2],
        "next_obs/robot/arm": states[1:, :2],
        "obs/box": states[:-1, 2:],
        "next_obs/box": states[1:, 2:],
        "actions": np.zeros((len(states) - 1, 2)),
        "rewards": np.ones(len(states) - 1),
    }


def test_relatives_of_robomimic(tmp_path: Path) -> None:
    nested = groups(tmp_path / "nested.hdf5", robomimic)
    for keys in (("robot/arm", "box"), ("obs/robot/arm", "obs/box")):
        assert_each(read(nested, *keys))
    assert read(nested, "box").returns.tolist() == [6, 3, 10, 4]
    with pytest.raises(DataError, match=r"entry 'robot' has entries itself; choose of robot/arm"):
        read(nested, "robot", "box")
    assert_each(read(groups(tmp_path / "a.hdf5", lambda s: {"states": s, "actions": s})))
    assert_each(read(groups(tmp_path / "b.hdf5", lambda s: {"observation": s, "action": s}, "demo_{}")))
    assert_each(read(groups(tmp_path / "c.hdf5", lambda s: {"obs": s, "rewards": s[1:, 0]}, "traj_{}")))


def test_an_hdf5_demonstration_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    path = groups(tmp_path / "lab.hdf5", robomimic)
    with h5py.File(path, "r+") as file:
        del file["data/demo_15/obs/box"]
    with pytest.raises(
        DataError, match=r"lab.hdf5: demonstration 3 \(demo_15\): .*no entry 'box'; there are robot/arm"
    ):
        read(path, "robot/arm", "box")
    with h5py.File(path, "r+") as file:
        for name in ("obs", "next_obs"):
            del file[f"data/demo_10/{name}/robot/arm"]
            file[f"data/demo_10/{name}/robot/arm"] = np.zeros((0, 2))
    with pytest.raises(DataError, match=r"demonstration 2 \(demo_10\) has 0 state\(s\)"):
        read(path, "robot/arm")


def test_masks_name_demonstrations_in_any_alphabet(tmp_path: Path) -> None:
    path = groups(tmp_path / "lab.hdf5", robomimic, "data/d\N{LATIN SMALL LETTER E WITH ACUTE}mo_{}")
    export(read(path, "robot/arm"), FOUND, str(path))
    with h5py.File(path) as file:
        (first, third) = file["mask/oodil_cluster_2"][:]
    assert (first.decode(), third.decode()) == ("d\xe9mo_0", "d\xe9mo_10")


def test_columns_of_d4rl(tmp_path: Path) -> None:
    last = np.isin(np.arange(len(STATES)), np.cumsum(LENGTHS) - 1)
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["observations"], file["actions"], file["rewards"] = STATES, STATES, np.ones(len(STATES))
        file["terminals"], file["timeouts"] = last & (STATES[:, 0] > 0), last & (STATES[:, 0] <= 0)
        file["infos/qpos"] = STATES
    found = read(tmp_path / "a.hdf5")
    assert_each(found)
    assert found.returns.tolist() == list(LENGTHS)
    assert_each(read(tmp_path / "a.hdf5", "infos/qpos"))


# Minari


@pytest.fixture
def save(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Return a function that makes a local data set of the episodes, and returns its name."""
    (tmp_path / "minari").mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))

    def make(form: Callable[[np.ndarray], Any], space: gymnasium.Space, data_format: str = "hdf5") -> str:
        episodes = [
            EpisodeBuffer(
                id=n,
                observations=form(states),
                actions=np.zeros((len(states) - 1, 1), np.float32),
                rewards=np.full(len(states) - 1, 0.5),
                terminations=np.zeros(len(states) - 1, np.bool_),
                truncations=np.arange(len(states) - 1) == len(states) - 2,
            )
            for n, states in enumerate(EACH)
        ]
        about = dict.fromkeys(("algorithm_name", "author", "author_email", "code_permalink", "description"), "x")
        minari.create_dataset_from_buffers(
            "lab/set-v0", episodes, observation_space=space, action_space=box(1), data_format=data_format, **about
        )
        return "minari:lab/set-v0"

    return make


def box(*shape: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, shape, np.float32)


def test_minari_with_dictionaries_in_dictionaries(save: Callable[..., str]) -> None:
    space = spaces.Dict(arm=spaces.Dict(pos=box(1), vel=box(1)), goal=box(1))
    name = save(lambda s: {"arm": {"pos": s[:, :1], "vel": s[:, 1:2]}, "goal": s[:, 2:]}, space)
    assert_each(read(name, "arm/pos", "arm/vel", "goal"))
    with pytest.raises(DataError, match="entries arm/pos, arm/vel, goal; choose with --keys"):
        read(name)
    with pytest.raises(DataError, match="entry 'arm' has entries itself; choose of arm/pos, arm/vel"):
        read(name, "arm")


def test_minari_with_tuples_of_unequal_parts(save: Callable[..., str]) -> None:
    name = save(lambda s: (s[:, :1], s[:, 1:]), spaces.Tuple((box(1), box(2))))
    assert_each(read(name))
    assert_each(read(name, "1", "0"), [s[:, [1, 2, 0]] for s in EACH])


def test_minari_with_boxes_of_two_axes(save: Callable[..., str]) -> None:
    name = save(lambda s: np.stack((s, 2 * s), axis=1), box(2, 3))
    assert_each(read(name), [np.concatenate((s, 2 * s), axis=1) for s in EACH])


def test_minari_in_the_format_of_arrow(save: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
    name = save(lambda s: s, box(3), "arrow")
    found = read(name)
    assert_each(found)
    export(found, FOUND | {"verdict": np.array(["kept"] * 4)}, name)
    export(found, FOUND, name)
    told = list(minari.load_dataset("lab/set-v0").storage.get_episode_metadata(range(4)))
    assert [each["oodil_cluster"] for each in told] == [2, 0, 2, 1] and "oodil_verdict" not in told[0]
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "minari.dataset._storages.arrow_storage")
    with pytest.raises(DataError, match=r"needs pyarrow; pip install 'oodil\[data\]'"):
        read(name)


def test_a_published_set_that_lacks_last_states_is_marked(save: Callable[..., str], tmp_path: Path) -> None:
    name = save(lambda s: s, box(3))
    with h5py.File(tmp_path / "minari" / "lab/set-v0/data/main_data.hdf5", "r+") as file:
        kept = file["episode_2/observations"][:-1]
        del file["episode_2/observations"]
        file["episode_2/observations"] = kept
    found = read(name)
    assert found.lengths.tolist() == [7, 4, 10, 5]
    export(found, FOUND, name)
    told = list(minari.load_dataset("lab/set-v0").storage.get_episode_metadata(range(4)))
    assert [each["oodil_weight"] for each in told] == [0.4, 0.1, 0.1, 0.4]


# LeRobot


def test_a_folder_of_lerobot(tmp_path: Path) -> None:
    rows = {
        "observation.state": STATES.tolist(),
        "action": STATES.tolist(),
        "episode_index": np.repeat(np.arange(4), LENGTHS),
        "frame_index": np.concatenate([np.arange(length) for length in LENGTHS]),
        "next.reward": np.ones(len(STATES)),
    }
    table = pyarrow.table(rows)
    for number, part in enumerate((table[:9], table[9:])):  # The second demonstration is in two files.
        path = tmp_path / "set" / "data" / "chunk-000" / f"file-{number:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pyarrow.parquet.write_table(part, path)
    found = read(tmp_path / "set")
    assert_each(found)
    assert found.returns.tolist() == list(LENGTHS)
    pyarrow.parquet.write_table(table.take(np.random.default_rng(0).permutation(len(STATES))), tmp_path / "a.parquet")
    assert_each(read(tmp_path / "a.parquet", "observation.state"))
    with pytest.raises(DataError, match=r"has no entry 'observation\.pose'"):
        read(tmp_path / "set", "observation.pose")
    with pytest.raises(DataError, match=r"is a folder, and none of LeRobot's"):
        read(tmp_path)


@pytest.mark.parametrize("row", [None, [0.5], [0.5, np.nan, 0.5]])
def test_rows_of_lerobot_that_are_no_states_are_refused(tmp_path: Path, row: Any) -> None:
    states = STATES.tolist()
    states[3] = row
    table = pyarrow.table({"observation.state": states, "episode_index": np.repeat(np.arange(4), LENGTHS)})
    pyarrow.parquet.write_table(table, tmp_path / "a.parquet")
    with pytest.raises(DataError, match=r"different sizes, or none|must be finite"):
        read(tmp_path / "a.parquet")


def test_a_truncated_parquet_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    pyarrow.parquet.write_table(
        pyarrow.table({"observation.state": STATES.tolist(), "episode_index": np.repeat(np.arange(4), LENGTHS)}), path
    )
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(DataError, match="not a sound parquet file"):
        read(path)


# The command


def test_the_command_checks_before_it_writes(tmp_path: Path) -> None:
    path, output = tmp_path / "demo.npz", tmp_path / "out.safetensors"
    np.savez(path, *EACH)
    before = path.read_bytes()
    for environment, target, message in (
        ("Pendulun-v1", output, "Did you mean: `Pendulum`"),
        ("MountainCarContinuous-v0", output, "states have 3 dimensions; environment MountainCarContinuous-v0 has 2"),
        (PENDULUM, path, "are written as FILE.safetensors"),
    ):
        code, said = convert(target, path, environment=environment)
        assert code == 2 and message in said, said
    assert path.read_bytes() == before and not output.exists()
    assert convert(output, path)[0] == 0
    code, said = command("demos", "inspect", path)
    assert code == 2 and "demo.npz: is no file of ours; oodil demos convert makes one of it" in said


def test_files_of_one_name_and_keys_with_spaces(tmp_path: Path) -> None:
    for lab in ("lab_a", "lab_b"):
        (tmp_path / lab).mkdir()
        groups(tmp_path / lab / "demo.hdf5", robomimic)
    output = tmp_path / "out.safetensors"
    both = [tmp_path / lab / "demo.hdf5" for lab in ("lab_a", "lab_b")]
    code, said = convert(output, *both, "--keys", "robot/arm , box")
    assert code == 0, said
    found, _ = read_demonstrations(output)
    assert found.source_labels == ("lab_a/demo", "lab_b/demo")
    assert found.source_keys == (("robot/arm", "box"),) * 2
    assert_each(found, [*EACH, *EACH])


# Back to where they came from


def test_an_export_leaves_nothing_of_an_earlier_one(tmp_path: Path) -> None:
    path = groups(tmp_path / "lab.hdf5", robomimic)
    with h5py.File(path, "r+") as file:
        file["mask/train"] = np.array(["demo_0"], "S")
    found = read(path, "robot/arm", "box")
    export(found, FOUND | {"low": FOUND["weight"]}, str(path))
    export(found, FOUND | {"cluster": np.array([0, 0, 1, 1])}, str(path))
    with h5py.File(path) as file:
        assert sorted(file["mask"]) == ["oodil_cluster_0", "oodil_cluster_1", "oodil_transferable", "train"]
        assert file["mask/oodil_transferable"][:].tolist() == [b"demo_0", b"demo_15"]
        assert sorted(file["data/demo_5"].attrs) == ["oodil_cluster", "oodil_transferability", "oodil_weight"]


def test_an_export_goes_to_the_file_that_was_read_and_to_no_other(tmp_path: Path) -> None:
    path = groups(tmp_path / "lab.hdf5", robomimic)
    found = read(path, "robot/arm", "box")
    other = groups(tmp_path / "other.hdf5", lambda s: robomimic(s + np.float32(1)))
    before = other.read_bytes()
    with pytest.raises(DataError, match=r"other.hdf5: is not what the run's demonstrations are from"):
        export(found, FOUND, str(other))
    assert other.read_bytes() == before
    # Of several sources, the one whose states they are is found.
    joined = Demonstrations.joined([read(other, "robot/arm", "box"), found])
    columns = {name: np.concatenate((np.zeros_like(column), column)) for name, column in FOUND.items()}
    assert export(joined, columns, str(path)) == f"{path}: mask/oodil_transferable with 2 of 4 demonstrations"
    with h5py.File(path) as file:
        assert file["data/demo_10"].attrs["oodil_transferability"] == 0.125


# A run of a file


@pytest.fixture
def file_run(tmp_path: Path) -> tuple[Path, Path]:
    """A configuration with a file of three sources, and that file."""
    rng = np.random.default_rng(0)
    parts = []
    for label in ("lab-a", "lab-b", "lab-c"):
        walks = np.cumsum(rng.standard_normal((3, 30, 12)), axis=1)
        parts.append(Demonstrations.of([Episode(walk) for walk in walks], label))
    file = tmp_path / "all.safetensors"
    file.write_bytes(encode_demonstrations(Demonstrations.joined(parts), "oodil/Hopper-v0"))
    micro = oodil.load_config(MICRO).model_dump(mode="json") | {"demonstrations": {"file": str(file)}}
    config = tmp_path / "mine.yaml"
    config.write_text(json.dumps(micro))
    return config, file


def test_a_run_goes_on_without_its_file_and_elsewhere(file_run: tuple[Path, Path], tmp_path: Path) -> None:
    config, file = file_run
    code, said = command("run", config, "--until", "demonstrations", "--workers", 0, "--run-dir", tmp_path / "run")
    assert code == 0, said
    file.unlink()
    moved = (tmp_path / "run").rename(tmp_path / "moved")
    assert oodil.open_run(moved).is_done("demonstrations")
    arguments = ["resume", str(moved), "--until", "clustering", "--workers", "1"]
    ended = subprocess.run(
        [sys.executable, str(ROOT / "orchestrator.py"), *arguments],
        env=os.environ | {"HOME": "/nowhere"},
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stderr
    assert oodil.open_run(moved).is_done("clustering")
    file.write_bytes(b"other")
    code, said = command("resume", moved, "--workers", 0)
    assert code == 2 and "not a sound safetensors file" in said


def test_marks_and_labels_for_a_file(file_run: tuple[Path, Path], tmp_path: Path) -> None:
    config, file = file_run
    marks = ["demonstrations.labels=[one, two, three]", "demonstrations.transferable=[two]"]
    results = oodil.run(config, marks, workers=0, until="transferability", run_dir=tmp_path / "run")
    assert results.demonstrations.source_labels == ("one", "two", "three")
    assert results.marks().tolist() == [False] * 3 + [True] * 3 + [False] * 3
    found = results.separation()
    assert found["share_before"] == pytest.approx(1 / 3) and 0 <= found["auroc"] <= 1
    # What nothing is known of is left out, and nothing is computed again.
    again = oodil.run(config, [*marks, "demonstrations.unmarked=[one]"], workers=0, until="transferability",
                      run_dir=tmp_path / "run")  # fmt: skip
    assert again.marks() is None and again.separation()["share_before"] == pytest.approx(1 / 2)
    assert again.artifact("transferability").sha256 == results.artifact("transferability").sha256
    for override, message in (
        ("demonstrations.transferable=[lab-d]", f"{file}: has no source 'lab-d', only lab-a, lab-b, lab-c"),
        ("demonstrations.labels=[one, two]", "has 3 sources (lab-a, lab-b, lab-c), but there are 2 labels"),
        ("demonstrations.unmarked=[lab-a]", "need some that are transferable"),
        ("clustering.num_clusters=10", "9 demonstrations cannot form 10 clusters"),
    ):
        code, said = command("run", config, override, "--run-dir", tmp_path / "new")
        assert code == 2 and message in said, said
    assert not (tmp_path / "new").exists()
