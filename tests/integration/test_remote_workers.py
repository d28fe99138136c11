"""Workers that join over TCP: the same bits, and nobody without an allowed key."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from oodil.cli import app
from oodil.pipeline.stage import Run
from oodil.workers.channels import Access, Dealer, Router, new_key_pair
from oodil.workers.keys import KeysError, client_keys, create_learner_keys, create_worker_keys, server_keys
from oodil.workers.local_engine import LocalEngine
from oodil.workers.messages import Header, Ready, encode
from tests.fakes import FakeStage, fake_run, lines
from tests.runs import ROOT

pytestmark = pytest.mark.timeout(120)


@pytest.fixture
def access(tmp_path: Path) -> Access:
    """Return an address of this machine that is free, and fresh keys."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    create_learner_keys(tmp_path / "keys", new_key_pair)
    return Access(f"tcp://127.0.0.1:{port}", tmp_path / "keys")


def hello(name: str) -> list[bytes]:
    return encode(Ready(Header("", "", name, 0), "versions"))


def heard(router: Router, patience_s: float) -> list[str]:
    """Return who was heard within a time; it ends with the first one."""
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        messages = router.receive(0.1)
        if messages:
            return [name for name, _ in messages]
    return []


def test_only_a_peer_with_an_allowed_key_is_heard(access: Access, tmp_path: Path) -> None:
    allowed = create_worker_keys(access.keys, "allowed-one", new_key_pair)
    unlisted = create_worker_keys(access.keys, "unlisted", new_key_pair)
    (access.keys / "allowed" / "unlisted.public").unlink()
    create_learner_keys(tmp_path / "others", new_key_pair)
    wrong_learner = create_worker_keys(tmp_path / "others", "stranger", new_key_pair)
    router = Router(f"ipc://{tmp_path}/s", access)
    try:
        cases: list[tuple[str, Path | None]] = [("none", None), ("unlisted", unlisted), ("stranger", wrong_learner)]
        for endpoint in (access.address, f"ipc://{tmp_path}/s"):
            for name, keys in cases:
                dealer = Dealer(endpoint, name, keys)
                dealer.send(hello(name))
                assert heard(router, 1.0) == [], (endpoint, name)
                dealer.close()
            for name, keys in (("allowed", allowed), ("local", access.keys)):
                dealer = Dealer(endpoint, name, keys)
                dealer.send(hello(name))
                assert heard(router, 30.0) == [name]
                dealer.close()
    finally:
        router.close()


def test_keys_are_allowed_and_taken_back_while_a_learner_listens(access: Access, tmp_path: Path) -> None:
    router = Router(f"ipc://{tmp_path}/s", access)
    try:
        keys = create_worker_keys(access.keys, "late", new_key_pair)
        for is_allowed in (True, False):
            dealer = Dealer(access.address, "late", keys)
            dealer.send(hello("late"))
            assert heard(router, 30.0 if is_allowed else 1.0) == ["late"] * is_allowed
            dealer.close()
            (access.keys / "allowed" / "late.public").unlink(missing_ok=True)
    finally:
        router.close()


def finished(run: Run, engine: LocalEngine) -> str:
    stage = FakeStage(distributed=True)
    outcome = engine.run_jobs(stage, run, ["waits"], lambda _: None, lambda: False)
    assert outcome.done == ["waits"], outcome
    return run.job_artifact("learner", "waits").sha256


def remote_worker(access: Access, keys: Path, said: Path) -> subprocess.Popen[bytes]:
    """Return ``oodil worker`` once it serves, so that a signal finds its handler; what it says goes to a file."""
    command = [sys.executable, str(ROOT / "orchestrator.py"), "worker", "--connect", access.address]
    command += ["--keys", str(keys), "--logs", str(said.parent / "logs")]
    with said.open("wb") as output:
        remote = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
    while "collects for" not in said.read_text():
        assert remote.poll() is None, said.read_text()
        time.sleep(0.1)
    return remote


