"""Scores in a table or in the file that the demonstrations came from."""

import csv
from pathlib import Path

import numpy as np
import pytest

from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.datasets.export import export
from oodil.pipeline.results import Transferability

FOUND = Transferability(
    scores=np.array([0.4, 0.1]),
    weights=np.array([1.0, 0.0]),
    clusters=np.array([1, 0], np.int32),
    intervals=np.array([[0.25, 0.5], [0.0, 0.125]]),
    threshold=0.2,
)
HELD = Demonstrations.of([Episode(np.zeros((length, 2))) for length in (7, 2)], "a", ("pos",))


def test_a_table_holds_intervals_and_verdicts(tmp_path: Path) -> None:
    path = tmp_path / "scores.csv"
    assert export(HELD, FOUND.columns(), str(path)) == f"{path}: 2 rows"
    with path.open(newline="") as file:
        first, second = csv.DictReader(file)
    assert (first["transferability"], first["low"], first["high"], first["verdict"]) == ("0.4", "0.25", "0.5", "kept")
    assert (second["low"], second["high"], second["verdict"]) == ("0.0", "0.125", "not kept")


def test_verdicts_become_attributes_of_robomimic_demonstrations(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "demonstrations.hdf5"
    with h5py.File(path, "w") as file:
        for n in range(2):
            file[f"data/demo_{n}/obs/pos"] = HELD[n]
    export(HELD, FOUND.columns(), str(path))
    with h5py.File(path) as file:
        assert file["data/demo_1"].attrs["oodil_verdict"] == "not kept"
        assert file["data/demo_0"].attrs["oodil_low"] == 0.25
        assert file["data/demo_0"].attrs["oodil_cluster"] == 1
