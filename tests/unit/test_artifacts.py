"""Artifacts are there as a whole or not at all, and damage is noticed and named."""

import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy

from oodil.pipeline.artifacts import (
    MANIFEST,
    Checkpoints,
    RunDirectory,
    below,
    encode_arrays,
    encode_json,
    fingerprint,
    nested,
    read_artifact,
    remove_artifact,
    write_artifact,
)
from oodil.pipeline.errors import DamagedArtifactError, StorageError

OLD = {"a.json": b"old a", "b.bin": b"old b"}
NEW = {"a.json": b"new a", "c.bin": b"new c"}


def contents(path):
    """Everything the artifact holds, read with all checks."""
    artifact = read_artifact(path)
    assert artifact is not None
    artifact.verify()
    assert {p.name for p in path.iterdir()} == {*artifact.hashes, MANIFEST}
    return {name: artifact.read(name) for name in artifact.hashes}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "stages" / "clustering"


def test_write_and_read(path):
    written = write_artifact(path, {"seed": 3}, OLD, {"numpy": "2"})
    assert contents(path) == OLD
    assert written == read_artifact(path)
    assert (written.origin, written.versions) == ({"seed": 3}, {"numpy": "2"})
    assert written.fingerprint == fingerprint({"seed": 3})
    assert [p.name for p in path.parent.iterdir()] == ["clustering"]


def test_a_new_artifact_replaces_the_old_one(path):
    write_artifact(path, {}, OLD)
    write_artifact(path, {}, NEW)
    assert contents(path) == NEW
    assert [p.name for p in path.parent.iterdir()] == ["clustering"]


def test_equal_content_equal_hash(tmp_path):
    one, two = (write_artifact(tmp_path / name, {"name": name}, OLD) for name in "ab")
    assert one.sha256 == two.sha256
    assert one.fingerprint != two.fingerprint
    assert write_artifact(tmp_path / "c", {}, NEW).sha256 != one.sha256
    renamed = write_artifact(tmp_path / "d", {}, {"a.json": OLD["b.bin"], "b.bin": OLD["a.json"]})
    assert renamed.sha256 != one.sha256


def test_no_manifest_no_artifact(path):
    assert read_artifact(path) is None
    write_artifact(path, {}, OLD)
    (path / MANIFEST).unlink()
    assert read_artifact(path) is None
    write_artifact(path, {}, NEW)
    assert contents(path) == NEW


def damage_byte(file):
    content = bytearray(file.read_bytes())
    content[1] ^= 1
    file.write_bytes(content)


def truncate(file):
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])


@pytest.mark.parametrize("damage", [damage_byte, truncate, Path.unlink])
def test_damage_is_noticed_and_named(path, damage):
    artifact = write_artifact(path, {}, OLD)
    damage(path / "b.bin")
    assert artifact.read("a.json") == b"old a"
    for use in (lambda: artifact.read("b.bin"), artifact.verify):
        with pytest.raises(DamagedArtifactError, match=r"clustering/b\.bin"):
            use()


def test_a_file_that_the_manifest_does_not_name_is_refused(path):
    artifact = write_artifact(path, {}, OLD)
    (path / "stray.bin").write_bytes(b"stray")
    with pytest.raises(DamagedArtifactError, match=r"stray\.bin"):
        artifact.read("stray.bin")


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "3", '{"fingerprint": "x"}', "\x00\xff"])
def test_a_damaged_manifest_is_named(path, text):
    write_artifact(path, {}, OLD)
    (path / MANIFEST).write_text(text, encoding="latin-1")
    with pytest.raises(DamagedArtifactError, match=r"clustering/manifest\.json"):
        read_artifact(path)


def full_disk_at(monkeypatch, name, failing_call):
    """Let the n-th call of ``os.<name>`` fail as on a full disk; return the counter of calls."""
    real, calls = getattr(os, name), []

    def call(*args, **kwargs):
        calls.append(args)
        if len(calls) - 1 == failing_call:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(*args, **kwargs)

    monkeypatch.setattr(os, name, call)
    return calls


