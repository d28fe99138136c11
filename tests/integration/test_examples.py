"""The examples run as they are: as scripts without a ``__main__`` guard, and in a thread."""

import os
import runpy
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import oodil
from tests.runs import MICRO, ROOT

pytestmark = pytest.mark.timeout(300)
EXAMPLES = ROOT / "examples"


def test_the_quickstart_as_a_script_whose_jobs_run_in_other_processes(tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLES / "quickstart.py"), str(MICRO), str(tmp_path / "run")]
    done = subprocess.run(command, cwd=tmp_path, env=dict(os.environ), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    shown = done.stdout.splitlines()
    assert len(shown) == 7 + 2 and shown[0].startswith("demonstration"), "seven demonstrations, an episode, a policy"
    assert shown[-1].startswith("ours: return") and shown[-1].endswith("over 32 episodes")


def test_the_quickstart_in_a_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["quickstart.py", str(MICRO), str(tmp_path / "run")])
    seen: list[oodil.RunResults] = []
    thread = threading.Thread(target=lambda: seen.append(runpy.run_path(str(EXAMPLES / "quickstart.py"))["run"]))
    thread.start()
    thread.join()
    assert seen[0].is_done("imitation")


def test_a_method_of_ones_own_in_one_file(tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLES / "own_weighting.py"), str(MICRO), str(tmp_path / "run")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [line.partition(":")[0] for line in done.stdout.splitlines()] == ["ours", "naive GAIL", "fast ones"]