@pytest.mark.parametrize("leaves", [False, True], ids=["stays", "is killed"])
def test_a_worker_that_joins_from_elsewhere_changes_no_bit(access: Access, tmp_path: Path, leaves: bool) -> None:
    """A remote worker is there before the run; if it leaves, the job waits in its third iteration until it is gone."""
    alone = fake_run(tmp_path / "alone")
    (alone.directory.path / "go").touch()
    expected = finished(alone, LocalEngine(1))

    keys = create_worker_keys(access.keys, "elsewhere", new_key_pair)
    remote = remote_worker(access, keys, tmp_path / "said")
    joined = fake_run(tmp_path / "joined")

    def go() -> bool:
        """Look on while the stage runs; it asks now and then whether to stop."""
        iterations = joined.directory.path / "waits.iterations"
        if iterations.exists() and len(lines(iterations)) >= 2 and not (joined.directory.path / "go").exists():
            if leaves:
                remote.kill()
            (joined.directory.path / "go").touch()
        return False

    stage = FakeStage(distributed=True)
    outcome = LocalEngine(1, access).run_jobs(stage, joined, ["waits"], lambda _: None, go)
    assert outcome.done == ["waits"], outcome
    assert joined.job_artifact("learner", "waits").sha256 == expected
    remote.terminate()
    assert remote.wait(timeout=30) == (-signal.SIGKILL if leaves else 0), (tmp_path / "said").read_text()


def test_remote_workers_alone_do_the_work(access: Access, tmp_path: Path) -> None:
    """The only local worker is stopped by the test, so the run can end only by what comes over TCP."""
    keys = create_worker_keys(access.keys, "elsewhere", new_key_pair)
    remote = remote_worker(access, keys, tmp_path / "said")
    run = fake_run(tmp_path / "run")
    (run.directory.path / "go").touch()
    from oodil.pipeline.collecting import InlineRollouts
    from oodil.workers.zmq_rollouts import ZmqRollouts
    from tests.fakes import hopper_units

    source = ZmqRollouts(f"ipc://{tmp_path}/s", "a run", "learner.1", 60.0, access=access)
    inline = InlineRollouts()
    try:
        for iteration in range(3):
            source.submit(hopper_units(iteration))
            inline.submit(hopper_units(iteration))
            for got, expected in zip(source.gather(), inline.gather(), strict=True):
                assert got.rollout.observations.tobytes() == expected.rollout.observations.tobytes()
    finally:
        source.close()
        remote.terminate()
        assert remote.wait(timeout=30) == 0, (tmp_path / "said").read_text()


def refused(*arguments: str) -> str:
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == 2, (result.output, result.exception)
    return result.output


def test_the_command_line_refuses_to_listen_without_keys(access: Access, tmp_path: Path) -> None:
    micro = str(ROOT / "tests" / "micro.yaml")
    run_dir = ("--run-dir", str(tmp_path / "run"))
    assert "nobody joins a run without a key" in refused("run", micro, *run_dir, "--bind", access.address)
    assert "learner.secret" in refused("run", micro, *run_dir, "--bind", access.address, "--keys", str(tmp_path))
    keys = ("--keys", str(access.keys))
    assert "cannot listen on tcp://256.1.1.1:1" in refused("run", micro, *run_dir, "--bind", "tcp://256.1.1.1:1", *keys)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        assert "in use" in refused("run", micro, *run_dir, "--bind", address, *keys)
    assert not (tmp_path / "run").exists()


def test_keys_are_made_once_and_kept_from_others(access: Access) -> None:
    runner = CliRunner()
    own = access.keys / "bench"
    assert runner.invoke(app, ["keys", "new", str(access.keys), "--worker", "bench"]).exit_code == 0
    assert (own / "worker.secret").stat().st_mode & 0o777 == 0o600
    assert client_keys(own).server == server_keys(access.keys).own.public
    assert client_keys(own).own.public in server_keys(access.keys).allowed
    assert "already has a learner's keys" in refused("keys", "new", str(access.keys))
    assert "is there already" in refused("keys", "new", str(access.keys), "--worker", "bench")
    assert "use letters" in refused("keys", "new", str(access.keys), "--worker", "../bench")
    os.chmod(own / "worker.secret", 0o644)
    assert "others may read this secret key" in refused("worker", "--connect", access.address, "--keys", str(own))
    (own / "learner.public").write_text("short")
    os.chmod(own / "worker.secret", 0o600)
    with pytest.raises(KeysError, match="is no key, which has 40 characters"):
        client_keys(own)


def test_a_worker_with_other_libraries_ends_with_the_reason(
    access: Access, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from oodil.workers import zmq_rollouts

    monkeypatch.setattr(zmq_rollouts, "collecting_versions", lambda: "mujoco 0.0.0")
    remote = remote_worker(access, create_worker_keys(access.keys, "elsewhere", new_key_pair), tmp_path / "said")
    source = zmq_rollouts.ZmqRollouts(f"ipc://{tmp_path}/s", "a run", "learner.1", 60.0, access=access)
    try:
        assert remote.wait(timeout=30) == 1
        output = (tmp_path / "said").read_text()
        assert "refused: this worker has" in output and "mujoco 0.0.0" in output
    finally:
        source.close()
        remote.kill()
