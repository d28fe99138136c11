"""Whole runs as a user starts them, and, for the tests that kill them, in processes of their own."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import psutil
from typer.testing import CliRunner

import oodil
from oodil.cli import app

ROOT = Path(__file__).parents[1]
MICRO = ROOT / "tests" / "micro.yaml"
PATIENCE_S = 250.0


class LiveRun:
    """A run that goes on in the background, in a session of its own so that all of its processes can be found."""

    def __init__(self, *arguments: str, before: Sequence[str] = ()) -> None:
        """Start ``oodil`` with these arguments; ``before`` are the words of a command that runs it."""
        self.process = subprocess.Popen(
            [*before, sys.executable, str(ROOT / "orchestrator.py"), *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def finish(self) -> tuple[int, str]:
        """Wait for the end and return exit code and output."""
        output, _ = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, output

    def kill_group(self) -> None:
        """SIGKILL every process of the run at once."""
        for member in self.members():
            member.kill()
        self.process.communicate(timeout=PATIENCE_S)

    def members(self) -> list[psutil.Process]:
        """Return the living processes of the run's session."""
        found = []
        for process in psutil.process_iter():
            try:
                if os.getsid(process.pid) == self.process.pid and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
            except (OSError, psutil.Error):
                continue
        return found

    def fork_server(self) -> psutil.Process:
        """Return the process from which the others are forked."""
        (server,) = psutil.Process(self.process.pid).children()
        return server

    def child(self, log_prefix: str) -> psutil.Process:
        """Wait for the child whose log begins with ``log_prefix``, such as ``imitation-rollout-worker-0``."""

        def find() -> psutil.Process | None:
            for member in self.members():
                try:
                    if any(Path(file.path).name.startswith(log_prefix) for file in member.open_files()):
                        return member
                except psutil.Error:
                    continue
            return None

        return wait_for(find, f"a child with a log named {log_prefix}*")


def wait_for(find: Callable[[], Any], what: str) -> Any:
    """Return the first thing that ``find`` finds within the patience of a test."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        found = find()
        if found:
            return found
        time.sleep(0.02)
    raise TimeoutError(f"no {what} within {PATIENCE_S:g} s")


def has_checkpoint(run_dir: Path, stage: str, job: str, at_least: int) -> Callable[[], bool]:
    """Return a function that says whether a job has got as far as an iteration."""
    folder = run_dir / "checkpoints" / stage / job
    return lambda: any(int(p.name) >= at_least for p in folder.glob("[0-9]*"))


def run(*arguments: str) -> str:
    """Run a command to its end in this process, where all is loaded; it must succeed. Returns its output."""
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, (result.output, result.exception)
    return result.output


def artifacts(run_dir: Path) -> dict[str, str]:
    """Return the SHA-256 of every stage, all of which must be done."""
    stages = oodil.open_run(run_dir).describe()["stages"]
    assert {entry["state"] for entry in stages.values()} == {"done"}, stages
    return {name: entry["sha256"] for name, entry in stages.items()}


def without_baselines(hashes: dict[str, str]) -> dict[str, str]:
    """Return the hashes of a run that has no baseline."""
    return {name: sha256 for name, sha256 in hashes.items() if name != "naive_gail"}


def nothing_left(live: LiveRun) -> None:
    """Assert that no process of a run is left after a short while."""
    wait_for(lambda: not live.members(), "end of all processes")


def interrupt(live: LiveRun, number: signal.Signals) -> None:
    """Signal the whole group, as a terminal does."""
    os.killpg(live.process.pid, number)
