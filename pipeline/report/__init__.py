"""The report of a run: one HTML file that needs no network, no script and no other file."""

import os
from pathlib import Path

from pipeline.report.page import render
from pipeline.stage import Run

__all__ = ["write_report"]


def write_report(run: Run) -> Path:
    """Write the report of whatever is finished, replacing an older one at once, and return where it lies."""
    path = run.directory.report
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.new")
    try:
        temporary.write_text(render(run), encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path
