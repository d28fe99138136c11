"""Whatever is written comes back; whatever is damaged is never silently used."""

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from oodil.pipeline.artifacts import MANIFEST, encode_arrays, encode_json, fingerprint, read_artifact, write_artifact
from oodil.pipeline.errors import DamagedArtifactError

SETTINGS = settings(max_examples=50)

names = st.text("abcdefghijklmnopqrstuvwxyz_0123456789", min_size=1, max_size=8).map(lambda name: name + ".bin")
files = st.dictionaries(names, st.binary(max_size=40), min_size=1, max_size=4)
json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
arrays = st.dictionaries(
    st.text("abc/._0", min_size=1, max_size=6),
    st.sampled_from([np.float32, np.float64, np.int64, np.int32, np.bool_]).flatmap(
        lambda dtype: npst.arrays(dtype, npst.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
    ),
    max_size=3,
)


@SETTINGS
@given(files, json_values)
def test_what_is_written_comes_back(content, origin):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "artifact"
        written = write_artifact(path, {"value": origin}, content)
        artifact = read_artifact(path)
        assert artifact == written
        artifact.verify()
        assert {name: artifact.read(name) for name in artifact.hashes} == content
        assert artifact.origin == {"value": origin}
        assert artifact.fingerprint == fingerprint(artifact.origin)


@SETTINGS
@given(files, st.data())
def test_a_changed_byte_anywhere_is_never_silently_used(content, data):
    """Every later read gives what was written, or an error that names the artifact."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "artifact"
        write_artifact(path, {"seed": 1}, content)
        victim = data.draw(st.sampled_from([MANIFEST, *(name for name in content if content[name])]))
        damaged = bytearray((path / victim).read_bytes())
        position = data.draw(st.integers(0, len(damaged) - 1))
        damaged[position] ^= data.draw(st.integers(1, 255))
        (path / victim).write_bytes(damaged)
        failed = []
        for name in (*content, MANIFEST):
            try:
                artifact = read_artifact(path)
                assert artifact is not None
                if name == MANIFEST:
                    artifact.verify()
                else:
                    assert artifact.read(name) == content[name]
            except DamagedArtifactError as error:
                assert str(path) in str(error)
                failed.append(name)
        if victim != MANIFEST:
            assert failed == [victim, MANIFEST]


@SETTINGS
@given(files, st.data())
def test_a_truncated_file_is_an_error(content, data):
    victim = data.draw(st.sampled_from(sorted(content)))
    if not content[victim]:
        return
    with tempfile.TemporaryDirectory() as folder:
        artifact = write_artifact(Path(folder) / "artifact", {}, content)
        length = data.draw(st.integers(0, len(content[victim]) - 1))
        (artifact.path / victim).write_bytes(content[victim][:length])
        with pytest.raises(DamagedArtifactError, match=victim.replace(".", r"\.")):
            artifact.verify()


@SETTINGS
@given(arrays)
def test_arrays_come_back_to_the_bit(values):
    decoded = safetensors.numpy.load(encode_arrays(values))
    assert decoded.keys() == values.keys()
    for name, value in values.items():
        assert (decoded[name].dtype, decoded[name].shape) == (value.dtype, value.shape)
        assert decoded[name].tobytes() == value.tobytes()


@SETTINGS
@given(json_values)
def test_equal_values_have_equal_files_and_fingerprints(value):
    again = json.loads(encode_json(value))
    assert encode_json(again) == encode_json(value)
    assert fingerprint(again) == fingerprint(value)
