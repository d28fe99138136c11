"""The fork server: who may start children, and what is left when it dies."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from oodil.workers import fork_server
from oodil.workers.fork_server import ForkServer, ForkServerError
from oodil.workers.local_engine import _PRELOAD, LocalEngine
from oodil.workers.reports import AttemptFailed, Event
from tests.fakes import FakeStage, children, failures, fake_run, is_alive, lines, wait_until

pytestmark = pytest.mark.timeout(120)
ROOT = Path(__file__).parents[2]


def sleep(link: int, server: int, seconds: float) -> None:
    """A child that does not listen to anybody."""
    time.sleep(seconds)


def leave(link: int, server: int, exit_code: int) -> None:
    """A child with an exit code."""
    os._exit(exit_code)


SCRIPT = """
import sys, threading
from pathlib import Path
from tests.fakes import FakeStage, fake_run, note
from oodil.workers.local_engine import LocalEngine

folder = Path(sys.argv[1])
note(folder / "script.runs", "once")

def work():
    outcome = LocalEngine(2).run_jobs(FakeStage(True), fake_run(folder), ["a"], lambda event: None, lambda: False)
    note(folder / "outcome", str(outcome.done))

work()
thread = threading.Thread(target=work)
thread.start()
thread.join()
"""


@pytest.mark.parametrize("how", ["file", "standard input", "-c"])
def test_a_script_without_a_guard_starts_children_and_runs_once(tmp_path: Path, how: str) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    program = {"file": [str(script)], "standard input": ["-"], "-c": ["-c", SCRIPT]}[how]
    environment = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}"}
    subprocess.run(
        [sys.executable, *program, str(tmp_path)],
        input=SCRIPT,
        text=True,
        env=environment,
        cwd=tmp_path,
        check=True,
        timeout=100,
    )
    assert lines(tmp_path / "script.runs") == ["once"]
    assert lines(tmp_path / "outcome") == ["['a']", "['a']"]


def test_children_of_a_killed_server_are_gone_before_their_jobs_go_on(tmp_path: Path) -> None:
    """The job's process is suspended, so that it cannot notice that its server is gone."""
    run, events = fake_run(tmp_path), list[Event]()

    def on_event(event: Event) -> None:
        events.append(event)
        if isinstance(event.report, AttemptFailed):
            # A suspended process that was not killed would stay; one that was takes a moment to leave the kernel.
            wait_until(lambda: not is_alive(int(lines(tmp_path / "waits.attempts")[0])), 2.0)

    def kill() -> None:
        wait_until(lambda: len(lines(tmp_path / "waits.iterations")) >= 2)
        os.kill(int(lines(tmp_path / "waits.attempts")[0]), signal.SIGSTOP)
        server = fork_server.fork_server(_PRELOAD).pid
        assert server is not None
        os.kill(server, signal.SIGKILL)
        (tmp_path / "go").touch()

    killer = threading.Thread(target=kill)
    killer.start()
    outcome = LocalEngine(3).run_jobs(FakeStage(True), run, ["waits", "a"], on_event, lambda: False)
    killer.join()
    assert outcome.done == ["waits", "a"]
    assert failures(events) == [("waits", 1, True)]
    assert lines(tmp_path / "waits.began_at") == ["0", "2"]
    assert run.job_artifact("learner", "waits").sha256 == run.job_artifact("learner", "a").sha256
    assert not children()


def test_a_server_ends_with_its_parent_and_takes_deaf_children_along(tmp_path: Path) -> None:
    script = f"""
import os, sys, time
from tests.fault.test_fork_server import sleep
from oodil.workers.fork_server import ForkServer

server = ForkServer(())
child = server.start(sleep, {{"seconds": 1000.0}})
while child.pid is None:
    child.poll()
print(server.pid, child.pid, flush=True)
os.kill(os.getpid(), {signal.SIGKILL.value})
"""
    environment = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}"}
    result = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
    server, child = (int(pid) for pid in result.stdout.split())
    wait_until(lambda: not is_alive(server) and not is_alive(child))


def test_a_server_has_one_thread_and_torch() -> None:
    server = ForkServer(_PRELOAD)
    try:
        child = server.start(leave, {"exit_code": 3})
        assert child.join(60.0) == 3
        child.close()
        assert server.pid is not None
        process = psutil.Process(server.pid)
        assert process.num_threads() == 1
        assert any("libtorch" in region.path for region in process.memory_maps())
    finally:
        server.kill()


def optimize(link: int, server: int, into: str) -> None:
    """A child that makes an optimizer, and notes what had to be loaded for that."""
    import torch

    loaded = set(sys.modules)
    torch.optim.Adam([torch.zeros(1)])
    Path(into).write_text(" ".join(set(sys.modules) - loaded))
    os._exit(0)


def test_a_child_loads_nothing_for_its_first_optimizer(tmp_path: Path) -> None:
    server = ForkServer(_PRELOAD)
    try:
        child = server.start(optimize, {"into": str(tmp_path / "loaded")})
        assert child.join(60.0) == 0
        child.close()
        assert (tmp_path / "loaded").read_text() == ""
    finally:
        server.kill()


def test_an_idle_server_ends_and_the_next_start_finds_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fork_server, "IDLE_S", 0.1)
    server = ForkServer(())
    try:
        pids = set()
        for _ in range(2):
            child = server.start(leave, {"exit_code": 0})
            assert child.join(60.0) == 0
            child.close()
            pid = server.pid
            assert pid is not None
            pids.add(pid)
            wait_until(lambda pid=pid: not is_alive(pid))  # type: ignore[misc]
        assert len(pids) == 2
    finally:
        server.kill()


def test_why_a_server_does_not_start_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    server = ForkServer(())
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(ForkServerError):
        server.start(leave, {"exit_code": 0})
    monkeypatch.undo()
    monkeypatch.setattr(sys, "path", ["/nowhere"])
    child = server.start(leave, {"exit_code": 0})
    assert child.join(60.0) == fork_server.LOST
    assert "No module named" in child.describe_end()
    child.close()
    server.kill()
