"""``oodil score``: a finished run says of later demonstrations what its frozen models say, and trains nothing."""

import csv
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

import oodil
from oodil.cli import app
from oodil.pipeline.artifacts import write_file
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.datasets import encode_demonstrations
from oodil.pipeline.datasets.foreign import read_foreign
from tests.runs import MICRO

pytestmark = pytest.mark.timeout(300)
HOPPER = "oodil/Hopper-v0"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> oodil.RunResults:
    """A finished run with a weighting that scores others (distance) and one that cannot (marks)."""
    path = tmp_path_factory.mktemp("scoring") / "run"
    return oodil.run(MICRO, ["baselines=['tests.toy:far', oracle]"], workers=0, run_dir=path)


@pytest.fixture
def later(results: oodil.RunResults) -> Demonstrations:
    """Two demonstrations of the run's own, and one unlike any of them."""
    rng = np.random.default_rng(0)
    strange = Demonstrations.of([Episode(50 + 9 * rng.standard_normal((40, 12)))], "strange")
    return Demonstrations.joined([results.demonstrations.select(np.array([4, 0])), strange])


@pytest.fixture
def file(later: Demonstrations, tmp_path: Path) -> Path:
    """The same in a file."""
    path = tmp_path / "later.safetensors"
    write_file(path, encode_demonstrations(later, HOPPER))
    return path


def shown(*arguments: object) -> str:
    result = CliRunner().invoke(app, ["score", *map(str, arguments)])
    assert result.exit_code == 0, (result.output, result.exception)
    return result.output


def refused(*arguments: object) -> str:
    """Return the one message of a command that must exit with code 2."""
    result = CliRunner().invoke(app, ["score", *map(str, arguments)])
    assert result.exit_code == 2, (result.exit_code, result.output, result.exception)
    assert len(result.output.strip().splitlines()) == 1, result.output
    return result.output


def test_every_weighting_that_can_speaks(results: oodil.RunResults, later: Demonstrations, file: Path) -> None:
    hashes = results.describe()["stages"]
    scored = oodil.score(results.path, file)
    assert list(scored.found) == ["transferability", "distance"] and "marks say nothing" in scored.refused["marks"]
    ours = scored.found["transferability"]
    assert ours.clusters[:2].tolist() == results.assignment.labels[[4, 0]].tolist()
    assert ours.threshold == results.transferability.threshold
    assert ours.verdicts[2] == "unlike" and ours.weights[2] == 0 and np.isnan(ours.scores[2])
    np.testing.assert_array_equal(
        oodil.score(results, later, "transferability").found["transferability"].scores, ours.scores
    )
    np.testing.assert_array_equal(scored.found["distance"].scores[:2], results.weighting("distance").scores[[4, 0]])
    assert oodil.open_run(results.path).describe()["stages"] == hashes


def test_where_everything_is_unlike_nothing_has_weight(
    results: oodil.RunResults, later: Demonstrations, tmp_path: Path
) -> None:
    path = tmp_path / "strange.safetensors"
    write_file(path, encode_demonstrations(later.select(np.array([2])), HOPPER))
    assert oodil.score(results, path).found["transferability"].weights.tolist() == [0]
    assert "nan" not in shown(results.path, path, "--weighting", "transferability").lower()


def test_a_table_by_source_and_by_demonstration(results: oodil.RunResults, file: Path) -> None:
    output = shown(results.path, file)
    assert "ours: kept from" in output and "distance: kept from" in output
    assert "unlike" in output and "strange" in output
    (named,) = [line for line in output.splitlines() if "marks say nothing" in line]
    assert named.startswith("oracle") or named.startswith("marks")
    assert "distance: kept" not in shown(results.path, file, "--weighting", "transferability")


