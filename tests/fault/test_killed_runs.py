"""Interrupted and resumed equals uninterrupted, to the bit (invariant 3), with real processes and real signals."""

import signal
from pathlib import Path

import pytest

from tests.runs import (
    MICRO,
    LiveRun,
    artifacts,
    has_checkpoint,
    interrupt,
    nothing_left,
    run,
    wait_for,
    without_baselines,
)

pytestmark = pytest.mark.timeout(600)


def start(run_dir: Path, workers: int) -> LiveRun:
    return LiveRun("run", str(MICRO), "--run-dir", str(run_dir), "--workers", str(workers))


@pytest.mark.parametrize(
    ("stage", "job", "iteration", "workers", "workers_after"),
    [
        ("clustering", "clustering", 7, 2, 1),
        ("imitators", "cluster-1", 9, 2, 0),
        ("imitators", "cluster-0", 20, 0, 2),
        ("imitation", "training-1", 17, 1, 4),
    ],
)
def test_kill_all_then_resume(
    undisturbed: dict[str, str], tmp_path: Path, stage: str, job: str, iteration: int, workers: int, workers_after: int
) -> None:
    live = start(tmp_path / "run", workers)
    wait_for(has_checkpoint(tmp_path / "run", stage, job, iteration), "checkpoint")
    live.kill_group()
    nothing_left(live)
    output = run("resume", str(tmp_path / "run"), "--workers", str(workers_after))
    begun = next(line for line in output.splitlines() if f"▶ {stage}" in line)
    assert "resumed from checkpoint" in begun
    assert artifacts(tmp_path / "run") == without_baselines(undisturbed)


def test_kill_the_orchestrator_alone(undisturbed: dict[str, str], tmp_path: Path) -> None:
    live = start(tmp_path / "run", 2)
    wait_for(has_checkpoint(tmp_path / "run", "imitation", "training-1", 2), "checkpoint")
    live.process.kill()
    nothing_left(live)
    run("resume", str(tmp_path / "run"), "--workers", "2")
    assert artifacts(tmp_path / "run") == without_baselines(undisturbed)


@pytest.mark.parametrize(
    ("stage", "job", "victim"),
    [
        ("imitators", "cluster-0", "imitators-cluster-0"),
        ("imitation", "training-1", "imitation-training-1"),
        ("imitation", "training-1", "imitation-rollout-worker-1"),
    ],
)
def test_kill_one_child(undisturbed: dict[str, str], tmp_path: Path, stage: str, job: str, victim: str) -> None:
    live = start(tmp_path / "run", 2)
    wait_for(has_checkpoint(tmp_path / "run", stage, job, 4), "checkpoint")
    live.child(victim).kill()
    code, output = live.finish()
    assert code == 0, output
    assert "SIGKILL" in output
    nothing_left(live)
    assert artifacts(tmp_path / "run") == without_baselines(undisturbed)


def test_kill_the_fork_server(undisturbed: dict[str, str], tmp_path: Path) -> None:
    live = start(tmp_path / "run", 2)
    for stage, job in (("imitators", "cluster-0"), ("imitation", "training-1")):
        wait_for(has_checkpoint(tmp_path / "run", stage, job, 4), "checkpoint")
        live.fork_server().kill()
    code, output = live.finish()
    assert code == 0, output
    assert "its fork server died" in output
    nothing_left(live)
    assert artifacts(tmp_path / "run") == without_baselines(undisturbed)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_checkpoints_and_stops(
    undisturbed: dict[str, str], tmp_path: Path, number: signal.Signals
) -> None:
    live = start(tmp_path / "run", 2)
    wait_for(has_checkpoint(tmp_path / "run", "imitation", "training-1", 5), "checkpoint")
    if number == signal.SIGINT:
        interrupt(live, number)
    else:
        live.process.send_signal(number)
    code, output = live.finish()
    assert code == 130, output
    assert "oodil resume" in output
    nothing_left(live)
    run("resume", str(tmp_path / "run"), "--workers", "1")
    assert artifacts(tmp_path / "run") == without_baselines(undisturbed)
