"""A method that somebody registers runs, and appears wherever methods are shown, without a line of ours."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import oodil
from oodil.cli import app
from oodil.pipeline.algorithms.weights import share_lasted, transferability_of_divergences
from oodil.pipeline.results import Reading
from oodil.pipeline.stages.imitators import ClusterJob
from oodil.pipeline.stages.transferability import TransferabilityStage
from oodil.pipeline.stages.weighting import CannotScoreError
from tests.runs import MICRO, ROOT

pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with a policy of ours, a foreign one and the oracle, each job in a process of its own."""
    path = tmp_path_factory.mktemp("toy") / "run"
    oodil.run(MICRO, ["baselines=[tests.toy:far, oracle]"], workers=1, run_dir=path)
    return path


def shown(*arguments: str) -> str:
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == 0, (result.output, result.exception)
    return result.output


def test_it_appears_in_status_evaluate_and_report(run_dir: Path) -> None:
    described = json.loads(shown("status", str(run_dir), "--json"))
    assert {"distance", "far"} < described["stages"].keys()
    assert all(stage["state"] == "done" for stage in described["stages"].values())
    assert {"imitation", "far", "oracle"} == described["results"]["policies"].keys()
    assert {"transferability", "distance", "marks"} == described["results"]["weightings"].keys()
    assert "final return, far ones" in shown("status", str(run_dir))
    assert "far: return" in shown("evaluate", str(run_dir), "--episodes", "2")
    page = Path(shown("report", str(run_dir)).strip()).read_text()
    assert "far ones" in page and "distance" in page


def test_its_weights_are_what_the_policy_learned_from_and_it_scores_others(run_dir: Path) -> None:
    results = oodil.open_run(run_dir)
    demonstrations, held = results.demonstrations, results.weighting("distance")
    again = results.score(demonstrations, "distance")
    np.testing.assert_array_equal(again.scores, held.scores)
    assert results.policy("far").gaussian.weights[0].tobytes() != results.policy().gaussian.weights[0].tobytes()
    with pytest.raises(CannotScoreError, match="marks say nothing"):
        results.score(demonstrations, "marks")


def test_frozen_models_say_of_the_runs_own_demonstrations_what_the_run_said(run_dir: Path) -> None:
    """The run took the one of each two readers that had not seen a demonstration; other demonstrations get both."""
    results = oodil.open_run(run_dir)
    run, demonstrations, held = results.run, results.demonstrations, results.transferability
    again = results.score(demonstrations)
    np.testing.assert_array_equal(again.clusters, held.clusters)
    assert again.threshold == held.threshold
    for job in TransferabilityStage().jobs(run):
        reading, readers = (
            Reading.load(run.job_artifact("transferability", job)),
            ClusterJob.of(run, job).readers(run.config),
        )
        readers.load(reading.readers)
        members, pairs = reading.demonstrations, readers.divergences(demonstrations.select(reading.demonstrations))
        is_told = np.isclose(pairs.reshape(-1, 2, len(members)), reading.divergences[:, None], rtol=1e-5, atol=1e-6)
        assert is_told.any(axis=1).all()
        lasted = share_lasted(demonstrations.select(members), 1000)
        both = transferability_of_divergences(pairs).mean(axis=0) * lasted
        np.testing.assert_allclose(again.scores[members], both, rtol=1e-5)
        told = transferability_of_divergences(reading.divergences).mean(axis=0) * lasted
        np.testing.assert_allclose(held.scores[members], told, rtol=1e-5)
    one = results.score(results.demonstrations.select(np.array([2])))
    np.testing.assert_allclose(one.weights, [1.0])


def test_what_is_not_known_is_named(run_dir: Path, tmp_path: Path) -> None:
    with pytest.raises(oodil.OodilError, match=r"'tests\.toi:far' cannot be loaded: No module named 'tests\.toi'"):
        oodil.load_config(MICRO, ["baselines=['tests.toi:far']"])
    with pytest.raises(oodil.OodilError, match=r"no policy 'transferability'; there are exact_id, .*, imitation"):
        oodil.load_config(MICRO, ["baselines=[transferability]"])
    with pytest.raises(oodil.OodilError, match="no policy 'naive_gail'; this run has"):
        oodil.open_run(run_dir).policy("naive_gail")


def test_a_method_of_the_running_script_says_that_workers_cannot_import_it(tmp_path: Path) -> None:
    program = (
        "import oodil, sys\n"
        "from tests.toy import Distance\n"
        "class Mine(Distance): name = 'mine'\n"
        "oodil.register(Mine())\n"
        "oodil.register(oodil.PolicyStage('near', title='near', weighting='mine'))\n"
        "oodil.run(sys.argv[1], ['baselines=[near]', 'imitation.gail.total_steps=1'], workers=1, run_dir=sys.argv[2])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(MICRO), str(tmp_path / "run")], cwd=ROOT, capture_output=True, text=True
    )
    assert "mine is defined in the script that runs; put it into a module of its own, or use workers=0" in done.stderr


def test_a_policy_of_our_class_is_known_by_the_module_that_registers_it(tmp_path: Path) -> None:
    """A worker process imports that module, whatever the class and the weighting are."""
    (tmp_path / "theirs.py").write_text(
        "import oodil\n"
        "oodil.register(oodil.PolicyStage('again', title='again', weighting='transferability'))\n"
        "oodil.register(oodil.PolicyStage('plain', title='plain', weighting=None))\n"
    )
    program = (
        "import theirs\n"
        "from oodil.pipeline.stage import stage_named\n"
        "print(*(stage_named(name).module for name in ('again', 'plain', 'imitation')))"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["theirs", "theirs", "oodil.pipeline.stages.imitation"]
