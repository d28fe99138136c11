"""The report of a run: one HTML file that needs no network, no script and no other file."""

from pathlib import Path

from oodil.pipeline.artifacts import write_file
from oodil.pipeline.report.render import Report, context, render
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stage import Run

__all__ = ["Report", "context", "render", "write_report"]


def write_report(run: Run | RunResults) -> Path:
    """Write the report of all finished stages, replace an older one atomically, and return its path."""
    results = run if isinstance(run, RunResults) else RunResults(run)
    path = results.run.directory.report
    write_file(path, render(results).encode())
    return path
