"""What a job reports while it runs: one JSON object per line, TensorBoard's event files where that is installed, and
a logger with wandb's interface where one is asked for.

Every line has ``step`` and ``total`` (environment steps or iterations, as the job counts), ``rate`` (steps per second
since the line before; null for the first) and the figures of the job. A file has at most `MAX_LINES` lines: when it is
full every second one is dropped, and from then on only half as many are written.
"""

import json
import math
import os
import time
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import write_file
from oodil.pipeline.errors import ConfigError

MAX_LINES = 2000


@dataclass(frozen=True)
class Logger:
    """A module with wandb's interface, and under which names it files what a job reports. It is loaded by `Metrics`."""

    module: str
    """``wandb`` or ``trackio``."""
    project: str
    group: str
    name: str
    folder: Path
    """Of the run; wandb writes below it."""


def check_logger(module: str | None) -> None:
    """Raise ConfigError if a logger is asked for that is not installed."""
    if module is not None and find_spec(module) is None:
        raise ConfigError(f"runtime.logger: {module} is not installed; pip install {module}")


class Metrics:
    """Writes the metrics of a job; ``path`` may exist from an attempt before, whose lines then stay.

    A job that resumed from an earlier step than the last line drops the lines from that step on. Raises OSError when
    the disk does not take it. Use it as a context manager or call `close`.
    """

    def __init__(self, path: Path, tensorboard: Path | None = None, logger: Logger | None = None) -> None:
        self._path = path
        self._tensorboard = tensorboard
        self._logger = logger
        self._file: IO[bytes] | None = None
        self._others: list[_Writer] = []
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
        for other in self._others:
            other.write(step, {"rate": rate} | figures)

    def close(self) -> None:
        """Close the files; harmless when repeated."""
        if self._file is not None:
            self._file.close()
            self._file = None
        while self._others:
            self._others.pop().close()

    def _open(self, step: int) -> None:
        """Open the files for a job whose first report is of ``step``; what is there of later steps is dropped."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._lines = [(int(values["step"]), line) for values, line in _sound_lines(self._path)]
        self._lines = [(at, line) for at, line in self._lines if at < step]
        self._rewrite()
        if self._tensorboard is not None:
            self._others += _event_writers(self._tensorboard, step)
        if self._logger is not None:
            self._others.append(_LoggerWriter(self._logger))

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


class _Writer(Protocol):
    def write(self, step: int, figures: dict[str, float]) -> None: ...

    def close(self) -> None: ...


class _LoggerWriter:
    """One run of a logger; an attempt that goes on after another has a run of its own."""

    def __init__(self, logger: Logger) -> None:
        # Nothing goes over the network unless its user says so, by WANDB_MODE or trackio's variables; one run of ours
        # ends none that the caller of `oodil.run` has open, and no terminal output is taken or added.
        options: dict[str, dict[str, Any]] = {
            "wandb": {
                "mode": os.environ.get("WANDB_MODE", "offline"),
                "dir": str(logger.folder),
                "reinit": "create_new",
                "settings": {"silent": True, "console": "off"},
            },
            "trackio": {"embed": False},
        }
        self._run = import_module(logger.module).init(
            project=logger.project, group=logger.group, name=logger.name, **options[logger.module]
        )

    def write(self, step: int, figures: dict[str, float]) -> None:
        self._run.log(figures, step=step)

    def close(self) -> None:
        self._run.finish()


def _event_writers(folder: Path, first_step: int) -> list[_Writer]:
    """Return a writer of TensorBoard's event files, or none where tensorboard is not installed."""
    try:
        # tensorboard's own writer; the one of torch.utils loads far more.
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog
        from tensorboard.compat.proto.summary_pb2 import Summary
        from tensorboard.summary.writer.event_file_writer import EventFileWriter
    except ImportError:
        return []

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

    return [Writer()]
