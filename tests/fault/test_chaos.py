"""A whole run while processes of it are killed at random, the orchestrator included: the same bits in the end."""

import random
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from tests.runs import MICRO, LiveRun, artifacts, nothing_left, wait_for

pytestmark = pytest.mark.timeout(600)

TIMES = 8


def kept(run_dir: Path) -> set[tuple[str, int]]:
    """Return what a run has finished or saved by now, and when."""
    found = set()
    for path in run_dir.glob("*/**/manifest.json"):
        with suppress(FileNotFoundError):
            found.add((str(path), path.stat().st_mtime_ns))
    return found


def test_a_run_survives_a_killer(undisturbed: dict[str, str], tmp_path: Path) -> None:
    settings = ("runtime.max_attempts=100", "baselines=[naive_gail]")
    chosen = random.Random(0)
    live = LiveRun("run", str(MICRO), *settings, "--run-dir", str(tmp_path / "run"), "--workers", "2")
    for _ in range(TIMES):
        # Each time only once something was finished or saved: with less, nothing would ever be.
        before = kept(tmp_path / "run")
        wait_for(lambda before=before: kept(tmp_path / "run") - before, "checkpoint or artifact that was not there")
        members = sorted(live.members(), key=lambda process: process.pid)
        victim = chosen.choice(members)
        with suppress(psutil.NoSuchProcess):
            victim.kill()
        if victim.pid == live.process.pid:
            live.process.communicate(timeout=60)
            nothing_left(live)
            live = LiveRun("resume", str(tmp_path / "run"), "--workers", str(chosen.choice([1, 2, 3])))
    code, output = live.finish()
    assert code == 0, output
    nothing_left(live)
    assert artifacts(tmp_path / "run") == undisturbed
