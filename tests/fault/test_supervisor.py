"""Children that are killed, hang or are orphaned, with real processes and real signals."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from oodil.pipeline.metrics import read_metrics
from oodil.workers.channels import endpoint_folder
from oodil.workers.local_engine import LocalEngine
from oodil.workers.reports import AttemptFailed, Event, Failed, Finished, Progress, Replaced, Started, Warn
from oodil.workers.supervisor import Link, Supervisor
from tests.fakes import FakeStage, children, failures, fake_run, is_alive, lines, wait_until

pytestmark = pytest.mark.timeout(120)
ROOT = Path(__file__).parents[2]


def obedient(link: Link) -> str:
    """Say the process id, then wait for the stop."""
    link.send(Progress(os.getpid(), 0, {}))
    while not link.should_stop():
        time.sleep(0.01)
    return "stopped"


def deaf(link: Link) -> str:
    """Ignore everything that can be ignored."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    link.send(Progress(os.getpid(), 0, {}))
    while True:
        time.sleep(1)


def broken(link: Link) -> str:
    """Raise something that no encoding can carry as it is."""
    raise LookupError("lone surrogate \ud800, attempt " + link.identity)


def describes_itself(link: Link) -> str:
    """Return what a child starts with."""
    print("to the log", flush=True)
    os.write(2, b"to the log as well\n")
    in_batches = not hasattr(os, "SCHED_BATCH") or os.sched_getscheduler(0) == os.SCHED_BATCH
    return f"{os.environ['OMP_NUM_THREADS']} {signal.getsignal(signal.SIGINT) == signal.SIG_IGN} {in_batches}"


def vanishes(link: Link) -> str:
    """End without a word, as a library that calls exit() would."""
    os._exit(0)


def poll_until(supervisor: Supervisor, kind: type, timeout_s: float = 30.0) -> Any:
    """Return the first report of a kind."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        for event in supervisor.poll(0.1):
            if isinstance(event.report, kind):
                return event.report
    raise TimeoutError(f"no {kind.__name__} within {timeout_s:g} s")


def started(supervisor: Supervisor) -> int:
    """Return the process id that a child says when it is up."""
    pid: int = poll_until(supervisor, Progress).done
    return pid


def test_a_child_computes_with_one_thread_and_writes_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with Supervisor(tmp_path, "stage") as supervisor:
        supervisor.start("child", describes_itself, {})
        assert poll_until(supervisor, Finished) == Finished("1 True True")
    assert (os.environ["OMP_NUM_THREADS"], os.environ.get("MKL_NUM_THREADS")) == ("7", None)
    assert (tmp_path / "stage-child.1.log").read_text() == "to the log\nto the log as well\n"


def test_the_signal_that_killed_a_child_is_told(tmp_path: Path) -> None:
    with Supervisor(tmp_path, "stage") as supervisor:
        for number in (signal.SIGKILL, signal.SIGSEGV):
            supervisor.start("child", obedient, {})
            os.kill(started(supervisor), number)
            assert poll_until(supervisor, Failed).reason.startswith(f"killed by {number.name}")
            assert supervisor.poll(0.0) == []


@pytest.mark.parametrize(
    ("main", "reason"), [(broken, "lone surrogate \\ud800, attempt child.1"), (vanishes, "code 0")]
)
def test_the_reason_of_a_failure_is_told(tmp_path: Path, main: object, reason: str) -> None:
    with Supervisor(tmp_path, "stage") as supervisor:
        supervisor.start("child", main, {})  # type: ignore[arg-type]
        assert reason in poll_until(supervisor, Failed).reason


def test_ctrl_c_does_not_reach_children_and_a_stop_does(tmp_path: Path) -> None:
    with Supervisor(tmp_path, "stage") as supervisor:
        supervisor.start("child", obedient, {})
        os.kill(started(supervisor), signal.SIGINT)
        assert supervisor.stop("child")
        assert poll_until(supervisor, Finished) == Finished("stopped")


def test_a_child_that_waits_for_its_start_is_dropped_by_a_stop(tmp_path: Path) -> None:
    with Supervisor(tmp_path, "stage") as supervisor:
        supervisor.start("child", broken, {}, delay_s=1000.0)
        assert not supervisor.stop("child")
        assert supervisor.poll(0.0) == []


@pytest.mark.parametrize("main", [obedient, deaf])
@pytest.mark.parametrize("is_suspended", [False, True])
def test_closing_ends_every_child_and_can_be_repeated(tmp_path: Path, main: object, is_suspended: bool) -> None:
    supervisor = Supervisor(tmp_path, "stage")
    supervisor.start("child", main, {})  # type: ignore[arg-type]
    pid = started(supervisor)
    if is_suspended:
        os.kill(pid, signal.SIGSTOP)
    supervisor.close(grace_s=0.2)
    supervisor.close(grace_s=0.2)
    assert not is_alive(pid)
    assert not children()


def test_only_the_named_attempt_is_killed(tmp_path: Path) -> None:
    with Supervisor(tmp_path, "stage") as supervisor:
        supervisor.start("child", obedient, {})
        os.kill(started(supervisor), signal.SIGKILL)
        poll_until(supervisor, Failed)
        supervisor.start("child", obedient, {})
        assert poll_until(supervisor, Started) == Started(2)
        second = started(supervisor)
        supervisor.kill("child.1")
        supervisor.poll(0.1)
        assert is_alive(second)
        supervisor.kill("child.2")
        assert poll_until(supervisor, Failed).reason.startswith("killed by SIGKILL")


def test_a_job_that_is_killed_continues_from_its_checkpoint(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    events: list[Event] = []
    outcome = LocalEngine(1).run_jobs(FakeStage(False), run, ["killed", "a"], events.append, lambda: False)
    assert outcome.done == ["killed", "a"] and not outcome.failed
    assert failures(events) == [("killed", 1, True)]
    assert "SIGKILL" in next(e.report.reason for e in events if isinstance(e.report, AttemptFailed))
    assert lines(tmp_path / "killed.began_at") == ["0", "3"]
    assert read_metrics(run.directory.metrics("jobs", "killed"))["step"].tolist() == [1, 2, 3, 4, 5, 6]
    assert run.job_artifact("jobs", "killed").sha256 == run.job_artifact("jobs", "a").sha256


def test_a_job_that_hangs_is_killed_and_continues_from_its_checkpoint(tmp_path: Path) -> None:
    run = fake_run(tmp_path, job_timeout_s=20.0)
    events: list[Event] = []
    outcome = LocalEngine(1).run_jobs(FakeStage(False), run, ["frozen", "a"], events.append, lambda: False)
    assert outcome.done == ["frozen", "a"] and not outcome.failed
    warnings = [(event.name, event.report.text) for event in events if isinstance(event.report, Warn)]
    assert [(job, "job_timeout_s" in text) for job, text in warnings] == [("frozen", True)]
    assert lines(tmp_path / "frozen.began_at") == ["0", "3"]
    assert run.job_artifact("jobs", "frozen").sha256 == run.job_artifact("jobs", "a").sha256


def test_a_killed_learner_finds_its_workers_again(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    events: list[Event] = []
    outcome = LocalEngine(3).run_jobs(FakeStage(True), run, ["killed", "a"], events.append, lambda: False)
    assert outcome.done == ["killed", "a"] and not outcome.failed
    assert len(list(run.directory.logs().glob("learner-rollout-worker-*"))) == 3, "workers collect"
    assert not [event for event in events if isinstance(event.report, Replaced)]
    assert lines(tmp_path / "killed.began_at") == ["0", "3"]
    assert run.job_artifact("learner", "killed").sha256 == run.job_artifact("learner", "a").sha256


def test_workers_that_keep_dying_fail_the_stage(tmp_path: Path) -> None:
    run = fake_run(tmp_path, max_worker_restarts=2)
    stop = threading.Event()
    killer = threading.Thread(target=_kill_workers, args=(stop,))
    killer.start()
    try:
        outcome = LocalEngine(3).run_jobs(FakeStage(True), run, ["a", "b"], lambda event: None, lambda: False)
    finally:
        stop.set()
        killer.join()
    assert not outcome.done and outcome.not_run == ["b"] and not outcome.stopped
    assert "max_worker_restarts" in outcome.failed["a"] and "SIGKILL" in outcome.failed["a"]
    assert not children()


def _kill_workers(stop: threading.Event) -> None:
    while not stop.wait(0.05):
        for child in children():
            with suppress(psutil.NoSuchProcess):
                if child.name().startswith("rollout-worker-"):
                    child.kill()


@pytest.mark.parametrize("distributed", [False, True])
def test_nothing_is_left_when_the_orchestrator_is_killed(tmp_path: Path, distributed: bool) -> None:
    run = fake_run(tmp_path)
    code = f"""