def test_a_full_disk_leaves_the_old_artifact(path, monkeypatch):
    """Whichever flush fails, the old artifact stands, but for the very last one, after the new one is in place."""
    write_artifact(path, {}, OLD)
    with monkeypatch.context() as patch:
        calls = full_disk_at(patch, "fsync", -1)
        write_artifact(path, {}, OLD)
        num_calls = len(calls)
    assert num_calls == 5  # two files, the manifest, their folder, the folder above
    for failing in range(num_calls):
        with monkeypatch.context() as patch:
            full_disk_at(patch, "fsync", failing)
            with pytest.raises(StorageError, match="No space left"):
                write_artifact(path, {}, NEW)
        assert contents(path) == (NEW if failing == num_calls - 1 else OLD)
    write_artifact(path, {}, OLD)
    assert [p.name for p in path.parent.iterdir()] == ["clustering"]


@pytest.mark.parametrize("failing", [0, 1])
def test_a_failing_rename_leaves_the_old_artifact(path, monkeypatch, failing):
    write_artifact(path, {}, OLD)
    with monkeypatch.context() as patch:
        full_disk_at(patch, "rename", failing)
        with pytest.raises(StorageError, match="No space left"):
            write_artifact(path, {}, NEW)
    assert contents(path) == OLD


class Killed(BaseException):
    """Stands for a process that ends at once: nothing after it runs."""


def kill_at(monkeypatch, name, killing_call):
    """End the 'process' before the n-th call of ``os.<name>``; no clean-up code may do anything afterwards."""
    real, calls = getattr(os, name), []

    def call(*args, **kwargs):
        calls.append(args)
        if len(calls) - 1 == killing_call:
            monkeypatch.setattr(shutil, "rmtree", lambda *_, **__: None)
            monkeypatch.setattr(os, "rename", lambda *_, **__: None)
            raise Killed
        return real(*args, **kwargs)

    monkeypatch.setattr(os, name, call)


@pytest.mark.parametrize("killing_call", range(5))
def test_a_killed_writer_leaves_whole_artifacts_only(path, monkeypatch, killing_call):
    write_artifact(path, {}, OLD)
    with monkeypatch.context() as patch:
        kill_at(patch, "fsync", killing_call)
        with pytest.raises(Killed):
            write_artifact(path, {}, NEW)
    assert contents(path) == (NEW if killing_call == 4 else OLD)
    write_artifact(path, {}, NEW)
    assert contents(path) == NEW
    assert [p.name for p in path.parent.iterdir()] == ["clustering"]


def test_removal_takes_the_manifest_first(path, monkeypatch):
    write_artifact(path, {}, OLD)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", lambda *_: (_ for _ in ()).throw(OSError("stopped half-way")))
        with pytest.raises(StorageError, match="half-way"):
            remove_artifact(path)
    assert read_artifact(path) is None
    remove_artifact(path)
    assert not path.exists()


def test_arrays_keep_shape_type_and_order():
    arrays = {
        "scalar": np.array(3.5, np.float32),
        "empty": np.zeros((0, 3)),
        "transposed": np.arange(6).reshape(2, 3).T,
        "flags": np.array([True, False]),
    }
    decoded = safetensors.numpy.load(encode_arrays(arrays))
    for name, value in arrays.items():
        assert (decoded[name].dtype, decoded[name].shape) == (value.dtype, value.shape), name
        np.testing.assert_array_equal(decoded[name], value)


def test_json_is_sorted_finite_and_ends_with_a_newline():
    content = encode_json({"b": [1.5, float("nan"), (float("inf"), 2)], "a": {"c": None}})
    assert json.loads(content) == {"a": {"c": None}, "b": [1.5, None, [None, 2]]}
    assert content == encode_json({"a": {"c": None}, "b": [1.5, float("nan"), (float("inf"), 2)]})
    assert content.endswith(b"}\n")


def test_fingerprint_ignores_the_order_of_keys_only():
    assert fingerprint({"a": 1, "b": [1, 2]}) == fingerprint({"b": [1, 2], "a": 1})
    different = [{"a": 1}, {"a": 2}, {"a": "1"}, {"b": 1}, {"a": [1, 2]}, {"a": [2, 1]}, {"a": None}]
    assert len({fingerprint(value) for value in different}) == len(different)


