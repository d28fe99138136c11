"""Ctrl-C in a terminal: once to checkpoint and stop, twice to stop now."""

import time
from pathlib import Path

import pytest

from tests.runs import MICRO, artifacts, has_checkpoint, nothing_left, run, wait_for, without_baselines
from tests.terminals import CTRL_C, RunInTerminal

pytestmark = pytest.mark.timeout(300)


@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c(undisturbed: dict[str, str], tmp_path: Path, times: int) -> None:
    live = RunInTerminal("run", str(MICRO), "--run-dir", str(tmp_path / "stopped"), "--workers", "2")
    wait_for(has_checkpoint(tmp_path / "stopped", "imitation", "training-1", 2), "checkpoint")
    if times == 2:
        # A worker that is stuck keeps the first Ctrl-C from coming to an end.
        for worker in ("imitation-rollout-worker-0", "imitation-rollout-worker-1"):
            live.child(worker).suspend()
    live.press(CTRL_C)
    if times == 2:
        time.sleep(1.0)
        assert live.process.poll() is None, "the first Ctrl-C has already ended it"
        live.press(CTRL_C)
    code, shown = live.finish()
    assert code == 130, shown
    assert ("stopped at once" in shown) == (times == 2), shown
    assert f"oodil resume {tmp_path / 'stopped'}" in "".join(live.screen(shown)), "in one piece, however long"
    # Ctrl-C is written to the screen by the terminal itself; no bar may stay behind for that.
    assert not [line for line in live.screen(shown) if "eta" in line], shown
    nothing_left(live)
    run("resume", str(tmp_path / "stopped"), "--workers", "1")
    assert artifacts(tmp_path / "stopped") == without_baselines(undisturbed)
