"""Runs in the foreground of a terminal of their own, and what a person would see there."""

import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
import threading
from collections.abc import Mapping

import pyte

from tests.runs import PATIENCE_S, ROOT, LiveRun

CTRL_C = b"\x03"


class RunInTerminal(LiveRun):
    """A Python program, by default the command line, in a terminal of a given size."""

    def __init__(
        self,
        *arguments: str,
        program: str = str(ROOT / "orchestrator.py"),
        columns: int = 80,
        lines: int = 24,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._columns, self._lines = columns, lines
        self._keyboard, screen = pty.openpty()
        fcntl.ioctl(screen, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
        inherited = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
        self.process = subprocess.Popen(
            [sys.executable, program, *arguments],
            stdin=screen,
            stdout=screen,
            stderr=screen,
            env=inherited | {"TERM": "xterm-256color"} | dict(environment or {}),
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
        """Wait for the end and return exit code and everything that was written to the screen."""
        code = self.process.wait(timeout=PATIENCE_S)
        self._reader.join(timeout=PATIENCE_S)
        os.close(self._keyboard)
        return code, self._shown.decode(errors="replace")

    def screen(self, written: str) -> list[str]:
        """Return the lines that a person sees who scrolls back to the beginning."""
        screen = pyte.HistoryScreen(self._columns, self._lines, history=100_000)
        pyte.Stream(screen).feed(written)
        above = ["".join(line[x].data for x in range(self._columns)) for line in screen.history.top]
        return [line.rstrip() for line in [*above, *screen.display]]

    def _read(self) -> None:
        while True:
            try:
                self._shown += os.read(self._keyboard, 4096)
            except OSError:
                return
