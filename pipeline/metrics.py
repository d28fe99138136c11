"""What a job reports while it runs: one JSON object per line, and TensorBoard's event files where that is installed.

Every line has ``step`` and ``total`` (environment steps or iterations, as the job counts), ``rate`` (steps per second
since the line before; null for the first) and the figures of the job. A file has at most `MAX_LINES` lines: when it is
full every second one is dropped, and from then on only half as many are written.
"""

import json
import math
import time
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import write_file

MAX_LINES = 2000


class Metrics:
    """Writes the metrics of a job; ``path`` may exist from an attempt before, whose lines then stay.

    A job that resumed from an earlier step than the last line drops the lines from that step on. Raises OSError when
    the disk does not take it. Use it as a context manager or call `close`.
    """

    def __init__(self, path: Path, tensorboard: Path | None = None) -> None:
        self._path = path
        self._tensorboard = tensorboard
        self._file: IO[bytes] | None = None
        self._events: _EventWriter | None = None
        self._lines: list[tuple[int, bytes]] = []
        """Step and text of each line in the file."""
        self._interval = 1
        self._to_skip = 0
        self._last: tuple[int, float] | None = None
        """Step and time of the last line."""

    def __enter__(self) -> "Metrics":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def write(self, step: int, total: int, figures: dict[str, float]) -> None:
        """Add a line, unless the interval says that this one is left out; the last step is always written."""
        if self._file is None:
            self._open(step)
        if self._to_skip and step < total:
            self._to_skip -= 1
            return
        self._to_skip = self._interval - 1
        now = time.monotonic()
        rate = (step - self._last[0]) / (now - self._last[1]) if self._last and now > self._last[1] else float("nan")
        self._last = step, now
        own = {"step": step, "total": total, "rate": rate}
        values = own | figures | own
        line = json.dumps({name: _finite(value) for name, value in values.items()}).encode() + b"\n"
        self._lines.append((step, line))
        assert self._file is not None
        self._file.write(line)
        self._file.flush()
        if len(self._lines) >= MAX_LINES:
            self._thin_out()
        if self._events is not None:
            self._events.write(step, {"rate": rate} | figures)

    def close(self) -> None:
        """Close the files; harmless when repeated."""
        if self._file is not None:
            self._file.close()
        if self._events is not None:
            self._events.close()
        self._file = self._events = None

    def _open(self, step: int) -> None:
        """Open the files for a job whose first report is of ``step``; what is there of later steps is dropped."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._lines = [(int(values["step"]), line) for values, line in _sound_lines(self._path)]
        self._lines = [(at, line) for at, line in self._lines if at < step]
        self._rewrite()
        if self._tensorboard is not None:
            self._events = _event_writer(self._tensorboard, step)

    def _thin_out(self) -> None:
        # From the end, so that the newest line stays.
        self._lines = self._lines[::-1][::2][::-1]
        self._interval *= 2
        self._to_skip = self._interval - 1
        self._rewrite()

    def _rewrite(self) -> None:
        if self._file is not None:
            self._file.close()
        write_file(self._path, b"".join(line for _, line in self._lines))
        self._file = open(self._path, "ab")  # noqa: SIM115 - it is open as long as the job runs


def read_metrics(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return the columns of a metrics file, each (L,) for L lines, in the order of their steps.

    NaN stands where a line has no such figure, or one that is not finite. A line that was broken by a kill is left out;
    without a file there are no columns.
    """
    lines = [values for values, _ in _sound_lines(path)]
    names = dict.fromkeys(name for values in lines for name in values)
    return {
        name: np.array([float("nan") if values.get(name) is None else values[name] for values in lines], np.float64)
        for name in names
    }


def _sound_lines(path: Path) -> list[tuple[dict[str, Any], bytes]]:
    """Return the values and the text of each line that is whole."""
    found = []
    for line in path.read_bytes().splitlines(keepends=True) if path.exists() else []:
        try:
            values = json.loads(line)
        except ValueError:
            continue
        if line.endswith(b"\n") and isinstance(values, dict) and isinstance(values.get("step"), int):
            found.append((values, line))
    return found


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


class _EventWriter(Protocol):
    def write(self, step: int, figures: dict[str, float]) -> None: ...

    def close(self) -> None: ...


def _event_writer(folder: Path, first_step: int) -> "_EventWriter | None":
    """Return a writer of TensorBoard's event files, or None where tensorboard is not installed."""
    try:
        # tensorboard's own writer; the one of torch.utils loads far more.
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog
        from tensorboard.compat.proto.summary_pb2 import Summary
        from tensorboard.summary.writer.event_file_writer import EventFileWriter
    except ImportError:
        return None

    class Writer:
        def __init__(self) -> None:
            self._writer = EventFileWriter(str(folder))
            # Tells TensorBoard to forget what an earlier attempt wrote of this step and later ones.
            self._add(first_step, session_log=SessionLog(status=SessionLog.START))

        def write(self, step: int, figures: dict[str, float]) -> None:
            values = [Summary.Value(tag=name, simple_value=value) for name, value in figures.items()]
            self._add(step, summary=Summary(value=values))

        def close(self) -> None:
            self._writer.close()

        def _add(self, step: int, **content: Any) -> None:
            self._writer.add_event(Event(wall_time=time.time(), step=step, **content))

    return Writer()