from contextlib import suppress
from pathlib import Path
from tests.fakes import FakeStage, fake_run
from oodil.workers.local_engine import LocalEngine

if __name__ == "__main__":
    run = fake_run(Path({str(tmp_path)!r}))
    LocalEngine(3).run_jobs(FakeStage({distributed}), run, ["waits", "a"], print, lambda: False)
"""
    script = tmp_path / "orchestrator.py"
    script.write_text(code)
    environment = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}"}
    parent = subprocess.Popen([sys.executable, str(script)], env=environment, start_new_session=True)
    try:
        wait_until(lambda: len(lines(tmp_path / "waits.iterations")) >= 2)
        assert len(_session(parent.pid)) >= 3
        assert endpoint_folder(tmp_path).exists() == distributed
    finally:
        parent.kill()
        parent.wait()
    wait_until(lambda: not _session(parent.pid))

    (tmp_path / "go").touch()
    stage = FakeStage(distributed)
    outcome = LocalEngine(1).run_jobs(stage, run, ["waits"], lambda event: None, lambda: False)
    assert outcome.done == ["waits"]
    assert lines(tmp_path / "waits.began_at") == ["0", "2"]
    assert not endpoint_folder(tmp_path).exists()


def _session(leader: int) -> list[int]:
    """Return the processes of a session that are alive."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and is_alive(int(entry.name)):
            try:
                if os.getsid(int(entry.name)) == leader:
                    found.append(int(entry.name))
            except ProcessLookupError:
                pass
    return found


def test_an_exception_in_the_orchestrator_ends_everything_at_once(tmp_path: Path) -> None:
    run = fake_run(tmp_path)

    def interrupt() -> bool:
        if len(lines(tmp_path / "waits.iterations")) >= 2:
            raise KeyboardInterrupt
        return False

    with pytest.raises(KeyboardInterrupt):
        LocalEngine(2).run_jobs(FakeStage(True), run, ["waits"], lambda event: None, interrupt)
    assert not children()
    assert not endpoint_folder(tmp_path).exists()
    (pid,) = lines(tmp_path / "waits.attempts")
    assert not is_alive(int(pid))
