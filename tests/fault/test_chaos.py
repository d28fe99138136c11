"""A whole run while processes of it are killed at random, the orchestrator included: the same bits in the end."""

import random
import time
from pathlib import Path

import psutil
import pytest

from tests.runs import MICRO, LiveRun, artifacts, nothing_left

pytestmark = pytest.mark.timeout(600)

KILL_EVERY_S = 4.0
"""Longer than a process needs to start and reach its next checkpoint; with less, nothing would ever be finished."""
TIMES = 8


def test_a_run_survives_a_killer(undisturbed: dict[str, str], tmp_path: Path) -> None:
    settings = ("runtime.max_attempts=100", "baselines=[naive_gail]")
    chosen = random.Random(0)
    live = LiveRun("run", str(MICRO), *settings, "--run-dir", str(tmp_path / "run"), "--workers", "2")
    killed = []
    for _ in range(TIMES):
        time.sleep(KILL_EVERY_S)
        members = sorted(live.members(), key=lambda process: process.pid)
        if not members:
            break
        victim = chosen.choice(members)
        killed.append(victim.pid == live.process.pid)
        try:
            victim.kill()
        except psutil.NoSuchProcess:
            continue
        if killed[-1]:
            live.process.communicate(timeout=60)
            nothing_left(live)
            live = LiveRun("resume", str(tmp_path / "run"), "--workers", str(chosen.choice([1, 2, 3])))
    code, output = live.finish()
    assert code == 0, output
    nothing_left(live)
    assert len(killed) >= 4, "it was over before much could be killed"
    assert artifacts(tmp_path / "run") == undisturbed