def test_scores_are_written_with_the_demonstrations(
    results: oodil.RunResults, later: Demonstrations, file: Path, tmp_path: Path
) -> None:
    found = oodil.score(results, later).found
    for name in ("scores.csv", "scored.hdf5", "scored.npz"):
        assert f"{name}: 3 demonstrations" in shown(results.path, file, "--output", tmp_path / name).replace("\n", "")
    with (tmp_path / "scores.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    assert [row["source"] for row in rows] == ["slow", "fast", "strange"]
    np.testing.assert_array_equal([float(row["transferability"]) for row in rows], found["transferability"].scores)
    assert [float(row["distance_weight"]) for row in rows] == found["distance"].weights.tolist()
    with h5py.File(tmp_path / "scored.hdf5") as held:
        attributes = [dict(held[f"data/demo_{n}"].attrs) for n in range(3)]
    assert [each["oodil_verdict"] for each in attributes] == found["transferability"].verdicts.tolist()
    again, environment = read_foreign(str(tmp_path / "scored.hdf5"), "again", ("state",), False)
    assert environment == HOPPER
    other, _ = read_foreign(str(tmp_path / "scored.npz"), "again", (), False)
    for read in (again, other):
        assert read.observations.tobytes() == later.observations.tobytes()
        assert read.offsets.tolist() == later.offsets.tolist()
    with np.load(tmp_path / "scored.npz") as archive:
        np.testing.assert_array_equal(archive["oodil_weight"], found["transferability"].weights)
    assert "3 demonstrations" in shown(results.path, tmp_path / "scored.npz", "--output", tmp_path / "more.csv")


def states(dim: int = 12, environment: str = HOPPER, **change: float) -> bytes:
    made = Demonstrations.of([Episode(np.ones((5, dim)))], "a")
    if change:
        made.observations[3, 2] = change["value"]  # the array, behind the back of what checks it
    return encode_demonstrations(made, environment)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (states(dim=11), "states have 11 dimensions; those of"),
        (states(value=np.nan), "demonstration 0 has the value nan in state 3"),
        (states(environment="oodil/Walker2d-v0"), "recorded in oodil/Walker2d-v0, but the run is for oodil/Hopper-v0"),
        (states()[:-9], "truncated"),
    ],
)
def test_demonstrations_that_do_not_fit(
    results: oodil.RunResults, tmp_path: Path, content: bytes, message: str
) -> None:
    (tmp_path / "bad.safetensors").write_bytes(content)
    output = refused(results.path, tmp_path / "bad.safetensors", "--output", tmp_path / "out.csv")
    assert message in output and "bad.safetensors" in output
    assert not (tmp_path / "out.csv").exists()


def test_the_module_that_registers_an_environment_is_no_part_of_its_name(
    results: oodil.RunResults, tmp_path: Path
) -> None:
    (tmp_path / "later.safetensors").write_bytes(states(environment=f"oodil:{HOPPER}"))
    assert len(oodil.score(results, tmp_path / "later.safetensors").demonstrations) == 1


def test_what_cannot_be_asked(results: oodil.RunResults, file: Path, tmp_path: Path) -> None:
    assert "no such file" in refused(results.path, tmp_path / "nowhere.npz")
    assert "is not a run" in refused(tmp_path, file)
    assert "no weighting 'distanc'; this run has transferability, distance, marks" in refused(
        results.path, file, "--weighting", "distanc"
    )
    assert "marks say nothing" in refused(results.path, file, "--weighting", "marks")
    assert "unknown format" in refused(results.path, file, "--output", tmp_path / "out.xlsx")
    before = file.read_bytes()
    np.savez(tmp_path / "states.npz", np.zeros((5, 12), np.float32))
    same = tmp_path / "." / "states.npz"
    assert "is what was to be read" in refused(results.path, tmp_path / "states.npz", "--output", same)
    assert "no such folder" in refused(results.path, file, "--output", tmp_path / "none" / "out.csv")
    assert file.read_bytes() == before and not (tmp_path / "out.xlsx").exists()


def test_a_run_without_the_stage(results: oodil.RunResults, file: Path, tmp_path: Path) -> None:
    shutil.copytree(results.path, tmp_path / "run")
    for name in ("transferability", "distance", "marks"):
        shutil.rmtree(tmp_path / "run" / "stages" / name)
    assert "transferability is partial" in refused(tmp_path / "run", file)
    oodil.run(MICRO, workers=0, run_dir=tmp_path / "begun", until="demonstrations")
    assert "transferability is pending" in refused(tmp_path / "begun", file)


def test_a_demonstration_alone_in_its_cluster_is_open_and_weighs_nothing(tmp_path: Path) -> None:
    """Its readers have seen it, so that whatever they say of it is uncertain."""
    short = ["transferability.gail.total_steps=1200", "imitation.gail.total_steps=1200", "evaluation.num_points=0"]
    clusters = ["clustering.features=states", "clustering.num_clusters=5"]
    found = oodil.run(MICRO, [*short, *clusters], workers=0, run_dir=tmp_path / "run").transferability
    alone = np.bincount(found.clusters)[found.clusters] == 1
    assert alone.any() and not alone.all()
    np.testing.assert_array_equal(found.intervals[alone], [[0, 1]] * alone.sum())
    assert set(found.verdicts[alone]) == {"open"} and not found.weights[alone].any()
    assert (found.verdicts[found.weights > 0] == "kept").all()
