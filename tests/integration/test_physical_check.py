"""The check beside the method: the same files however it runs, resumed where it stopped, and nobody's input."""

from pathlib import Path

import pytest

import oodil
from oodil.orchestrator import choose, execute, open_run
from oodil.pipeline.errors import UnfinishedError
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stage import Run
from oodil.pipeline.stages import reproducibility, stages
from oodil.workers.local_engine import LocalEngine
from tests.runs import MICRO

pytestmark = pytest.mark.timeout(120)
SECTION = "reproducibility={transitions: 2, horizon: 2}"


@pytest.fixture(autouse=True)
def small_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four jobs for seven demonstrations."""
    monkeypatch.setattr(reproducibility, "JOB_SIZE", 2)


def checked(path: Path, workers: int) -> Run:
    run = open_run(path, oodil.load_config(MICRO, [SECTION]))
    execute(run, choose(run.config, until="reproducibility"), LocalEngine(workers))
    return run


def test_it_comes_early_and_nothing_reads_it() -> None:
    chosen = stages(oodil.load_config(MICRO, [SECTION]))
    assert [stage.name for stage in chosen][:2] == ["demonstrations", "reproducibility"]
    assert [stage.name for stage in chosen if stage.name != "reproducibility"] == [
        stage.name for stage in stages(oodil.load_config(MICRO, []))
    ]
    assert not any("reproducibility" in stage.inputs for stage in chosen)


def test_any_number_of_workers_and_a_stop_give_the_same_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inline, parallel = checked(tmp_path / "inline", 0), checked(tmp_path / "parallel", 2)
    stopped = open_run(tmp_path / "stopped", oodil.load_config(MICRO, [SECTION]))
    finished = stopped.directory.job("reproducibility", "2-to-3")
    with pytest.raises(UnfinishedError):
        execute(
            stopped,
            choose(stopped.config, until="reproducibility"),
            LocalEngine(0),
            should_stop=lambda: finished.exists(),
        )
    assert not stopped.directory.job("reproducibility", "6-to-6").exists()
    kept = stopped.job_artifact("reproducibility", "0-to-1").path.stat().st_mtime_ns
    execute(stopped, choose(stopped.config, until="reproducibility"), LocalEngine(0))
    assert stopped.job_artifact("reproducibility", "0-to-1").path.stat().st_mtime_ns == kept
    monkeypatch.setattr(reproducibility, "JOB_SIZE", 50)
    whole = checked(tmp_path / "whole", 0)
    hashes = {run.artifact("reproducibility").sha256 for run in (inline, parallel, stopped)}
    assert hashes == {whole.artifact("reproducibility").sha256}


def test_what_a_run_says_of_it(tmp_path: Path) -> None:
    results = RunResults(checked(tmp_path / "run", 0))
    found = results.reproducibility
    assert found.one_step.shape == found.horizon.shape == (7, 2)
    said = results.summary()["reproducibility"]
    fast, slow = said["sources"]
    assert (fast["name"], slow["name"]) == ("fast", "slow") and fast["distance"] < 0.05 < slow["distance"]
    assert (fast["reproducible"], slow["reproducible"], said["everything"]) == (True, False, False)
    assert results.env_steps()["reproducibility"] == found.env_steps > 0


def test_what_it_depends_on_and_what_it_does_not(tmp_path: Path) -> None:
    run = checked(tmp_path / "run", 0)

    def state(*overrides: str) -> tuple[str, str]:
        changed = Run(oodil.load_config(MICRO, [SECTION, *overrides]), run.directory)
        found = RunResults(changed).states["reproducibility"]
        return found.state, found.reason

    assert state("clustering.temperature=0.5", "runtime.workers=7")[0] == "done"
    assert state("reproducibility.horizon=3") == ("stale", "horizon 2 -> 3")
    assert state("environment.dynamics.gravity=11.0") == ("stale", "environment.dynamics.gravity 12.0 -> 11.0")
