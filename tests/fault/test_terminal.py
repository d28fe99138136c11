"""Ctrl-C in a terminal: once to checkpoint and stop, twice to stop now."""

import fcntl
import os
import pty
import subprocess
import sys
import termios
import threading
import time
from pathlib import Path

import pytest

from tests.runs import (
    MICRO,
    PATIENCE_S,
    ROOT,
    LiveRun,
    artifacts,
    has_checkpoint,
    nothing_left,
    run,
    wait_for,
    without_baselines,
)

pytestmark = pytest.mark.timeout(300)

CTRL_C = b"\x03"


class RunInTerminal(LiveRun):
    """A run in the foreground of a terminal of its own."""

    def __init__(self, *arguments: str) -> None:
        self._keyboard, screen = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, str(ROOT / "orchestrator.py"), *arguments],
            stdin=screen,
            stdout=screen,
            stderr=screen,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )
        os.close(screen)
        self._shown = b""
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def press(self, key: bytes) -> None:
        """Press a key; the terminal makes a signal of Ctrl-C."""
        os.write(self._keyboard, key)

    def finish(self) -> tuple[int, str]:
        """Wait for the end and return exit code and what was on the screen."""
        code = self.process.wait(timeout=PATIENCE_S)
        self._reader.join(timeout=PATIENCE_S)
        os.close(self._keyboard)
        return code, self._shown.decode(errors="replace")

    def _read(self) -> None:
        while True:
            try:
                self._shown += os.read(self._keyboard, 4096)
            except OSError:
                return


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
    assert "oodil resume" in shown
    nothing_left(live)
    run("resume", str(tmp_path / "stopped"), "--workers", "1")
    assert artifacts(tmp_path / "stopped") == without_baselines(undisturbed)