class TestCheckpoints:
    """The newest states of one job."""

    @pytest.fixture
    def checkpoints(self, tmp_path):
        return Checkpoints(tmp_path / "checkpoints" / "job", {"seed": 1})

    def save(self, checkpoints, *steps):
        for step in steps:
            checkpoints.save(step, {"step": np.array(step)})

    def loaded(self, checkpoints):
        state, warnings = checkpoints.load()
        return (None if state is None else int(state["step"])), warnings

    def test_nothing_saved(self, checkpoints):
        assert self.loaded(checkpoints) == (None, [])

    def test_two_are_kept_and_the_newest_is_loaded(self, checkpoints):
        self.save(checkpoints, 5, 90, 1000, 20_000)
        assert [p.name for p in sorted(checkpoints.folder.iterdir())] == ["000001000", "000020000"]
        assert self.loaded(checkpoints) == (20_000, [])

    @pytest.mark.parametrize("damage", [damage_byte, truncate, Path.unlink])
    @pytest.mark.parametrize("name", ["state.safetensors", MANIFEST])
    def test_a_damaged_one_falls_back_to_the_one_before(self, checkpoints, damage, name):
        self.save(checkpoints, 1, 2)
        damage(checkpoints.folder / "000000002" / name)
        step, warnings = self.loaded(checkpoints)
        assert step == 1
        if (damage, name) == (Path.unlink, MANIFEST):
            assert warnings == []  # an unfinished one is nothing to warn of
        else:
            assert len(warnings) == 1
            assert f"000000002/{name}" in warnings[0]

    def test_two_damaged_ones_start_anew_with_two_warnings(self, checkpoints):
        self.save(checkpoints, 1, 2)
        for folder in checkpoints.folder.iterdir():
            truncate(folder / "state.safetensors")
        step, warnings = self.loaded(checkpoints)
        assert (step, len(warnings)) == (None, 2)

    def test_those_of_another_origin_are_ignored(self, checkpoints):
        self.save(checkpoints, 1)
        other = Checkpoints(checkpoints.folder, {"seed": 2})
        assert self.loaded(other) == (None, [])
        assert self.loaded(checkpoints) == (1, [])

    def test_stale_ones_of_another_origin_do_not_push_out_new_ones(self, checkpoints):
        """After a change of the configuration the job starts at step 0 again, below the numbers that lie there."""
        self.save(checkpoints, 500, 600)
        other = Checkpoints(checkpoints.folder, {"seed": 2})
        self.save(other, 1)
        assert self.loaded(other) == (1, [])
        self.save(other, 2)
        assert self.loaded(other) == (2, [])

    def test_a_damaged_one_does_not_push_out_those_that_follow_the_one_before(self, checkpoints):
        self.save(checkpoints, 100, 200)
        truncate(checkpoints.folder / "000000200" / "state.safetensors")
        assert self.loaded(checkpoints)[0] == 100
        self.save(checkpoints, 150)
        assert self.loaded(checkpoints) == (150, [])
        truncate(checkpoints.folder / "000000150" / "state.safetensors")
        assert self.loaded(checkpoints)[0] == 100

    def test_a_full_disk_keeps_the_last_checkpoint(self, checkpoints, monkeypatch):
        self.save(checkpoints, 1, 2)
        with monkeypatch.context() as patch:
            full_disk_at(patch, "fsync", 0)
            with pytest.raises(StorageError, match="No space left"):
                self.save(checkpoints, 3)
        assert self.loaded(checkpoints) == (2, [])

    def test_clear(self, checkpoints):
        self.save(checkpoints, 1, 2)
        checkpoints.clear()
        assert self.loaded(checkpoints) == (None, [])
        checkpoints.clear()


def test_the_artifact_of_a_single_job_is_that_of_its_stage(tmp_path):
    run = RunDirectory(tmp_path)
    assert run.job("clustering", "clustering") == run.stage("clustering")
    places = {
        run.stage("a"),
        run.job("a", "k0"),
        run.job("a", "k1"),
        run.checkpoints("a", "a"),
        run.checkpoints("a", "k0"),
    }
    assert len(places) == 5


def test_below_is_the_inverse_of_nested_and_takes_no_other_prefix():
    first, second = {"a": np.zeros(1), "b/c": np.ones(2)}, {"a": np.full(3, 2.0)}
    whole = nested("part", first) | nested("parts", second) | {"part": np.zeros(0)}
    assert set(whole) == {"part/a", "part/b/c", "parts/a", "part"}
    assert below("part", whole) == first
    assert below("parts", whole) == second
    assert below("par", whole) == {}
