"""The report of a run: one HTML file that needs no network, no script and no other file."""

from pathlib import Path

from oodil.pipeline.artifacts import write_file
from oodil.pipeline.report.page import render
from oodil.pipeline.stage import Run

__all__ = ["write_report"]


def write_report(run: Run) -> Path:
    """Write the report of whatever is finished, replacing an older one at once, and return where it lies."""
    path = run.directory.report
    write_file(path, render(run).encode())
    return path
