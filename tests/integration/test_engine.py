"""Jobs with real processes and sockets: the same files whatever the engine, and nothing left behind."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from oodil.pipeline.artifacts import read_artifact
from oodil.pipeline.metrics import read_metrics
from oodil.pipeline.stage import Run
from oodil.workers.channels import endpoint_folder
from oodil.workers.engine import Outcome
from oodil.workers.local_engine import LocalEngine
from oodil.workers.reports import DONE, Event, Finished, Progress, Started
from tests.fakes import FakeStage, children, failures, fake_run, lines

pytestmark = pytest.mark.timeout(120)


def run_jobs(run: Run, workers: int, jobs: list[str], distributed: bool = False) -> tuple[Outcome, list[Event]]:
    """Run jobs of a fake stage to the end."""
    events: list[Event] = []
    engine = LocalEngine(workers)
    outcome = engine.run_jobs(FakeStage(distributed), run, jobs, events.append, lambda: False)
    assert not children()
    assert not endpoint_folder(run.directory.path).exists()
    return outcome, events


def content(run: Run, stage: str, job: str) -> str:
    """Return the hash of a job's artifact."""
    return run.job_artifact(stage, job).sha256


@pytest.mark.parametrize("distributed", [False, True])
def test_the_result_does_not_depend_on_the_number_of_workers(tmp_path: Path, distributed: bool) -> None:
    """Two jobs of a distributed stage run one after another, side by side, or with rollout workers."""
    stage = FakeStage(distributed).name
    hashes = set()
    for workers in (0, 1, 2, 3):
        run = fake_run(tmp_path / str(workers))
        outcome, events = run_jobs(run, workers, ["a", "b"], distributed)
        assert outcome == Outcome(done=["a", "b"])
        assert events.count(Event("a", Started(1))) == events.count(Event("a", Finished(DONE))) == 1
        assert any(isinstance(e.report, Progress) and (e.report.done, e.report.total) == (6, 6) for e in events)
        collected_for = bool(list(run.directory.logs().glob("learner-rollout-worker-*")))
        assert collected_for == (distributed and workers == 3)
        assert not run.directory.checkpoints(stage, "a").exists()
        assert "torch" in run.job_artifact(stage, "a").versions
        metrics = read_metrics(run.directory.metrics(stage, "a"))
        assert metrics["step"].tolist() == [1, 2, 3, 4, 5, 6] and np.isfinite(metrics["reward"]).all()
        hashes |= {content(run, stage, "a"), content(run, stage, "b")}
    assert len(hashes) == 1


@pytest.mark.parametrize("workers", [0, 2])
def test_a_failing_job_keeps_its_first_traceback_and_does_not_end_the_others(tmp_path: Path, workers: int) -> None:
    run = fake_run(tmp_path, max_attempts=3)
    outcome, events = run_jobs(run, workers, ["a", "raises", "b"])
    assert outcome.done == ["a", "b"]
    assert outcome.failed.keys() == {"raises"}
    assert "ArithmeticError: told to, in attempt 1" in outcome.failed["raises"]
    assert not outcome.stopped and not outcome.not_run
    assert failures(events) == [("raises", 1, True), ("raises", 2, True), ("raises", 3, False)]
    assert read_artifact(run.directory.job("jobs", "raises")) is None
    assert lines(tmp_path / "raises.began_at") == ["0", "2", "2"]


@pytest.mark.parametrize(("workers", "job"), [(0, "raises_often"), (1, "killed_often")])
def test_attempts_that_get_further_do_not_use_any_up(tmp_path: Path, workers: int, job: str) -> None:
    run = fake_run(tmp_path, max_attempts=2)
    outcome, events = run_jobs(run, workers, [job, "a"])
    assert outcome == Outcome(done=[job, "a"])
    assert failures(events) == [(job, attempt, True) for attempt in range(1, 7)]
    assert lines(tmp_path / f"{job}.began_at") == ["0", "1", "2", "3", "4", "5", "6"]
    assert content(run, "jobs", job) == content(run, "jobs", "a")


@pytest.mark.parametrize(("workers", "distributed"), [(0, False), (2, False), (2, True), (3, True)])
def test_stopped_and_resumed_equals_uninterrupted(tmp_path: Path, workers: int, distributed: bool) -> None:
    stage = FakeStage(distributed)
    whole, stopped = fake_run(tmp_path / "whole"), fake_run(tmp_path / "stopped")
    run_jobs(whole, 0, ["waits_not"], distributed)
    iterations = stopped.directory.path / "waits.iterations"
    engine = LocalEngine(workers)
    outcome = engine.run_jobs(
        stage, stopped, ["waits", "later"], lambda event: None, lambda: len(lines(iterations)) >= 2
    )
    assert outcome.stopped and "waits" in outcome.not_run and not outcome.failed
    assert read_artifact(stopped.directory.job(stage.name, "waits")) is None
    outcome, _ = run_jobs(stopped, 3 - workers, ["waits", "later"], distributed)
    assert outcome == Outcome(done=["waits", "later"])
    assert lines(stopped.directory.path / "waits.began_at")[0] == "0"
    assert int(lines(stopped.directory.path / "waits.began_at")[1]) >= 2
    assert content(stopped, stage.name, "waits") == content(whole, stage.name, "waits_not")


def test_rollout_workers_do_not_load_torch() -> None:
    code = "import sys, oodil.workers.rollout_worker, oodil.workers.engine; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "torch" not in loaded.split()
